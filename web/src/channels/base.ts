/** What channels carry, and Gaussians of other models; counterpart of `keyss.channels.base` and `mixing`. */
import { bytesKey, viewOf } from '../core/bytes.ts';
import { damaged } from '../core/errors.ts';
import { coefficients, type Gaussians, opacity } from '../core/gaussians.ts';
import { sortingOrder } from '../core/words.ts';
import { encryptBlocks } from '../keys/aes.ts';
import { type Derive, expand } from '../keys/keys.ts';

/** Bytes that are read completely or not at all. */
export interface Payload {
  readonly method: string;
  readonly data: Uint8Array;
  readonly foreign?: number; // Gaussians added to or changed in the published file
}

/** A channel of one model, prepared for any number of keys. */
export interface Reader {
  /** Number of key derivations per attempt, whatever it opens. */
  readonly derivations: number;

  /** The payload that `key` opens, or null. Raises InputError for damage. */
  open(key: string, derive?: Derive): Promise<Payload | null>;
}

const METHOD_BYTES = 15;

/** Parses method name, zero byte, data. */
export function unpackPayload(packed: Uint8Array): Payload {
  const length = packed.indexOf(0);
  const name = packed.subarray(0, length);
  if (length < 1 || length > METHOD_BYTES || name.some((each) => each > 127)) throw damaged();
  return { method: bytesKey(name), data: packed.slice(length + 1) };
}

export const ID_BYTES = 16;

/**
 * The share, 0 to 1, of foreign Gaussians among those with `ids` [N, 16], by the Bloom filter `own`; equal IDs count once.
 * `among`: places that each Gaussian hashes to, or for all of them the number of the Bloom filter's Gaussians. 1 if less than a share
 * `gone` of the Bloom filter's sample, rounded down, is there.
 */
export function foreignShare(
  secret: Uint8Array, ids: Uint8Array, own: Uint8Array, among: number | readonly number[], gone = 0,
): number {
  const kept = 8 * own.length;
  const isUnset = (place: number): boolean => ((own[place >>> 3] >>> (place & 7)) & 1) === 0;
  const bits = typeof among === 'number' ? Math.min(kept, among) : kept;
  const unset = Array.from({ length: bits }, (_, place) => place).filter(isUnset).length;
  const hashed = viewOf(encryptBlocks(expand(secret, 'bloom'), ids));
  const sampled = new Map<number, number>(); // the place of each different ID
  for (let row = 0; row < ids.length / ID_BYTES; row++) {
    const [low, high] = [hashed.getUint32(ID_BYTES * row, true), hashed.getUint32(ID_BYTES * row + 4, true)];
    const place = low % Math.max(1, typeof among === 'number' ? among : among[row]);
    if (place < kept) sampled.set(low * 2 ** 21 + (high >>> 11), place);
  }
  if (sampled.size < Math.floor(gone * (bits - unset))) return 1;
  const found = [...sampled.values()].filter(isUnset).length;
  return Math.min(1, found / Math.max(1e-9, (sampled.size * unset) / Math.max(1, bits)));
}

const [MAX_COPIES, VISIBLE] = [0.1, 2 / 255]; // share of a sound model; opacity, above that of appended Gaussians

/** The number of visible Gaussians with the position and the red of another, or 0 for no suspicious number. */
export function copies(model: Gaussians): number {
  const width = 3 * coefficients(model.shDegree);
  const rows = [...Array(model.count).keys()].filter((row) => opacity(model.opacityLogits[row]) > VISIBLE);
  const numbers = new Float32Array(4 * rows.length);
  rows.forEach((row, at) => {
    numbers.set(model.means.subarray(3 * row, 3 * row + 3), 4 * at);
    numbers[4 * at + 3] = model.sh[width * row];
  });
  const words = new Uint32Array(numbers.map((each) => each + 0).buffer); // no negative zeros
  const order = sortingOrder(words, 4);
  let found = 0;
  for (let at = 1; at < order.length; at++) {
    const [a, b] = [4 * order[at - 1], 4 * order[at]];
    if ([0, 1, 2, 3].every((word) => words[a + word] === words[b + word])) found++;
  }
  return found > MAX_COPIES * rows.length ? found : 0;
}
