/** Reed-Solomon over GF(256) for erasures; see docs/format.md, "A payload". */
import { tooMuchLost } from '../core/errors.ts';
import { mix } from '../core/words.ts';

const TRIES = 2000; // of k chunks, in all codewords together

const POWERS = new Uint8Array(510);
const LOGARITHMS = new Uint8Array(256);
for (let exponent = 0, value = 1; exponent < 255; exponent++) {
  POWERS[exponent] = POWERS[exponent + 255] = value;
  LOGARITHMS[value] = exponent;
  value = (value << 1) ^ (value & 128 ? 0x11d : 0);
}

function product(a: number, b: number): number {
  return a && b ? POWERS[LOGARITHMS[a] + LOGARITHMS[b]] : 0;
}

/** `to` += factor x `from`, over the field. */
function addMultiple(to: Uint8Array, factor: number, from: Uint8Array): void {
  if (!factor) return;
  const logarithm = LOGARITHMS[factor];
  for (let at = 0; at < to.length; at++) {
    if (from[at]) to[at] ^= POWERS[logarithm + LOGARITHMS[from[at]]];
  }
}

/**
 * Data in `count` codewords of `n` chunks of `width` bytes, any `k` of which give a codeword back. Chunk i of codeword c
 * has the number i x `count` + c.
 */
export interface Codewords {
  readonly count: number;
  readonly n: number;
  readonly k: number;
  readonly width: number;
}

/**
 * The data from numbered chunks in any order. `errors`: some may be there by chance. Raises InputError where too few are
 * left.
 */
export function decoded(
  { count, n, k, width }: Codewords, chunks: Iterable<readonly [number, Uint8Array]>, errors = false,
): Uint8Array {
  const left = new Map<number, Uint8Array | null>(); // null: of different chunks with one number, one is there by chance
  for (const [number, chunk] of chunks) {
    const other = left.get(number);
    const alike = other === undefined || (other?.every((each, at) => each === chunk[at]) ?? false);
    if (number < count * n) left.set(number, alike ? chunk : null);
  }
  if (left.size < count * k) throw tooMuchLost(); // before there is memory for that many
  const data = new Uint8Array(count * k * width);
  let tries = errors ? TRIES : 0;
  for (let codeword = 0; codeword < count; codeword++) {
    const rows = new Map<number, Uint8Array>();
    for (let row = 0; row < n; row++) {
      const chunk = left.get(row * count + codeword);
      if (chunk) rows.set(row, chunk);
    }
    let found = decodeCodeword(rows, k, n);
    // No other codeword has as many chunks that agree as one that at most half of those beyond k disagree with.
    while (found && tries > 0 && disagreeing(found, rows, n) > (rows.size - k) / 2) {
      const order = new Map([...rows.keys()].map((row) => [row, mix(row, tries)[1]]));
      const some = [...rows].sort(([a], [b]) => order.get(a)! - order.get(b)!).slice(0, k);
      found = decodeCodeword(new Map(some), k, n);
      tries--;
    }
    if (found === null) throw tooMuchLost();
    found.forEach((row, index) => data.set(row, (index * count + codeword) * width));
  }
  return data;
}

/** How many rows are not those of the codeword of some data. */
function disagreeing(data: Uint8Array[], rows: Map<number, Uint8Array>, n: number): number {
  const matrix = parityMatrix(data.length, n);
  let found = 0;
  for (const [index, row] of rows) {
    const left = row.slice();
    if (index < data.length) addMultiple(left, 1, data[index]);
    else data.forEach((own, column) => addMultiple(left, matrix[index - data.length][column], own));
    if (left.some((each) => each !== 0)) found++;
  }
  return found;
}

/** The k data rows from any k rows of a codeword of n, by their number; null if there are fewer. */
function decodeCodeword(rows: Map<number, Uint8Array>, k: number, n: number): Uint8Array[] | null {
  if (rows.size < k) return null;
  const data: Uint8Array[] = Array.from({ length: k }, (_, index) => rows.get(index)!);
  const lost = [...data.keys()].filter((index) => data[index] === undefined);
  if (!lost.length) return data;
  const matrix = parityMatrix(k, n);
  const parity = [...rows.keys()].filter((index) => index >= k).sort((a, b) => a - b).slice(0, lost.length);
  const work = parity.map((index) => {
    const coefficients = matrix[index - k];
    const right = rows.get(index)!.slice();
    for (let column = 0; column < k; column++) {
      if (data[column] !== undefined) addMultiple(right, coefficients[column], data[column]);
    }
    return { left: Uint8Array.from(lost, (column) => coefficients[column]), right };
  });
  for (let column = 0; column < lost.length; column++) {
    const pivot = work.findIndex((row, index) => index >= column && row.left[column]);
    [work[column], work[pivot]] = [work[pivot], work[column]];
    const inverse = POWERS[255 - LOGARITHMS[work[column].left[column]]];
    work[column].left = work[column].left.map((value) => product(value, inverse));
    work[column].right = work[column].right.map((value) => product(value, inverse));
    for (const row of work) {
      const factor = row.left[column];
      if (row === work[column] || !factor) continue;
      addMultiple(row.left, factor, work[column].left);
      addMultiple(row.right, factor, work[column].right);
    }
  }
  lost.forEach((index, row) => (data[index] = work[row].right));
  return data;
}

let latest = { k: 0, n: 0, matrix: [] as Uint8Array[] };

/** [n - k][k]: column i is x^(n-1-i) modulo the generator polynomial. */
function parityMatrix(k: number, n: number): Uint8Array[] {
  if (latest.k === k && latest.n === n) return latest.matrix;
  const size = n - k;
  let generator = new Uint8Array(size + 1); // of the highest power first
  generator[0] = 1;
  for (let exponent = 0; exponent < size; exponent++) {
    const next = generator.slice();
    for (let at = 1; at <= size; at++) next[at] ^= product(POWERS[exponent], generator[at - 1]);
    generator = next;
  }
  const matrix = Array.from({ length: size }, () => new Uint8Array(k));
  let remainder = generator.slice(1);
  for (let column = k - 1; column >= 0; column--) {
    matrix.forEach((row, index) => (row[column] = remainder[index]));
    const lead = remainder[0];
    const next = new Uint8Array(size);
    for (let at = 0; at < size; at++) next[at] = (remainder[at + 1] ?? 0) ^ product(lead, generator[at + 1]);
    remainder = next;
  }
  latest = { k, n, matrix };
  return matrix;
}
