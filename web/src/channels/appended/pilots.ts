/** Pilots: appended Gaussians readable without a key, and their frame; counterpart of `keyss.channels.appended.pilots`. */
import { mostFrequent, rowsOf } from '../../core/bytes.ts';
import { fittedSimilarity, movedPoint, type Similarity } from '../../core/similarity.ts';
import { vectorAt } from '../../core/vectors.ts';
import { mix, type Words } from '../../core/words.ts';
import { SALT_BYTES } from '../../keys/keys.ts';

export const LEAST = 128; // pilots per model
export const POSITION_BITS = 10; // per axis of the own frame
export const ONE_IN = 64; // words are pilots by chance
const [PUBLIC_LOW, PUBLIC_HIGH] = [0x73617070, 0x6b657973]; // domain separation of the hash
const PARTS = SALT_BYTES / 2;
const RANDOM_BITS = 2; // per pilot, beside the salt's part and its index
const [TRIES, AGREE] = [300, 12]; // triples of pilots; pilots that must agree
const SAMPLE = 1024; // pilots tried first
const NEAR = 1.5 / 2 ** POSITION_BITS; // in the own frame

/** The data that pilots encode. */
export interface PilotData {
  readonly toOwn: Similarity; // from the world to the own frame
  readonly agreeing: number; // pilots
  readonly salt: Uint8Array;
}

/** Frame and salt from the pilots among candidates with `invariants` [N] and world `means` [N, 3]. */
export function readPilots(invariants: Words, means: Float32Array): PilotData | null {
  const pilots = pilotsOf(invariants);
  if (pilots.length < AGREE) return null;
  const there = rowsOf(means, pilots, 3);
  const expected = Float64Array.from(pilots.flatMap((row) => placeOf(invariants, row)));
  const sample = Math.min(pilots.length, SAMPLE);
  const some = Array.from({ length: sample }, (_, at) => Math.floor((at * pilots.length) / sample));
  const draw = drawing(sample);
  let best: number[] = [];
  for (let attempt = 0; attempt < TRIES && best.length <= Math.max(AGREE, sample / 2); attempt++) {
    const near = agreeing(there, expected, [some[draw()], some[draw()], some[draw()]], some);
    if (near.length > best.length) best = near;
  }
  for (let round = 0; round < 3 && best.length >= AGREE; round++) best = agreeing(there, expected, best, pilots.keys());
  if (best.length < AGREE) return null;
  const toOwn = fittedSimilarity(there, expected, best);
  const salt = saltOf(invariants, best.map((at) => pilots[at]));
  return toOwn && salt && { toOwn, agreeing: best.length, salt };
}

/** The pilots `among` all that the similarity fitted to `chosen` maps to their places. */
function agreeing(
  there: Float32Array, expected: Float64Array, chosen: number[], among: Iterable<number>,
): number[] {
  const similarity = fittedSimilarity(there, expected, chosen);
  if (!similarity) return [];
  return [...among].filter((at) => {
    const place = movedPoint(similarity, vectorAt(there, at));
    return place.every((each, axis) => Math.abs(each - expected[3 * at + axis]) < NEAR);
  });
}

/** Deterministic pseudo-random numbers below `count`. */
function drawing(count: number): () => number {
  let drawn = 0;
  return () => Math.floor((mix(++drawn)[1] / 2 ** 32) * count);
}

/** The salt by majority for each part; null if a part is missing. */
function saltOf(invariants: Words, rows: number[]): Uint8Array | null {
  const parts = Array.from({ length: PARTS }, (): number[] => []);
  for (const row of rows) {
    const [low, high] = [invariants[2 * row], invariants[2 * row + 1]];
    const mask = mix((low & 0x3ffff) ^ PUBLIC_LOW, PUBLIC_HIGH)[1] >>> 11; // of the scales
    const said = (((high << 14) | (low >>> 18)) ^ mask) >>> RANDOM_BITS; // 21 bits, whitened
    parts[said >>> 16].push(said & 0xffff);
  }
  const salt = new Uint8Array(SALT_BYTES);
  for (const [part, values] of parts.entries()) {
    const best = mostFrequent(values);
    if (!best) return null;
    salt.set([best[0] >> 8, best[0] & 255], 2 * part);
  }
  return salt;
}

/** The rows of different pilots among `invariants` [N]: copies of one faint Gaussian would outnumber the others. */
export function pilotsOf(invariants: Words): number[] {
  const [rows, seen] = [[] as number[], new Set<number>()];
  for (let row = 0; row < invariants.length >> 1; row++) {
    if (publicHash(invariants, row)[0] % ONE_IN !== 0) continue;
    const word = invariants[2 * row] + 2 ** 32 * invariants[2 * row + 1];
    if (!seen.has(word)) rows.push(row);
    seen.add(word);
  }
  return rows;
}

function publicHash(invariants: Words, row: number): Words {
  return mix(invariants[2 * row] ^ PUBLIC_LOW, invariants[2 * row + 1] ^ PUBLIC_HIGH);
}

/** A pilot's place in the own frame, a hash of its invariants. */
function placeOf(invariants: Words, row: number): number[] {
  const [low, high] = publicHash(invariants, row);
  const place = mix(low, high)[1];
  return [place >>> 22, (place >>> 12) & 1023, (place >>> 2) & 1023].map((each) => (each + 0.5) / 2 ** POSITION_BITS);
}
