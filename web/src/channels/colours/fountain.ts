/**
 * A rateless code, read softly: any bits of it, in any order, some of them wrong, give the data back (Shokrollahi 2006;
 * Etesami and Shokrollahi 2006). `keyss.channels.colours.fountain` on the other side.
 */
import { mix, mixed, sortingOrder, type Words } from '../../core/words.ts';

/** Shares of code bits that are sums of so many. */
type Degrees = readonly (readonly [number, number])[];

// Shokrollahi 2006, table I, k = 65,536, with more single ones, which decoding starts from.
export const RAPTOR: Degrees = [
  [1, 0.02], [2, 0.486], [3, 0.163], [4, 0.072], [5, 0.081], [8, 0.055], [9, 0.037], [19, 0.055], [65, 0.031],
];
export const NOISY: Degrees = [[1, 0.15], [2, 0.5], [3, 0.25], [4, 0.1]];
const REPEATS = 4; // parity checks that each data bit takes part in
const [RANK_LOW, RANK_HIGH] = [0xd192ed03, 0xd1b54a32]; // of one odd constant
const SURE = 25; // log-likelihood ratio of what is known
const MOST = 30; // of any message
const NEARLY_SURE = 0.9999999999;
const SETTLED = 3; // rounds in a row in which the parity checks have to hold

/** The code for `size` data bits. */
export class Fountain {
  readonly length: number; // intermediate bits
  private readonly parity: number;
  private readonly checks: Equations;

  constructor(readonly size: number, private readonly degrees: Degrees = RAPTOR) {
    this.parity = 64 + Math.floor(size / 25);
    this.length = size + this.parity;
    this.checks = parityChecks(size, this.parity);
  }

  /** [n] the code bits of `seeds` [n] for data bits [size]. */
  encode(data: ArrayLike<number>, seeds: Words): Uint8Array {
    const every = new Uint8Array(this.length);
    every.set(data);
    const { starts, members } = this.checks;
    for (let check = 0; check < this.parity; check++) {
      const own = this.size + check; // the last member: all others are known by now
      for (let at = starts[check]; at < starts[check + 1] - 1; at++) every[own] ^= every[members[at]];
    }
    return this.sums(every, seeds);
  }

  /** [n] the code bits of `seeds` [n] for intermediate bits [length]. */
  sums(every: Uint8Array, seeds: Words): Uint8Array {
    const { starts, members } = equations(seeds, this.length, this.degrees);
    const found = new Uint8Array(seeds.length >> 1);
    for (let row = 0; row < found.length; row++) {
      for (let at = starts[row]; at < starts[row + 1]; at++) found[row] ^= every[members[at]];
    }
    return found;
  }

  /**
   * The likeliest intermediate bits [length], of which the first `size` are data. `ratios` [n]: natural logarithms of
   * P(0) / P(1) of the code bits of `seeds` [n]. Takes at most `rounds` passes.
   */
  likeliest(seeds: Words, ratios: Float32Array, rounds: number): Uint8Array {
    const all = equations(seeds, this.length, this.degrees, this.checks);
    const given = new Float32Array(all.starts.length - 1).fill(SURE);
    ratios.forEach((ratio, row) => (given[row] = Math.max(-SURE, Math.min(SURE, ratio))));
    const total = propagated(all, given, this.length, this.parity, rounds);
    return Uint8Array.from(total, (each) => (each < 0 ? 1 : 0));
  }
}

/** Totals [length] after belief propagation, one check after the other; the last `parity` checks have to hold. */
function propagated(
  { starts, members }: Equations, given: Float32Array, length: number, parity: number, rounds: number,
): Float32Array {
  const total = new Float32Array(length);
  const sent = new Float32Array(members.length);
  const checks = given.length;
  let widest = 1;
  for (let check = 0; check < checks; check++) widest = Math.max(widest, starts[check + 1] - starts[check]);
  const before = new Float64Array(widest + 1);
  const factor = new Float64Array(widest);
  for (let round = 0, held = 0; round < rounds && held < SETTLED; round++) {
    for (let check = 0; check < checks; check++) {
      const first = starts[check];
      const degree = starts[check + 1] - first;
      before[0] = halfTangent(given[check]);
      for (let i = 0; i < degree; i++) {
        factor[i] = halfTangent(total[members[first + i]] - sent[first + i]);
        before[i + 1] = before[i] * factor[i];
      }
      let after = 1;
      for (let i = degree - 1; i >= 0; i--) {
        const product = before[i] * after;
        after *= factor[i];
        let message = MOST;
        if (product < -NEARLY_SURE) message = -MOST;
        else if (product <= NEARLY_SURE) message = Math.log((1 + product) / (1 - product));
        total[members[first + i]] += Math.fround(message) - sent[first + i];
        sent[first + i] = message;
      }
    }
    held = parityHolds(starts, members, total, checks - parity) ? held + 1 : 0;
  }
  return total;
}

function parityHolds(starts: Uint32Array, members: Uint32Array, total: Float32Array, first: number): boolean {
  for (let check = first; check < starts.length - 1; check++) {
    let odd = false;
    for (let at = starts[check]; at < starts[check + 1]; at++) odd = odd !== total[members[at]] < 0;
    if (odd) return false;
  }
  return true;
}

/** tanh(x / 2), which is several times faster this way. */
function halfTangent(x: number): number {
  return x > 40 ? 1 : 1 - 2 / (Math.exp(x) + 1);
}

/** Sums of intermediate bits: equation i has the members from starts[i] to starts[i + 1]. */
interface Equations {
  readonly starts: Uint32Array; // [n + 1]
  readonly members: Uint32Array;
}

/** Those of code bits with these seeds [n], and `more` after them, of `length` intermediate bits. */
function equations(seeds: Words, length: number, degrees: Degrees, more?: Equations): Equations {
  const count = seeds.length >> 1;
  const most = degrees.map(([degree]) => Math.min(degree, Math.max(1, Math.floor(length / 4))));
  const bounds: number[] = [];
  for (const [, share] of degrees) bounds.push((bounds.at(-1) ?? 0) + share);
  bounds.pop();
  const starts = new Uint32Array(count + (more ? more.starts.length : 1));
  for (let row = 0; row < count; row++) {
    const found = mix(seeds[2 * row], seeds[2 * row + 1]);
    const uniform = (found[1] * 2 ** 32 + found[0]) / 2 ** 64;
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
      members[at] = scaled(mix(seeds[2 * row] ^ low, seeds[2 * row + 1] ^ high)[1], length);
    }
  }
  if (more) {
    more.starts.forEach((start, index) => (starts[count + index] = starts[count] + start));
    members.set(more.members, starts[count]);
  }
  return { starts, members };
}

/** [parity] checks: of some data bits, a parity bit and the one before it (irregular repeat-accumulate). */
function parityChecks(size: number, parity: number): Equations {
  const count = size * REPEATS;
  const keys = new Uint32Array(2 * count);
  const [low, high] = [(size << 20) >>> 0, size >>> 12];
  for (let at = 0; at < count; at++) {
    keys[2 * at] = at ^ low;
    keys[2 * at + 1] = high;
  }
  const check = new Uint32Array(count);
  sortingOrder(mixed(keys)).forEach((row, at) => (check[row] = at % parity));
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
