/** The header, on which a key is tried first: how to read the rest; `keyss.channels.robust.header` on the other side. */
import { hmac } from '@noble/hashes/hmac.js';
import { sha256 } from '@noble/hashes/sha2.js';
import type { Carriers } from './carriers.ts';
import { NOISY } from './equations.ts';
import { Fountain } from './fountain.ts';
import { type Lattice, rank, SPACINGS } from './lattice.ts';
import { type Index, type Kind, KINDS, oddsOf, USUAL } from './places.ts';

export const FILE_KEY_BYTES = 5;
export const SHARES = 256; // parts of the carriers, of which a payload has some
export const IDLE = 1 / 32; // unit of the share of carriers that were left alone
const PARTITION_BYTES = 2;
const CHECK_BYTES = 2;
export const HEADER_BYTES = 14;
const ROUNDS = 20;
const TRIES = 3; // to tell salts that were lost
const [LEAST_TRUST, MOST_TRUST] = [0.02, 0.95];
const DECODED = 0.3; // weight of a bit that was decoded beside one that was known
const MERGED = [0.4, 0.2];
/** How a header is looked at: of which kind, and how likely its places, and those after them, hold what was written. */
export const VIEWS: readonly (readonly [Kind, readonly number[]])[] = [
  [KINDS[0], USUAL], [KINDS[1], USUAL], [KINDS[1], MERGED],
];

const fountain = new Fountain(8 * HEADER_BYTES, NOISY);

/** How a payload is read. */
export interface Header {
  readonly fileKey: Uint8Array;
  readonly partition: Uint8Array; // by which carriers are shared out
  readonly lattice: Lattice;
  readonly first: number; // of SHARES that the payload has,
  readonly last: number; // this one included
  readonly bucket: number;
  readonly idle: number; // share of its carriers that hold nothing, in units of IDLE
  readonly bits: Uint8Array; // of all this, as they were read
}

/** Of what depth the header of a payload is. */
export function kindOf(header: Header): Kind {
  return KINDS[Math.min(KINDS.length, header.lattice.depth) - 1];
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
  const parts = index.parts(secrets, kind, view, kind.places);
  const { hints, seeds } = parts;
  const width = hints.length / view.length / secrets.length;
  const saltOf = (bit: number): number => Math.floor(bit / width) % secrets.length;
  const odds = oddsOf(parts, secrets.length);
  let trusts = odds.map(trust);
  for (let attempt = 0; attempt < TRIES; attempt++) {
    const ratios = Float32Array.from(hints, (hint, bit) => {
      return 2 * Math.atanh(Math.max(-0.9999, Math.min(0.9999, hint * trusts[saltOf(bit)])));
    });
    const every = fountain.likeliest(seeds, ratios, ROUNDS);
    const header = unpackHeader(every.subarray(0, fountain.size), check);
    if (header !== null) return header;
    const agreement = odds.slice();
    fountain.sums(every, seeds).forEach((one, bit) => {
      agreement[saltOf(bit)] += DECODED * Math.log1p(Math.max(-0.99, one ? -hints[bit] : hints[bit]));
    });
    trusts = agreement.map(trust);
  }
  return null;
}

/** How far what lies under these secrets agrees with the header: 0 by chance. */
export function headerAgreement(header: Header, secrets: readonly Uint8Array[], index: Index): number {
  if (!index.size) return 0;
  const kind = kindOf(header);
  const { seeds, hints, pilots } = index.parts(secrets, kind, USUAL, kind.places);
  const ones = fountain.encode(header.bits, seeds);
  return pilots.reduce((sum, each) => sum + each, hints.reduce((sum, each, bit) => sum + (ones[bit] ? -each : each), 0));
}

/** null where it is not one: by chance one of 2^16 is, and opens nothing. */
function unpackHeader(bits: Uint8Array, check: Uint8Array): Header | null {
  const data = packBits(bits);
  const plain = data.subarray(0, HEADER_BYTES - CHECK_BYTES);
  const tag = hmac(sha256, check, plain);
  if (data[HEADER_BYTES - 2] !== tag[0] || data[HEADER_BYTES - 1] !== tag[1]) return null;
  const [a, b, c, d, e] = data.subarray(FILE_KEY_BYTES + PARTITION_BYTES);
  const found = {
    fileKey: data.slice(0, FILE_KEY_BYTES),
    partition: data.slice(FILE_KEY_BYTES, FILE_KEY_BYTES + PARTITION_BYTES),
    // 6 bits of level, 2 of spacing, 3 of depth, 8 each of first, last and bucket, 5 of idle
    lattice: { level: a >> 2, spacing: SPACINGS[a & 3], depth: b >> 5 },
    first: ((b & 31) << 3) | (c >> 5),
    last: ((c & 31) << 3) | (d >> 5),
    bucket: ((d & 31) << 3) | (e >> 5),
    idle: e & 31,
    bits: bits.slice(),
  };
  return found.lattice.depth === 0 || found.last < found.first ? null : found;
}

/** Bytes of bits, the highest first. */
export function packBits(bits: Uint8Array): Uint8Array {
  const bytes = new Uint8Array(Math.ceil(bits.length / 8));
  bits.forEach((bit, at) => (bytes[at >> 3] |= bit << (7 - (at & 7))));
  return bytes;
}

function trust(odds: number): number {
  return Math.max(LEAST_TRUST, Math.min(MOST_TRUST, 1 / (1 + Math.exp(-odds))));
}
