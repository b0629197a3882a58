/** A sketch of a model's Gaussians, in which those of other models are seen; counterpart of `keyss.channels.sketch`. */
import { viewOf } from '../core/bytes.ts';
import { blockwise, expand } from '../keys/keys.ts';

const ID_BYTES = 16;

/** About how many of `ids` [N, 16] are not among the `gaussians` of the sketch `own`. */
export function foreign(secret: Uint8Array, ids: Uint8Array, own: Uint8Array, gaussians: number): number {
  const kept = 8 * own.length;
  const isUnset = (place: number): boolean => ((own[place >>> 3] >>> (place & 7)) & 1) === 0;
  const places = Array.from({ length: Math.min(kept, gaussians) }, (_, place) => place);
  const hashed = viewOf(blockwise(expand(secret, 'sketch'), ids));
  let seen = 0;
  for (let at = 0; at < ids.length; at += ID_BYTES) {
    const place = hashed.getUint32(at, true) % Math.max(1, gaussians);
    if (place < kept && isUnset(place)) seen++;
  }
  const found = Math.round((seen * gaussians) / Math.max(1, places.filter(isUnset).length));
  return Math.min(ids.length / ID_BYTES, found);
}
