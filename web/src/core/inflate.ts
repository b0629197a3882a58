/** Zlib streams of bounded size (RFC 1950, 1951). */
import { Inflate } from 'fflate';
import { viewOf } from './bytes.ts';
import { InputError } from './errors.ts';

/** What a zlib stream becomes. Raises InputError for damage, and for more than `most` bytes. */
export function inflated(stream: Uint8Array, most: number): Uint8Array {
  const parts: Uint8Array[] = [];
  let [size, ended] = [0, false];
  const valid = stream.length > 6 && (stream[0] & 15) === 8 && ((stream[0] << 8) | stream[1]) % 31 === 0;
  try {
    if (!valid) throw new Error('no zlib stream');
    const inflate = new Inflate((part, final) => {
      size += part.length;
      if (size > most) throw new Error('too large');
      parts.push(part);
      ended ||= final;
    });
    for (let at = 2; at < stream.length - 4; at += 1 << 16) {
      inflate.push(stream.subarray(at, Math.min(stream.length - 4, at + (1 << 16))), at + (1 << 16) >= stream.length - 4);
    }
    if (!ended) throw new Error('not whole');
  } catch {
    throw new InputError('The compressed data are damaged.');
  }
  const whole = new Uint8Array(size);
  let at = 0;
  for (const part of parts) {
    whole.set(part, at);
    at += part.length;
  }
  const checksum = viewOf(stream).getUint32(stream.length - 4);
  if (adler32(whole) !== checksum) throw new InputError('The compressed data are damaged.');
  return whole;
}

function adler32(bytes: Uint8Array): number {
  let [a, b] = [1, 0];
  for (const byte of bytes) {
    a = (a + byte) % 65521;
    b = (b + a) % 65521;
  }
  return ((b << 16) | a) >>> 0;
}
