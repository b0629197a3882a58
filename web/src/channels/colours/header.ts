/**
 * The header, on which a key is tried first: how to read the rest, in a few Gaussians that the key chooses;
 * `keyss.channels.colours.header` on the other side.
 */
import { chacha20 } from '@noble/ciphers/chacha.js';
import { hmac } from '@noble/hashes/hmac.js';
import { sha256 } from '@noble/hashes/sha2.js';
import { ascii } from '../../core/bytes.ts';
import { mix, runs, sortingOrder, type Words, wordsOf } from '../../core/words.ts';
import { expand } from '../../keys/keys.ts';
import { type Carriers, chosen } from './carriers.ts';
import { Fountain, NOISY } from './fountain.ts';
import { COLUMNS, dithers, MAX_BITS, rank, readBits, seedsOf, sum } from './lattice.ts';

export const FILE_KEY_BYTES = 5;
export const SHARES = 256; // parts of the carriers; a payload has some of them
export const IDLE = 1 / 32; // unit of the share of carriers that were left alone
const PARTITION_BYTES = 2;
const CHECK_BYTES = 2;
export const HEADER_BYTES = 14;
const ROUNDS = 20;
const TRIES = 3; // to tell salts that were lost
const [MIN_TRUST, MAX_TRUST] = [0.02, 0.95];
const DECODED = 0.3; // weight of a bit that was decoded beside one that was known
const PILOTS = 16; // numbers of each salt's part that are known beforehand
const PRIOR = 0.4; // logarithm of the odds that a salt is one, before anything else is known
const PUBLIC = sha256(ascii('keyss/v1/colours-places'));
const [PAD_LOW, PAD_HIGH] = [0x1e98df25, 0x9fb21c65];

/** How headers are written: in how many Gaussians for each salt, with how many bits in each of their numbers. */
export interface Kind {
  readonly places: number;
  readonly depth: number;
}

const KINDS: readonly Kind[] = [{ places: 64, depth: 1 }, { places: 96, depth: 2 }];
// How likely a place, and the ones after it, hold what was written: in an ordinary model; in two merged ones.
const [USUAL, MERGED] = [[0.65], [0.4, 0.2]];
export const VIEWS: readonly (readonly [Kind, readonly number[]])[] = [
  [KINDS[0], USUAL], [KINDS[1], USUAL], [KINDS[1], MERGED],
];

const fountain = new Fountain(8 * HEADER_BYTES, NOISY);

/** How a payload is read. */
export interface Header {
  readonly fileKey: Uint8Array;
  readonly partition: Uint8Array; // by which carriers are shared out
  readonly level: number; // of `bitCounts`
  readonly depth: number;
  readonly first: number; // of SHARES that the payload has,
  readonly last: number; // this one included
  readonly bucket: number;
  readonly idle: number; // share of its carriers that hold nothing, in units of IDLE
  readonly bits: Uint8Array; // of all this, as they were read
}

/** The kind of the header of a payload. */
export function kindOf(header: Header): Kind {
  return KINDS[Math.min(KINDS.length, header.depth) - 1];
}

/** Rows of the carriers that the payload has. */
export function ownRows(header: Header, carriers: Carriers): number[] {
  const parts = rank(header.partition, 'partition', carriers.names);
  const found: number[] = [];
  for (let row = 0; row < carriers.count; row++) {
    const part = parts[2 * row] % SHARES;
    if (part >= header.first && part <= header.last) found.push(row);
  }
  return found;
}

/** The size that a number of one byte stands for: 32 to 2 million bytes. */
export function bucketBytes(bucket: number): number {
  return (16 + (bucket % 16)) << (Math.floor(bucket / 16) + 1);
}

/** The header of this kind whose parts lie under these secrets, if there is one. */
export function readHeader(
  secrets: readonly Uint8Array[], check: Uint8Array, index: Index, kind: Kind, view: readonly number[],
): Header | null {
  if (!index.size || !secrets.length) return null;
  const parts = index.parts(secrets, kind, view);
  const seeds = Uint32Array.from(parts.flatMap((part) => [...part.seeds]));
  const odds = oddsOf(parts, secrets.length);
  let trusts = odds.map(trust);
  for (let attempt = 0; attempt < TRIES; attempt++) {
    const ratios = Float32Array.from(parts.flatMap(({ hints, salt }) => [...hints].map((hint) => {
      return 2 * Math.atanh(Math.max(-0.9999, Math.min(0.9999, hint * trusts[salt])));
    })));
    const every = fountain.likeliest(seeds, ratios, ROUNDS);
    const header = unpackHeader(every.subarray(0, fountain.size), check);
    if (header !== null) return header;
    const agree = odds.slice();
    for (const part of parts) agree[part.salt] += DECODED * agreement(signed(part.hints, fountain.sums(every, part.seeds)));
    trusts = agree.map(trust);
  }
  return null;
}

/** How far what lies under these secrets agrees with the header: 0 by chance. */
export function headerAgreement(header: Header, secrets: readonly Uint8Array[], index: Index): number {
  if (!index.size) return 0;
  return index.parts(secrets, kindOf(header), USUAL).reduce((before, { seeds, hints, pilots }) => {
    return before + sum(pilots) + sum(signed(hints, fountain.encode(header.bits, seeds)));
  }, 0);
}

/** Hints that bits are what they were read as, of hints that they are 0. */
function signed(hints: Float64Array, bits: Uint8Array): Float64Array {
  return hints.map((hint, at) => (bits[at] ? -hint : hint));
}

