/**
 * Reed-Solomon decoder over GF(2^16) for erasures and errors; counterpart of `keyss.channels.reed_solomon`, which explains
 * the method.
 */
import { tooMuchLost } from '../core/errors.ts';

const ORDER = 65535; // order of the generator 2
const ZERO = 2 * ORDER; // logarithm of 0; POWERS of its sums with others are 0
const MAX_SHARDS = 1 << 13; // per codeword
const MAX_ERRORS = 128; // per codeword
const COLUMNS = 64; // columns of symbols that are restored at a time

const POWERS = new Uint16Array(2 * ZERO + 1);
const LOGARITHMS = new Uint32Array(ORDER + 1).fill(ZERO);
for (let exponent = 0, value = 1; exponent < ORDER; exponent++) {
  POWERS[exponent] = POWERS[exponent + ORDER] = value;
  LOGARITHMS[value] = exponent;
  value = (value << 1) ^ (value >> 15 ? 0x1100b : 0);
}

/** Field elements by index: sums of a Cantor basis. */
const POINTS = new Uint16Array(2 * MAX_SHARDS);
for (let size = 1, basis = 1; size < POINTS.length; size *= 2) {
  for (let at = 0; at < size; at++) POINTS[size + at] = POINTS[at] ^ basis;
  let root = 0;
  while ((product(root, root) ^ root) !== basis) root++;
  basis = root;
}

function product(a: number, b: number): number {
  return POWERS[LOGARITHMS[a] + LOGARITHMS[b]];
}

/**
 * Data in `count` codewords of `n` shards of `width` bytes (even), any `k` of which determine the codeword. Shard i of
 * codeword c has the number i x `count` + c.
 */
export interface Codewords {
  readonly count: number;
  readonly n: number;
  readonly k: number;
  readonly width: number;
}

/** Shards in any order. */
export interface Shards {
  readonly numbers: ArrayLike<number>; // [C]
  readonly data: Uint8Array; // [C, width]
}

/** Shards [n], null if lost, of one codeword. */
type Codeword = (Uint8Array | null)[];

const [LOST, CONTRADICTORY] = [-1, -2];

/** The data. `errors`: some shards may be wrong. Raises InputError for too few shards. */
export function decoded({ count, n, k, width }: Codewords, { numbers, data: shards }: Shards, errors = false): Uint8Array {
  if (numbers.length < count * k) throw tooMuchLost(); // before allocating
  const rows = new Int32Array(n * count).fill(LOST);
  for (let row = 0; row < numbers.length; row++) {
    const [number, other] = [numbers[row], rows[numbers[row]]];
    if (other === LOST) rows[number] = row;
    else if (other >= 0 && !isEqual(shards, other * width, row * width, width)) rows[number] = CONTRADICTORY;
  }
  const data = new Uint8Array(count * k * width);
  const incomplete: { codeword: Codeword; number: number }[] = [];
  for (let number = 0; number < count; number++) {
    const codeword = Array.from({ length: n }, (_, shard) => {
      const row = rows[shard * count + number];
      return row < 0 ? null : shards.subarray(row * width, (row + 1) * width);
    });
    if (errors) dropErrors(codeword, k);
    if (codeword.filter(Boolean).length < k) throw tooMuchLost();
    const needed = codeword.slice(0, k);
    needed.forEach((shard, row) => shard && data.set(shard, (row * count + number) * width));
    if (needed.includes(null)) incomplete.push({ codeword, number });
  }
  const atOnce = Math.max(1, Math.floor((2 * COLUMNS) / width));
  for (let first = 0; first < incomplete.length; first += atOnce) {
    const some = incomplete.slice(first, first + atOnce);
    restore(some.map(({ codeword }) => codeword), k, width / 2, (at, row, shard) => {
      data.set(shard, (row * count + some[at].number) * width);
    });
  }
  return data;
}

function isEqual(bytes: Uint8Array, a: number, b: number, width: number): boolean {
  for (let at = 0; at < width; at++) if (bytes[a + at] !== bytes[b + at]) return false;
  return true;
}

/** Calls `put` with every lost one of the first k shards of some codewords of `columns` symbols. */
function restore(
  codewords: Codeword[], k: number, columns: number, put: (codeword: number, row: number, shard: Uint8Array) => void,
): void {
  const size = sizeFor(codewords[0].length);
  const width = columns * codewords.length;
  const work = new Uint16Array(size * width);
  const products = codewords.map((shards, codeword) => {
    const found = differences(size, (row) => !shards[row]);
    shards.forEach((shard, row) => {
      if (!shard) return;
      for (let column = 0, to = row * width + codeword * columns; column < columns; column++) {
        work[to + column] = POWERS[found[row] + LOGARITHMS[(shard[2 * column] << 8) | shard[2 * column + 1]]];
      }
    });
    return found;
  });
  toCoefficients(work, size, width);
  differentiate(work, size, width);
  toValues(work, size, width);
  codewords.forEach((shards, codeword) => {
    for (let row = 0; row < k; row++) {
      if (shards[row]) continue;
      const shard = new Uint8Array(2 * columns);
      for (let column = 0, from = row * width + codeword * columns; column < columns; column++) {
        const symbol = POWERS[ORDER - products[codeword][row] + LOGARITHMS[work[from + column]]];
        shard[2 * column] = symbol >> 8;
        shard[2 * column + 1] = symbol & 255;
      }
      put(codeword, row, shard);
    }
  });
}

/** The size of FFTs for `n` points, a power of two. */
function sizeFor(n: number): number {
  let size = 1;
  while (size < n) size *= 2;
  return size;
}

