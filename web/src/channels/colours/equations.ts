/**
 * Which intermediate bits each code bit of the fountain code is the sum of; `keyss.channels.robust.fountain` on the
 * other side.
 */
import { sortingOrderOfPairs } from '../../core/sorting.ts';
import type { Words } from '../../core/words.ts';
import { mixAt, mixed } from '../mixing.ts';

/** Shares of code bits that are sums of so many. */
export type Degrees = readonly (readonly [number, number])[];

// Shokrollahi 2006, table I, k = 65,536, with more single ones, which decoding starts from.
export const RAPTOR: Degrees = [
  [1, 0.02], [2, 0.486], [3, 0.163], [4, 0.072], [5, 0.081], [8, 0.055], [9, 0.037], [19, 0.055], [65, 0.031],
];
export const NOISY: Degrees = [[1, 0.15], [2, 0.5], [3, 0.25], [4, 0.1]];
const REPEATS = 4; // parity checks that each data bit takes part in
const [RANK_LOW, RANK_HIGH] = [0xd192ed03, 0xd1b54a32]; // of one odd constant

/** Sums of intermediate bits: equation i has the members from starts[i] to starts[i + 1]. */
export interface Equations {
  readonly starts: Uint32Array; // [n + 1]
  readonly members: Uint32Array;
}

/** Those of code bits with these seeds [n], and `more` after them, of `length` intermediate bits. */
export function equations(seeds: Words, length: number, degrees: Degrees, more?: Equations): Equations {
  const count = seeds.length >> 1;
  const most = degrees.map(([degree]) => Math.min(degree, Math.max(1, Math.floor(length / 4))));
  const bounds: number[] = [];
  for (const [, share] of degrees) bounds.push((bounds.at(-1) ?? 0) + share);
  bounds.pop();
  const starts = new Uint32Array(count + (more ? more.starts.length : 1));
  const scratch = new Uint32Array(2);
  for (let row = 0; row < count; row++) {
    scratch[0] = seeds[2 * row];
    scratch[1] = seeds[2 * row + 1];
    mixAt(scratch, 0);
    const uniform = (scratch[1] * 2 ** 32 + scratch[0]) / 2 ** 64;
    let chosen = 0;
    while (chosen < bounds.length && bounds[chosen] <= uniform) chosen++;
    starts[row + 1] = starts[row] + most[chosen];
  }
  const members = new Uint32Array(starts[count] + (more ? more.members.length : 0));
  for (let row = 0; row < count; row++) {
    // The product of (rank + 1) and an odd constant, one sum after the other.
    let [low, high] = [0, 0];
    for (let at = starts[row]; at < starts[row + 1]; at++) {
      low += RANK_LOW;
      high = (high + RANK_HIGH + (low > 0xffffffff ? 1 : 0)) >>> 0;
      low >>>= 0;
      scratch[0] = seeds[2 * row] ^ low;
      scratch[1] = seeds[2 * row + 1] ^ high;
      mixAt(scratch, 0);
      members[at] = scaled(scratch[1], length);
    }
  }
  if (more) {
    more.starts.forEach((start, index) => (starts[count + index] = starts[count] + start));
    members.set(more.members, starts[count]);
  }
  return { starts, members };
}

/** [parity] checks: of some data bits, a parity bit and the one before it (irregular repeat-accumulate). */
export function parityChecks(size: number, parity: number): Equations {
  const count = size * REPEATS;
  const keys = new Uint32Array(2 * count);
  const [low, high] = [(size << 20) >>> 0, size >>> 12];
  for (let at = 0; at < count; at++) {
    keys[2 * at] = at ^ low;
    keys[2 * at + 1] = high;
  }
  const check = new Uint32Array(count);
  sortingOrderOfPairs(mixed(keys)).forEach((row, at) => (check[row] = at % parity));
  const starts = new Uint32Array(parity + 1);
  for (const row of check) starts[row + 1]++;
  for (let row = 0; row < parity; row++) starts[row + 1] += starts[row] + (row ? 2 : 1);
  const members = new Uint32Array(starts[parity]);
  const ends = starts.slice(0, parity);
  check.forEach((row, at) => (members[ends[row]++] = Math.floor(at / REPEATS)));
  for (let row = 0; row < parity; row++) {
    if (row) members[ends[row]++] = size + row - 1;
    members[ends[row]++] = size + row;
  }
  return { starts, members };
}

/** `number` of 32 bits times `length` below 2^31, divided by 2^32. */
function scaled(number: number, length: number): number {
  const high = Math.floor(number / 0x10000) * length;
  return Math.floor((high + Math.floor(((number & 0xffff) * length) / 0x10000)) / 0x10000);
}
