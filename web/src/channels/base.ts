/** What channels carry, and Gaussians of other models; counterpart of `keyss.channels.base` and `mixing`. */
import { bytesKey, viewOf } from '../core/bytes.ts';
import { damaged } from '../core/errors.ts';
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

const ID_BYTES = 16;

/** About how many of `ids` [N, 16] are not among the `gaussians` of the sketch `own`. */
export function foreign(secret: Uint8Array, ids: Uint8Array, own: Uint8Array, gaussians: number): number {
  const kept = 8 * own.length;
  const isUnset = (place: number): boolean => ((own[place >>> 3] >>> (place & 7)) & 1) === 0;
  const places = Array.from({ length: Math.min(kept, gaussians) }, (_, place) => place);
  const hashed = viewOf(encryptBlocks(expand(secret, 'sketch'), ids));
  let seen = 0;
  for (let at = 0; at < ids.length; at += ID_BYTES) {
    const place = hashed.getUint32(at, true) % Math.max(1, gaussians);
    if (place < kept && isUnset(place)) seen++;
  }
  const found = Math.round((seen * gaussians) / Math.max(1, places.filter(isUnset).length));
  return Math.min(ids.length / ID_BYTES, found);
}
