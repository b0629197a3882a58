/** A sketch of a model's Gaussians, in which those of other models are seen; `keyss.channels.sketch` on the other side. */
import { ecb } from '@noble/ciphers/aes.js';
import { viewOf } from '../core/bytes.ts';
import { expand } from '../keys/keys.ts';

const NAME_BYTES = 16;

/** About how many of `names` [N, 16] are not among the `gaussians` of the sketch `own`. */
export function foreign(secret: Uint8Array, names: Uint8Array, own: Uint8Array, gaussians: number): number {
  const kept = 8 * own.length;
  const isUnset = (place: number): boolean => ((own[place >>> 3] >>> (place & 7)) & 1) === 0;
  const places = Array.from({ length: Math.min(kept, gaussians) }, (_, place) => place);
  const key = expand(secret, 'sketch', 32);
  const hashed = viewOf(names.length ? ecb(key, { disablePadding: true }).encrypt(names) : names);
  let seen = 0;
  for (let at = 0; at < names.length; at += NAME_BYTES) {
    const place = hashed.getUint32(at, true) % Math.max(1, gaussians);
    if (place < kept && isUnset(place)) seen++;
  }
  const found = Math.round((seen * gaussians) / Math.max(1, places.filter(isUnset).length));
  return Math.min(names.length / NAME_BYTES, found);
}