/** null where it is not one: by chance one of 2^16 is, and opens nothing. */
function unpackHeader(bits: Uint8Array, check: Uint8Array): Header | null {
  const data = packBits(bits);
  const plain = data.subarray(0, HEADER_BYTES - CHECK_BYTES);
  const tag = hmac(sha256, check, plain);
  if (data[HEADER_BYTES - 2] !== tag[0] || data[HEADER_BYTES - 1] !== tag[1]) return null;
  const [level, b, c, d, e] = data.subarray(FILE_KEY_BYTES + PARTITION_BYTES);
  const found = {
    fileKey: data.slice(0, FILE_KEY_BYTES),
    partition: data.slice(FILE_KEY_BYTES, FILE_KEY_BYTES + PARTITION_BYTES),
    // 8 bits of level, 3 of depth, 8 each of first, last and bucket, 5 of idle
    level,
    depth: b >> 5,
    first: ((b & 31) << 3) | (c >> 5),
    last: ((c & 31) << 3) | (d >> 5),
    bucket: ((d & 31) << 3) | (e >> 5),
    idle: e & 31,
    bits: bits.slice(),
  };
  return found.depth < 1 || found.depth > MAX_BITS || found.last < found.first ? null : found;
}

/** Bytes of bits, the highest first. */
export function packBits(bits: Uint8Array): Uint8Array {
  const bytes = new Uint8Array(Math.ceil(bits.length / 8));
  bits.forEach((bit, at) => (bytes[at >> 3] |= bit << (7 - (at & 7))));
  return bytes;
}

function trust(odds: number): number {
  return Math.max(MIN_TRUST, Math.min(MAX_TRUST, 1 / (1 + Math.exp(-odds))));
}

/** Code bits of a header under one salt, as one Gaussian of each place says; hints are P(0) - P(1). */
interface Part {
  readonly salt: number;
  readonly seeds: Words; // [B]
  readonly hints: Float64Array; // [B]
  readonly pilots: Float64Array; // [PILOTS] the same of bits that are 0
}

/** Carriers by the public hash of their names. */
export class Index {
  private readonly hashes: Words; // [P] ascending, each once
  private readonly first: Uint32Array; // [P] a carrier with each name
  private readonly alike: Uint32Array; // [P] how many have it

  constructor(private readonly carriers: Carriers) {
    const hashes = rank(PUBLIC, 'places', carriers.names);
    const order = sortingOrder(hashes);
    const starts = runs(hashes, order);
    this.first = starts.slice(0, -1).map((start) => order[start]);
    this.alike = starts.slice(1).map((end, at) => end - starts[at]);
    this.hashes = new Uint32Array(2 * this.first.length).map((_, at) => hashes[2 * this.first[at >> 1] + (at & 1)]);
  }

  get size(): number {
    return this.first.length;
  }

  /** [count] places of the names that this secret's header is in, or those so many behind. */
  private places(secret: Uint8Array, count: number, behind: number): Uint32Array {
    const key = expand(secret, 'colours/places', 32);
    const points = wordsOf(chacha20(key, new Uint8Array(12), new Uint8Array(8 * count)));
    const found = new Uint32Array(count);
    for (let at = 0; at < count; at++) {
      found[at] = (this.firstFrom(points[2 * at], points[2 * at + 1]) + behind) % this.size;
    }
    return found;
  }

  /** [places] a carrier with each name that this secret's header is in. */
  rows(secret: Uint8Array, kind: Kind): Uint32Array {
    return this.places(secret, kind.places, 0).map((place) => this.first[place]);
  }

  /** What the first `count` Gaussians of each salt hold, if it is one. */
  parts(secrets: readonly Uint8Array[], kind: Kind, view: readonly number[], count = kind.places): Part[] {
    const bits = new Uint8Array(count).fill(kind.depth);
    return view.flatMap((sure, behind) => secrets.map((secret, salt) => {
      const places = this.places(secret, count, behind);
      const own = chosen(this.carriers, places.map((place) => this.first[place]));
      const words = seedsOf(rank(secret, 'header-seeds', own.names), bits);
      const read = readBits(dithers(secret, own.names), own, bits, new Float64Array(count));
      const hints = Float64Array.from(read, (ratio, bit) => {
        const at = Math.floor(bit / (COLUMNS * kind.depth));
        const certain = (sure * (1 - own.doubt[at])) / this.alike[places[at]];
        return Math.tanh(ratio / 2) * certain * (isPadded(words, bit) ? -1 : 1);
      });
      return { salt, seeds: words.subarray(2 * PILOTS), hints: hints.subarray(PILOTS), pilots: hints.subarray(0, PILOTS) };
    }));
  }

  /** How much likelier the pilots are with a header than without: a logarithm. */
  promise(secrets: readonly Uint8Array[]): number {
    if (!this.size || !secrets.length) return -Infinity;
    return Math.max(...KINDS.map((kind) => {
      const odds = oddsOf(this.parts(secrets, kind, USUAL, PILOTS / (COLUMNS * kind.depth)), secrets.length);
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
function oddsOf(parts: readonly Part[], salts: number): number[] {
  const odds = new Array<number>(salts).fill(PRIOR);
  for (const { salt, pilots } of parts) odds[salt] += agreement(pilots);
  return odds;
}

/** The logarithm of how much likelier these hints are if all bits are 0 than by chance. */
function agreement(hints: Float64Array): number {
  return hints.reduce((sum, hint) => sum + Math.log1p(Math.max(-0.99, hint)), 0);
}

/** Whether the code bit with this seed is encrypted by a one. */
function isPadded(seeds: Words, at: number): boolean {
  return mix(seeds[2 * at] ^ PAD_LOW, seeds[2 * at + 1] ^ PAD_HIGH)[1] >>> 31 === 1;
}
