/** A rateless code with soft decoding (Shokrollahi 2006; Etesami and Shokrollahi 2006); `keyss.channels.colours.fountain`. */
import { mix, mixed, sortingOrder, type Words } from '../../core/words.ts';

// Degree distribution: the number of intermediate bits in the sum of each of 128 code bits.
const RAPTOR = repeated([[1, 3], [2, 62], [3, 21], [4, 9], [5, 10], [8, 7], [9, 5], [19, 7], [65, 4]]);
export const NOISY = repeated([[1, 19], [2, 64], [3, 32], [4, 13]]);
const REPEATS = 4; // parity bits per data bit
const [ROUNDS, SETTLED] = [60, 3];
const [SURE, LEAST] = [1 - 1e-6, 1e-12]; // limits of |P(0) - P(1)|
const [RANK_LOW, RANK_HIGH] = [0xd192ed03, 0xd1b54a32]; // halves of an odd constant

function repeated(counts: readonly (readonly [number, number])[]): number[] {
  return counts.flatMap(([degree, count]) => new Array<number>(count).fill(degree));
}

/** Sums of intermediate bits; equation i has the next `degrees[i]` members. */
interface Equations {
  readonly degrees: Uint16Array;
  readonly members: Uint32Array;
}

/** The code for `size` data bits. */
export class Fountain {
  private readonly parity: number;

  constructor(readonly size: number, private readonly degrees = RAPTOR) {
    this.parity = 64 + Math.floor(size / 25);
  }

  /** [n] the code bits of `seeds` [n] for data bits [size]. */
  encode(data: ArrayLike<number>, seeds: Words): Uint8Array {
    const bits = Uint8Array.from(data);
    return sums(Uint8Array.from([...bits, ...sums(bits, this.checks())]), this.equations(seeds));
  }

  /** The likeliest data bits [size]; `hints` [n]: P(0) - P(1) of the code bits of `seeds` [n]. */
  decode(seeds: Words, hints: ArrayLike<number>): Uint8Array {
    const [own, checks] = [this.equations(seeds), this.checks()];
    const width = checks.degrees[0];
    const degrees = Uint16Array.from([...own.degrees, ...checks.degrees.map((degree) => degree + 1)]);
    const members = new Uint32Array(own.members.length + this.parity * (width + 1));
    members.set(own.members);
    for (let check = 0, at = own.members.length; check < this.parity; check++, at += width + 1) {
      members.set(checks.members.subarray(check * width, (check + 1) * width), at);
      members[at + width] = this.size + check;
    }
    const [sent, sizes] = [new Float64Array(members.length), new Float64Array(members.length)];
    let total = new Float64Array(this.size + this.parity);
    for (let round = 0, settled = 0; round < ROUNDS && settled < SETTLED; round++) {
      const next = new Float64Array(total.length);
      for (let row = 0, start = 0; row < degrees.length; start += degrees[row++]) {
        const known = row < hints.length ? Math.max(-SURE, Math.min(SURE, hints[row])) : SURE;
        let [size, sign] = [Math.log(Math.abs(known) + LEAST), known < 0 ? -1 : 1];
        for (let at = start; at < start + degrees[row]; at++) {
          const belief = 1 - 2 / (Math.exp(total[members[at]] - sent[at]) + 1); // tanh(x / 2), several times faster
          sizes[at] = Math.log(Math.abs(belief) + LEAST);
          size += sizes[at];
          sent[at] = belief < 0 ? -1 : 1; // the sign only, until the sum is known
          sign *= sent[at];
        }
        for (let at = start; at < start + degrees[row]; at++) {
          const product = Math.min(SURE, Math.exp(size - sizes[at]));
          sent[at] *= sign * Math.log((1 + product) / (1 - product));
          next[members[at]] += sent[at];
        }
      }
      settled = total.every((each, bit) => each < 0 === next[bit] < 0) ? settled + 1 : 0;
      total = next;
    }
    return Uint8Array.from(total.subarray(0, this.size), (each) => (each < 0 ? 1 : 0));
  }

  private equations(seeds: Words): Equations {
    const length = this.size + this.parity;
    const degrees = Uint16Array.from({ length: seeds.length >> 1 }, (_, row) => {
      return Math.min(this.degrees[mix(seeds[2 * row], seeds[2 * row + 1])[1] >>> 25], Math.floor(length / 4));
    });
    return { degrees, members: drawn(seeds, degrees, length) };
  }

  /** The data bits summed in each parity bit. */
  private checks(): Equations {
    const all = REPEATS * this.size;
    const order = sortingOrder(mixed(Uint32Array.from({ length: 2 * all }, (_, at) => (at % 2 ? 0 : at / 2))));
    const degrees = new Uint16Array(this.parity).fill(Math.ceil(all / this.parity));
    const members = Uint32Array.from({ length: this.parity * degrees[0] }, (_, at) => Math.floor(order[at % all] / REPEATS));
    return { degrees, members };
  }
}

function sums(bits: Uint8Array, { degrees, members }: Equations): Uint8Array {
  let at = 0;
  return Uint8Array.from(degrees, (degree) => {
    let sum = 0;
    for (let end = at + degree; at < end; at++) sum ^= bits[members[at]];
    return sum;
  });
}

/** For each seed, `degrees` pseudo-random numbers below `length`. */
function drawn(seeds: Words, degrees: Uint16Array, length: number): Uint32Array {
  const found = new Uint32Array(degrees.reduce((sum, each) => sum + each, 0));
  let at = 0;
  degrees.forEach((degree, row) => {
    let [low, high] = [0, 0]; // rank (from 1) times the constant
    for (let end = at + degree; at < end; at++) {
      low += RANK_LOW;
      high = (high + RANK_HIGH + (low > 0xffffffff ? 1 : 0)) >>> 0;
      low >>>= 0;
      // A number of 32 bits times `length`, divided by 2^32: exact below 2^53.
      found[at] = Math.floor((mix(seeds[2 * row] ^ low, seeds[2 * row + 1] ^ high)[1] * length) / 2 ** 32);
    }
  });
  return found;
}
