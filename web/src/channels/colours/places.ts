/** Where headers may be: names by a public hash, and what the Gaussians there say; `Index` in keyss's `robust.header`. */
import { chacha20 } from '@noble/ciphers/chacha.js';
import { sha256 } from '@noble/hashes/sha2.js';
import { ascii } from '../../core/bytes.ts';
import { sortingOrderOfPairs } from '../../core/sorting.ts';
import { same, type Words, wordsOf } from '../../core/words.ts';
import { expand } from '../../keys/derivation.ts';
import { mixAt } from '../mixing.ts';
import { type Carriers, chosen } from './carriers.ts';
import { bitsOf, COLUMNS, dithers, type Lattice, LEVELS, rank, readBits, seedsOf, SPACINGS } from './lattice.ts';

const PILOTS = 16; // numbers of each salt's part that are known beforehand
const PRIOR = 0.4; // logarithm of the odds that a salt is one, before anything else is known
const PUBLIC = sha256(ascii('keyss/v1/robust-places'));
const [PAD_LOW, PAD_HIGH] = [0x1e98df25, 0x9fb21c65];

/** How headers are written: in how many Gaussians for each salt, and by a lattice that gives as many bits to all. */
export interface Kind {
  readonly places: number;
  readonly lattice: Lattice;
}

const [ALL, NEAR] = [LEVELS - 1, SPACINGS[0]];
export const KINDS: readonly Kind[] = [
  { places: 64, lattice: { level: ALL, spacing: NEAR, depth: 1 } },
  { places: 96, lattice: { level: ALL, spacing: NEAR, depth: 2 } },
];
export const USUAL = [0.65];

/** Code bits of a header under S salts, as V Gaussians of each place say; hints are P(0) - P(1). */
export interface Parts {
  readonly seeds: Words; // [V, S, B]
  readonly hints: Float64Array; // [V, S, B]
  readonly pilots: Float64Array; // [V, S, PILOTS] the same of bits that are 0
}

/** Carriers by the public hash of their names. */
export class Index {
  private readonly hashes: Words; // [P] ascending, each once
  private readonly first: Uint32Array; // [P] a carrier with each name
  private readonly alike: Uint32Array; // [P] how many have it

  constructor(private readonly carriers: Carriers) {
    const { lattice } = KINDS[KINDS.length - 1];
    const bits = bitsOf(lattice, carriers);
    const hashes = rank(PUBLIC, 'places', carriers.names);
    const order = sortingOrderOfPairs(hashes).filter((row) => bits[row] === lattice.depth); // all but impossible sizes
    const [first, alike] = [new Uint32Array(order.length), new Uint32Array(order.length)];
    let size = 0;
    for (let at = 0; at < order.length; at++) {
      if (at === 0 || !same(hashes, order[at], order[at - 1])) first[size++] = order[at];
      alike[size - 1]++;
    }
    [this.first, this.alike, this.hashes] = [first.subarray(0, size), alike, new Uint32Array(2 * size)];
    for (let at = 0; at < size; at++) {
      this.hashes[2 * at] = hashes[2 * first[at]];
      this.hashes[2 * at + 1] = hashes[2 * first[at] + 1];
    }
  }

  get size(): number {
    return this.first.length;
  }

  /** [count] names that this secret's header is in, or those so many behind. */
  places(secret: Uint8Array, count: number, behind = 0): Uint32Array {
    const key = expand(secret, 'robust/places', 32);
    const points = wordsOf(chacha20(key, new Uint8Array(12), new Uint8Array(8 * count)));
    const found = new Uint32Array(count);
    for (let at = 0; at < count; at++) {
      found[at] = (this.firstFrom(points[2 * at], points[2 * at + 1]) + behind) % this.size;
    }
    return found;
  }

  /** [...] a carrier with each name. */
  rows(places: Uint32Array): Uint32Array {
    return places.map((place) => this.first[place]);
  }

  /** What the first `most` Gaussians of each salt hold, if it is one. */
  parts(secrets: readonly Uint8Array[], kind: Kind, view: readonly number[], most: number): Parts {
    const bits = COLUMNS * kind.lattice.depth;
    const width = most * bits - PILOTS;
    const found = {
      seeds: new Uint32Array(2 * view.length * secrets.length * width),
      hints: new Float64Array(view.length * secrets.length * width),
      pilots: new Float64Array(view.length * secrets.length * PILOTS),
    };
    view.forEach((sure, behind) => secrets.forEach((secret, salt) => {
      const part = behind * secrets.length + salt;
      const places = this.places(secret, most, behind);
      const own = chosen(this.carriers, this.rows(places));
      const words = seedsOf(rank(secret, 'header-seeds', own.names), new Uint8Array(most).fill(bits));
      const full = new Uint8Array(most).fill(kind.lattice.depth);
      const read = readBits(kind.lattice, dithers(secret, own.names), own, new Float64Array(most), full);
      const hints = Float64Array.from(read, (ratio, bit) => {
        const at = Math.floor(bit / bits);
        const certain = (sure * (1 - own.doubt[at])) / this.alike[places[at]];
        return Math.tanh(ratio / 2) * certain * (isPadded(words, bit) ? -1 : 1);
      });
      found.pilots.set(hints.subarray(0, PILOTS), part * PILOTS);
      found.hints.set(hints.subarray(PILOTS), part * width);
      found.seeds.set(words.subarray(2 * PILOTS), 2 * part * width);
    }));
    return found;
  }

  /** How much likelier what is known beforehand is with a header than without: a logarithm. */
  promise(secrets: readonly Uint8Array[]): number {
    if (!this.size || !secrets.length) return -Infinity;
    return Math.max(...KINDS.map((kind) => {
      const parts = this.parts(secrets, kind, USUAL, PILOTS / (COLUMNS * kind.lattice.depth));
      const odds = oddsOf(parts, secrets.length);
      return odds.reduce((sum, each) => sum + Math.log1p(Math.exp(Math.max(-50, Math.min(50, each)))), 0);
    }));
  }

  /** The first place whose hash is at least this word; `size` where there is none. */
  private firstFrom(low: number, high: number): number {
    let [from, to] = [0, this.size];
    while (from < to) {
      const middle = (from + to) >> 1;
      const difference = this.hashes[2 * middle + 1] - high || this.hashes[2 * middle] - low;
      if (difference < 0) from = middle + 1;
      else to = middle;
    }
    return from;
  }
}

/** [S] logarithms of the odds that each of the salts is one. */
export function oddsOf({ pilots }: Parts, salts: number): number[] {
  const odds = new Array<number>(salts).fill(PRIOR);
  pilots.forEach((hint, at) => (odds[Math.floor(at / PILOTS) % salts] += Math.log1p(Math.max(-0.99, hint))));
  return odds;
}

const scratch = new Uint32Array(2);

/** Whether the code bit with this seed is encrypted by a one. */
function isPadded(seeds: Words, at: number): boolean {
  scratch[0] = seeds[2 * at] ^ PAD_LOW;
  scratch[1] = seeds[2 * at + 1] ^ PAD_HIGH;
  mixAt(scratch, 0);
  return scratch[1] >>> 31 === 1;
}
