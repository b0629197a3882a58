/** A hash of 64-bit numbers that anybody can compute: the finaliser of splitmix64 (Steele et al. 2014). */
import type { Words } from '../core/words.ts';

/** Replaces the word at `at`. */
export function mixAt(words: Words, at: number): void {
  let low = words[2 * at] + 0x7f4a7c15;
  let high = (words[2 * at + 1] + 0x9e3779b9 + (low > 0xffffffff ? 1 : 0)) >>> 0;
  low >>>= 0;
  for (let round = 0; round < 2; round++) {
    const shift = round ? 27 : 30;
    low ^= (low >>> shift) | (high << (32 - shift));
    high ^= high >>> shift;
    const [byLow, byHigh] = round ? [0x133111eb, 0x94d049bb] : [0x1ce4e5b9, 0xbf58476d];
    high = Math.imul(high, byLow) + Math.imul(low, byHigh) + highProduct(low >>> 0, byLow);
    low = Math.imul(low, byLow);
  }
  words[2 * at] = low ^ ((low >>> 31) | (high << 1));
  words[2 * at + 1] = high ^ (high >>> 31);
}

/** The same for all of them, which are replaced; returns them. */
export function mixed(words: Words): Words {
  for (let at = 0; at < words.length >> 1; at++) mixAt(words, at);
  return words;
}

/** The high 32 bits of the product of two numbers of 32 bits. */
function highProduct(a: number, b: number): number {
  const [a0, a1, b0, b1] = [a & 0xffff, a >>> 16, b & 0xffff, b >>> 16];
  const middle = a1 * b0 + ((a0 * b0) >>> 16);
  return a1 * b1 + Math.floor(middle / 0x10000) + ((a0 * b1 + (middle & 0xffff)) >>> 16);
}