/** [size] logarithms of the products of a point's differences to all other marked ones. */
function differences(size: number, isMarked: (row: number) => boolean): Uint32Array {
  const marked: number[] = [];
  for (let row = 0; row < size; row++) if (isMarked(row)) marked.push(row);
  return Uint32Array.from({ length: size }, (_, at) => {
    let sum = 0; // exact: at most 2^13 logarithms of 2^16
    for (const each of marked) if (each !== at) sum += LOGARITHMS[POINTS[at ^ each]];
    return sum % ORDER;
  });
}

const LOWER = new Uint16Array(256); // products of bytes of a symbol with a twiddle factor
const UPPER = new Uint16Array(256);

/** Adds the products of row `from` and a twiddle factor to row `to`. */
function addProducts(work: Uint16Array, to: number, from: number, width: number): void {
  for (let at = 0; at < width; at++) {
    const symbol = work[from + at];
    work[to + at] ^= LOWER[symbol & 255] ^ UPPER[symbol >> 8];
  }
}

function add(work: Uint16Array, to: number, from: number, width: number): void {
  for (let at = 0; at < width; at++) work[to + at] ^= work[from + at];
}

function prepare(factor: number): void {
  const logarithm = LOGARITHMS[factor];
  for (let byte = 0; byte < 256; byte++) {
    LOWER[byte] = POWERS[logarithm + LOGARITHMS[byte]];
    UPPER[byte] = POWERS[logarithm + LOGARITHMS[byte << 8]];
  }
}

/** From values at POINTS to coefficients in the basis of Lin, Chung and Han: an inverse FFT of each column. */
function toCoefficients(work: Uint16Array, size: number, width: number): void {
  for (let half = 1; half < size; half *= 2) {
    for (let start = 0; start < size; start += 2 * half) {
      prepare(POINTS[start / half]);
      for (let row = start; row < start + half; row++) {
        add(work, (row + half) * width, row * width, width);
        addProducts(work, row * width, (row + half) * width, width);
      }
    }
  }
}

/** Inverts `toCoefficients`. */
function toValues(work: Uint16Array, size: number, width: number): void {
  for (let half = size / 2; half >= 1; half /= 2) {
    for (let start = 0; start < size; start += 2 * half) {
      prepare(POINTS[start / half]);
      for (let row = start; row < start + half; row++) {
        addProducts(work, row * width, (row + half) * width, width);
        add(work, (row + half) * width, row * width, width);
      }
    }
  }
}

/** From coefficients to those of the derivative. */
function differentiate(work: Uint16Array, size: number, width: number): void {
  for (let row = 0; row < size; row++) {
    work.fill(0, row * width, (row + 1) * width);
    for (let half = 1; half < size; half *= 2) {
      if (!(row & half)) add(work, row * width, (row + half) * width, width);
    }
  }
}

/** Sets shards to null that do not belong to the codeword of the majority; all if there are too many errors. */
function dropErrors(shards: Codeword, k: number): void {
  const rows = shards.flatMap((shard, row) => (shard ? [row] : []));
  if (rows.length <= k) return;
  const products = differences(sizeFor(shards.length), (row) => Boolean(shards[row]));
  const powers = rows.map((row) => LOGARITHMS[POINTS[MAX_SHARDS + row]]); // none is zero
  const left = [...shards];
  for (const step of [1, 2]) {
    const terms = rows.map((row) => {
      const shard = left[row]!;
      let sum = 0;
      for (let column = 0; 2 * column < shard.length; column++) {
        const symbol = (shard[2 * column] << 8) | shard[2 * column + 1];
        sum ^= POWERS[LOGARITHMS[symbol] + ((step * column + ORDER - products[row]) % ORDER)];
      }
      return LOGARITHMS[sum];
    });
    const sums = Array.from({ length: Math.min(rows.length - k, 2 * MAX_ERRORS) }, (_, time) =>
      powers.reduce((sum, power, at) => sum ^ POWERS[terms[at] + ((time * power) % ORDER)], 0),
    );
    const locator = sums.some((each) => each !== 0) ? recurrence(sums) : [1];
    rows.forEach((row, at) => {
      const inverse = ORDER - powers[at];
      const located = locator.reduce((sum, each, power) => sum ^ POWERS[LOGARITHMS[each] + ((power * inverse) % ORDER)], 0);
      if (located === 0) shards[row] = null;
    });
  }
}

/** Coefficients, 1 first, of the shortest linear recurrence of a sequence (Berlekamp-Massey). */
function recurrence(sums: number[]): number[] {
  let [coefficients, before, length, since, scale] = [[1], [1], 0, 1, 1];
  for (let index = 0; index < sums.length; index++) {
    const discrepancy = coefficients
      .slice(0, length + 1)
      .reduce((sum, each, back) => sum ^ product(each, sums[index - back]), 0);
    if (discrepancy === 0) {
      since++;
      continue;
    }
    const factor = product(discrepancy, POWERS[ORDER - LOGARITHMS[scale]]);
    const shifted = [...new Array<number>(since).fill(0), ...before.map((each) => product(factor, each))];
    const kept = coefficients;
    coefficients = Array.from({ length: Math.max(coefficients.length, shifted.length) }, (_, at) => (kept[at] ?? 0) ^ (shifted[at] ?? 0));
    if (2 * length <= index) [length, before, scale, since] = [index + 1 - length, kept, discrepancy, 1];
    else since++;
  }
  return coefficients;
}
