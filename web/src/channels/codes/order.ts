/**
 * Orders of Gaussians: one in which bits are counted, and that of the file; `keyss.channels.codes.order` on the other
 * side.
 *
 * A .sog is sorted by what is written; its bits are counted in an order of what is not.
 */
import type { Codes } from '../../files/models.ts';
import { LARGEST, type SogCodes } from '../../files/sog.ts';
import { type Field, fieldsOf, sogDistance } from './fields.ts';
import { sortingOrder } from '../../core/sorting.ts';

const [FACTOR_HIGH, FACTOR_LOW] = [0x9e3779b9, 0x7f4a7c15];

/** The last bits of all levels, each 0 or 1, in the order in which they are counted. */
export function lastBits(codes: Codes): Uint8Array {
  const rows = codes.kind === 'sog' ? sogOrder(codes) : null;
  const fields = fieldsOf(codes);
  const count = rows?.length ?? codes.count;
  const rowAt = (index: number): number => (rows === null ? index : rows[index]);
  let size = 0;
  for (const { bits } of fields) for (let index = 0; index < count; index++) size += bits[rowAt(index)];
  const found = new Uint8Array(size);
  let at = 0;
  for (const { levels, bits } of fields as Field[]) {
    for (let index = 0; index < count; index++) {
      const row = rowAt(index);
      for (let bit = 0; bit < bits[row]; bit++) found[at++] = (levels[row] >> bit) & 1;
    }
  }
  return found;
}

/** Gaussians by hashes of what is not written, without those that share one: these carry nothing. */
function sogOrder(codes: SogCodes): Uint32Array {
  const { count } = codes;
  const { low, high } = hashes(count, [
    ...[0, 1, 2].map((axis) => (row: number) => codes.scales[4 * row + axis]),
    ...[0, 1, 2, 3].map((part) => (row: number) => codes.colours[4 * row + part]),
    (row) => codes.labels[row],
    (row) => codes.quats[4 * row + 3] - LARGEST,
    ...[0, 1, 2].map((axis) => (row: number) => sogDistance(codes, row, axis)),
  ]);
  const rows = sortingOrder(low, high);
  const alike = (a: number, b: number): boolean =>
    b >= 0 && b < count && low[rows[a]] === low[rows[b]] && high[rows[a]] === high[rows[b]];
  return rows.filter((_, index) => !alike(index, index - 1) && !alike(index, index + 1));
}

/** Of each Gaussian a hash of 64 bits of all columns: times a constant, and the upper bits added to the lower ones. */
function hashes(count: number, columns: ((row: number) => number)[]): { low: Uint32Array; high: Uint32Array } {
  const [low, high] = [new Uint32Array(count), new Uint32Array(count)];
  for (const column of columns) {
    for (let row = 0; row < count; row++) {
      const a = (low[row] ^ column(row)) >>> 0;
      const lower = Math.imul(a, FACTOR_LOW) >>> 0;
      const upper = (upperProduct(a, FACTOR_LOW) + Math.imul(a, FACTOR_HIGH) + Math.imul(high[row], FACTOR_LOW)) >>> 0;
      low[row] = lower ^ ((lower >>> 29) | (upper << 3));
      high[row] = upper ^ (upper >>> 29);
    }
  }
  return { low, high };
}

/** The upper 32 of the 64 bits of a product. */
function upperProduct(a: number, b: number): number {
  const [a0, a1, b0, b1] = [a & 0xffff, a >>> 16, b & 0xffff, b >>> 16];
  const middle = a1 * b0 + ((a0 * b0) >>> 16);
  return a1 * b1 + Math.floor(middle / 65536) + Math.floor(((middle & 0xffff) + a0 * b1) / 65536);
}
