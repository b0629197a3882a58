/** Reed-Solomon decoder over GF(2^16) for erasures and errors; counterpart of `keyss.channels.reed_solomon`. */
import { tooMuchLost } from '../core/errors.ts';

const ORDER = 65535; // of the generator 2
const ZERO = 4 * ORDER; // logarithm of 0; POWERS of its sums with others are 0
const MAX_ERRORS = 128; // per codeword

const POWERS = new Uint16Array(2 * ZERO + 1);
const LOGARITHMS = new Uint32Array(ORDER + 1).fill(ZERO);
for (let exponent = 0, value = 1; exponent < ORDER; exponent++) {
  for (let at = exponent; at < ZERO - ORDER; at += ORDER) POWERS[at] = value;
  LOGARITHMS[value] = exponent;
  value = (value << 1) ^ (value >> 15 ? 0x1100b : 0);
}

function product(a: number, b: number): number {
  return POWERS[LOGARITHMS[a] + LOGARITHMS[b]];
}

/**
 * Data in `count` codewords of `n` chunks of `width` bytes (even), any `k` of which determine the codeword. Chunk i of
 * codeword c has the number i x `count` + c.
 */
export interface Codewords {
  readonly count: number;
  readonly n: number;
  readonly k: number;
  readonly width: number;
}

/** A chunk of a codeword: values of polynomials at the field element `point`. */
interface Chunk {
  readonly point: number;
  readonly bytes: Uint8Array;
}

/**
 * The data from numbered chunks in any order. `errors`: some chunks may be wrong. Raises InputError for too few chunks.
 */
export function decoded(
  { count, n, k, width }: Codewords, chunks: Iterable<readonly [number, Uint8Array]>, errors = false,
): Uint8Array {
  const left = new Map<number, Uint8Array | null>(); // null: different chunks claim this number
  for (const [number, chunk] of chunks) {
    const other = left.get(number);
    const alike = other === undefined || (other?.every((each, at) => each === chunk[at]) ?? false);
    if (number < count * n) left.set(number, alike ? chunk : null);
  }
  if (left.size < count * k) throw tooMuchLost(); // before allocating
  const data = new Uint8Array(count * k * width);
  const products = differences(pointsOf(n), pointsOf(n));
  for (let codeword = 0; codeword < count; codeword++) {
    let own: Chunk[] = [];
    for (let row = 0; row < n; row++) {
      const bytes = left.get(row * count + codeword);
      if (bytes) own.push({ point: row + 1, bytes });
    }
    if (errors && own.length > k) own = rightOf(own, k, products);
    if (own.length < k) throw tooMuchLost();
    own = own.slice(0, k);
    const put = (point: number, row: Uint8Array) => data.set(row, ((point - 1) * count + codeword) * width);
    const known = new Set(own.map(({ point }) => point));
    own.filter(({ point }) => point <= k).forEach(({ point, bytes }) => put(point, bytes));
    const lost = pointsOf(k).filter((point) => !known.has(point));
    if (lost.length) interpolated(own, lost, products).forEach((row, index) => put(lost[index], row));
  }
  return data;
}

/** 1 to `count`. */
function pointsOf(count: number): number[] {
  return Array.from({ length: count }, (_, row) => row + 1);
}

/** The chunks at the `wanted` points, interpolated from k chunks of a codeword; see `scaled`. */
function interpolated(chunks: Chunk[], wanted: number[], products: Uint32Array): Uint8Array[] {
  const [points, values] = [chunks.map(({ point }) => point), scaled(chunks, products)];
  const columns = values.length / points.length;
  const outside = differences(wanted, points);
  return wanted.map((at, index) => {
    const sums = new Uint16Array(columns);
    points.forEach((point, row) => {
      const factor = outside[index] + ORDER - LOGARITHMS[at ^ point];
      for (let column = 0; column < columns; column++) sums[column] ^= POWERS[factor + values[row * columns + column]];
    });
    return Uint8Array.from({ length: 2 * columns }, (_, byte) => (sums[byte >> 1] >> (byte & 1 ? 0 : 8)) & 255);
  });
}

/**
 * [C, columns] logarithms of the chunks' symbols divided by the product of their points' differences. `products`: the
 * `differences` of all points of the codeword, to be divided by those of the few missing ones.
 */
function scaled(chunks: Chunk[], products: Uint32Array): Uint32Array {
  const points = chunks.map(({ point }) => point);
  const columns = chunks[0].bytes.length / 2;
  const found = new Uint32Array(chunks.length * columns);
  const own = new Set(points);
  const missing = differences(points, pointsOf(products.length).filter((point) => !own.has(point)));
  chunks.forEach(({ bytes }, row) => {
    for (let column = 0; column < columns; column++) {
      const symbol = LOGARITHMS[(bytes[2 * column] << 8) | bytes[2 * column + 1]];
      found[row * columns + column] = symbol === ZERO ? ZERO : (symbol + missing[row] + ORDER - products[points[row] - 1]) % ORDER;
    }
  });
  return found;
}

/** Logarithms of the products of differences to all other `points`. */
function differences(at: number[], points: number[]): Uint32Array {
  const others = Uint16Array.from(points);
  return Uint32Array.from(at, (own) => {
    let sum = 0; // exact: at most 2^16 logarithms of 2^16
    for (const each of others) if (each !== own) sum += LOGARITHMS[own ^ each];
    return sum % ORDER;
  });
}

/** The chunks that belong to the codeword, given more than k; none if there are too many errors. */
function rightOf(chunks: Chunk[], k: number, products: Uint32Array): Chunk[] {
  const values = scaled(chunks, products);
  const columns = values.length / chunks.length;
  const terms = chunks.map((_, row) => {
    let sum = 0;
    for (let column = 0; column < columns; column++) sum ^= POWERS[values[row * columns + column] + column];
    return LOGARITHMS[sum];
  });
  const powers = chunks.map(({ point }) => LOGARITHMS[point]);
  const sums = Array.from({ length: Math.min(chunks.length - k, 2 * MAX_ERRORS) }, (_, time) =>
    powers.reduce((sum, power, row) => sum ^ POWERS[terms[row] + ((time * power) % ORDER)], 0),
  );
  const locator = sums.some((each) => each !== 0) ? recurrence(sums) : [1];
  return chunks.filter((_, row) => {
    const inverse = ORDER - powers[row];
    return locator.reduce((sum, each, power) => sum ^ POWERS[LOGARITHMS[each] + ((power * inverse) % ORDER)], 0) !== 0;
  });
}

/** Coefficients, 1 first, of the shortest linear recurrence of a sequence (Berlekamp-Massey). */
function recurrence(sums: number[]): number[] {
  let [found, before, length, since, scale] = [[1], [1], 0, 1, 1];
  for (let index = 0; index < sums.length; index++) {
    const discrepancy = found
      .slice(0, length + 1)
      .reduce((sum, each, back) => sum ^ product(each, sums[index - back]), 0);
    if (discrepancy === 0) {
      since++;
      continue;
    }
    const factor = product(discrepancy, POWERS[ORDER - LOGARITHMS[scale]]);
    const shifted = [...new Array<number>(since).fill(0), ...before.map((each) => product(factor, each))];
    const kept = found;
    found = Array.from({ length: Math.max(found.length, shifted.length) }, (_, at) => (kept[at] ?? 0) ^ (shifted[at] ?? 0));
    if (2 * length <= index) [length, before, scale, since] = [index + 1 - length, kept, discrepancy, 1];
    else since++;
  }
  return found;
}
