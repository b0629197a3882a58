/** Pilots: appended Gaussians that everybody can read; `keyss.channels.appended.pilots` on the other side. */
import { mostFrequent } from '../../core/bytes.ts';
import { movedPoint, type Similarity } from '../../core/similarity.ts';
import { mixAt, type Words } from '../../core/words.ts';
import { SALT_BYTES } from '../../keys/derivation.ts';
import { fittedSimilarity } from './fitting.ts';
import { POSITION_BITS } from './lattice.ts';

export const LEAST = 128; // of a model
export const ONE_IN = 64; // words is a pilot by chance
const [PUBLIC_LOW, PUBLIC_HIGH] = [0x73617070, 0x6b657973]; // what tells this hash from others
const PARTS = SALT_BYTES / 2;
const RANDOM_BITS = 2; // of a pilot's colours, beside the part of the salt and its number
const [TRIES, AGREE] = [300, 12]; // of three pilots; that have to agree
const SAMPLE = 1024; // pilots that are tried first
const NEAR = 1.5 / 2 ** POSITION_BITS; // in the own frame

/** What pilots tell. */
export interface Found {
  readonly toOwn: Similarity; // from the world to the own frame
  readonly agreeing: number; // pilots
  readonly salt: Uint8Array;
}

/** How many of `invariants` [N] are those of pilots. */
export function countPilots(invariants: Words): number {
  let found = 0;
  for (let row = 0; row < invariants.length >> 1; row++) found += Number(isPilot(invariants, row));
  return found;
}

/** What the pilots among candidates tell: `invariants` [N] as they were read, `means` [N, 3] in the world. */
export function readPilots(invariants: Words, means: Float32Array): Found | null {
  const own: number[] = [];
  for (let row = 0; row < invariants.length >> 1; row++) if (isPilot(invariants, row)) own.push(row);
  if (own.length < AGREE) return null;
  const there = new Float64Array(3 * own.length);
  const expected = new Float64Array(3 * own.length);
  own.forEach((row, to) => {
    there.set(means.subarray(3 * row, 3 * row + 3), 3 * to);
    expected.set(placeOf(invariants, row), 3 * to);
  });
  const sample = Math.min(own.length, SAMPLE);
  const some = Array.from({ length: sample }, (_, at) => Math.floor((at * own.length) / sample));
  const draw = drawing(sample);
  let best: number[] = [];
  for (let attempt = 0; attempt < TRIES && best.length <= Math.max(AGREE, sample / 2); attempt++) {
    const near = agreeing(there, expected, [some[draw()], some[draw()], some[draw()]], some);
    if (near.length > best.length) best = near;
  }
  for (let round = 0; round < 3 && best.length >= AGREE; round++) best = agreeing(there, expected, best, own.keys());
  if (best.length < AGREE) return null;
  const toOwn = fittedSimilarity(there, expected, best);
  const salt = saltOf(invariants, best.map((at) => own[at]));
  return toOwn && salt && { toOwn, agreeing: best.length, salt };
}

/** Which pilots `among` all come to lie where they should by the similarity of the chosen ones. */
function agreeing(
  there: Float64Array, expected: Float64Array, chosen: number[], among: Iterable<number>,
): number[] {
  const found: number[] = [];
  const similarity = fittedSimilarity(there, expected, chosen);
  if (!similarity) return found;
  for (const at of among) {
    const place = movedPoint(similarity, there.subarray(3 * at, 3 * at + 3));
    if (place.every((each, axis) => Math.abs(each - expected[3 * at + axis]) < NEAR)) found.push(at);
  }
  return found;
}

/** Numbers below `count` that are drawn at random, the same ones every time. */
function drawing(count: number): () => number {
  const state = new Uint32Array(2);
  let drawn = 0;
  return () => {
    [state[0], state[1]] = [++drawn, 0];
    mixAt(state, 0);
    return Math.floor((state[1] / 2 ** 32) * count);
  };
}

/** What most pilots say of each part; null where one has nobody left. */
function saltOf(invariants: Words, rows: number[]): Uint8Array | null {
  const parts = Array.from({ length: PARTS }, (): number[] => []);
  const state = new Uint32Array(2);
  for (const row of rows) {
    const [low, high] = [invariants[2 * row], invariants[2 * row + 1]];
    [state[0], state[1]] = [(low & 0x3ffff) ^ PUBLIC_LOW, PUBLIC_HIGH]; // of the scales
    mixAt(state, 0);
    const said = (((high << 14) | (low >>> 18)) ^ (state[1] >>> 11)) >>> RANDOM_BITS; // 21 bits, whitened
    parts[said >>> 16].push(said & 0xffff);
  }
  const salt = new Uint8Array(SALT_BYTES);
  for (const [part, own] of parts.entries()) {
    const best = mostFrequent(own);
    if (!best) return null;
    salt.set([best[0] >> 8, best[0] & 255], 2 * part);
  }
  return salt;
}

const scratch = new Uint32Array(2);

function isPilot(invariants: Words, row: number): boolean {
  scratch[0] = invariants[2 * row] ^ PUBLIC_LOW;
  scratch[1] = invariants[2 * row + 1] ^ PUBLIC_HIGH;
  mixAt(scratch, 0);
  return scratch[0] % ONE_IN === 0;
}

/** Where a pilot lies in the own frame: by a hash of its invariants. */
function placeOf(invariants: Words, row: number): number[] {
  isPilot(invariants, row);
  mixAt(scratch, 0);
  const high = scratch[1];
  return [high >>> 22, (high >>> 12) & 1023, (high >>> 2) & 1023].map((each) => (each + 0.5) / 2 ** POSITION_BITS);
}
