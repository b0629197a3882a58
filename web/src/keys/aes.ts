/**
 * AES-256 (FIPS 197) of many independent blocks. The library takes three times as long: it works on one block at a time, with
 * tables of 512 kB. Its key schedule is used.
 */
import { unsafe } from '@noble/ciphers/aes.js';

const ROUNDS = 14;
const SBOX = new Uint8Array(256);
/** Products of the column (2, 1, 1, 3) with the substitute of a byte, little-endian, rotated by 0 to 3 bytes. */
const [T0, T1, T2, T3] = [0, 1, 2, 3].map(() => new Uint32Array(256));
for (let round = 0, power = 1, inverse = 1; round < 255; round++) {
  // 3 generates the field; `inverse` is the inverse of `power`, to which the affine map applies.
  const rotated = inverse * 0x101;
  const substitute = (inverse ^ (rotated >> 4) ^ (rotated >> 5) ^ (rotated >> 6) ^ (rotated >> 7) ^ 0x63) & 255;
  fill(power, substitute);
  power = twice(power) ^ power;
  // divided by 3
  inverse ^= inverse << 1;
  inverse ^= inverse << 2;
  inverse ^= inverse << 4;
  inverse = (inverse ^ (inverse & 128 ? 9 : 0)) & 255;
}
fill(0, 0x63);

function twice(value: number): number {
  return ((value << 1) ^ (value & 128 ? 0x11b : 0)) & 255;
}

function fill(byte: number, substitute: number): void {
  SBOX[byte] = substitute;
  const double = twice(substitute);
  const word = double | (substitute << 8) | (substitute << 16) | ((double ^ substitute) << 24);
  T0[byte] = word;
  T1[byte] = (word << 8) | (word >>> 24);
  T2[byte] = (word << 16) | (word >>> 16);
  T3[byte] = (word << 24) | (word >>> 8);
}

/** Every 16 bytes through AES-256: a pseudorandom function of blocks, not a mode of operation. */
export function encryptBlocks(key: Uint8Array, blocks: Uint8Array): Uint8Array {
  const encrypted = blocks.slice(); // aligned
  const words = new Uint32Array(encrypted.buffer, 0, encrypted.length >> 2); // of little-endian machines, as all are
  const keys = unsafe.expandKeyLE(key);
  for (let at = 0; at < words.length; at += 4) {
    let [a, b, c, d] = [words[at] ^ keys[0], words[at + 1] ^ keys[1], words[at + 2] ^ keys[2], words[at + 3] ^ keys[3]];
    for (let next = 4; next < 4 * ROUNDS; next += 4) {
      const e = T0[a & 255] ^ T1[(b >>> 8) & 255] ^ T2[(c >>> 16) & 255] ^ T3[d >>> 24] ^ keys[next];
      const f = T0[b & 255] ^ T1[(c >>> 8) & 255] ^ T2[(d >>> 16) & 255] ^ T3[a >>> 24] ^ keys[next + 1];
      const g = T0[c & 255] ^ T1[(d >>> 8) & 255] ^ T2[(a >>> 16) & 255] ^ T3[b >>> 24] ^ keys[next + 2];
      d = T0[d & 255] ^ T1[(a >>> 8) & 255] ^ T2[(b >>> 16) & 255] ^ T3[c >>> 24] ^ keys[next + 3];
      a = e;
      b = f;
      c = g;
    }
    words[at] = last(a, b, c, d) ^ keys[4 * ROUNDS];
    words[at + 1] = last(b, c, d, a) ^ keys[4 * ROUNDS + 1];
    words[at + 2] = last(c, d, a, b) ^ keys[4 * ROUNDS + 2];
    words[at + 3] = last(d, a, b, c) ^ keys[4 * ROUNDS + 3];
  }
  return encrypted;
}

function last(a: number, b: number, c: number, d: number): number {
  return SBOX[a & 255] | (SBOX[(b >>> 8) & 255] << 8) | (SBOX[(c >>> 16) & 255] << 16) | (SBOX[d >>> 24] << 24);
}
