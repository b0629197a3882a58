/**
 * A rateless code, read softly: any bits of it, in any order, some of them wrong, give the data back (Shokrollahi 2006;
 * Etesami and Shokrollahi 2006). `keyss.channels.robust.fountain` on the other side.
 */
import type { Words } from '../../core/words.ts';
import { type Degrees, type Equations, equations, parityChecks, RAPTOR } from './equations.ts';

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
