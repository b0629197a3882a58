/** Authenticated decryption of one payload; `keyss.keys.encryption` on the other side. */
import { chacha20poly1305 } from '@noble/ciphers/chacha.js';
import { viewOf } from '../core/bytes.ts';
import { damaged } from '../core/errors.ts';
import { unpacked } from '../core/unpacking.ts';
import { expand } from './derivation.ts';

const MAX_PAYLOAD_BYTES = 64 << 20;
const [MAX_RATIO, SMALL_PAYLOAD] = [16, 1 << 20]; // n bytes become MAX_RATIO n + SMALL_PAYLOAD at most

/** The inverse of `keyss.keys.encryption.encrypt`. Raises InputError when anything is not as it left it. */
export async function decrypted(
  dataKey: Uint8Array, encrypted: Uint8Array, associated: Uint8Array,
): Promise<Uint8Array> {
  let plain: Uint8Array;
  try {
    plain = chacha20poly1305(expand(dataKey, 'payload', 32), new Uint8Array(12), associated).decrypt(encrypted);
  } catch {
    throw damaged();
  }
  const length = plain.length >= 4 ? viewOf(plain).getUint32(0, true) : plain.length;
  if (4 + length > plain.length) throw damaged();
  const most = Math.min(MAX_PAYLOAD_BYTES, MAX_RATIO * length + SMALL_PAYLOAD);
  return unpacked(plain.subarray(4, 4 + length), 'deflate', most);
}
