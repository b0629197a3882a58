/**
 * Wet paper codes, as their reader sees them (Fridrich, Goljan, Lisonek and Soukal 2005): what is written is, of each
 * block of bits, the product with a random matrix modulo 2; `keyss.channels.codes.syndromes` on the other side.
 */
import { streamWords } from '../../keys/keys.ts';

export const BLOCK = 1024;
const WORDS = BLOCK / 32;

/** [rate, BLOCK / 32] random bits; the first rows are those of a matrix with fewer. */
export function matrix(seed: Uint8Array, rate: number): Uint32Array {
  const found = new Uint32Array(rate * WORDS);
  streamWords(seed, 'codes/matrix', found.length, (word, at) => (found[at] = word));
  return found;
}

/** The messages in blocks: [B, BLOCK / 32]; the first bits of each are used, one for each row. */
export function products(bits: Uint8Array, places: Uint32Array, rows: Uint32Array): Uint32Array {
  const [blocks, rate] = [Math.floor(places.length / BLOCK), rows.length / WORDS];
  const found = new Uint32Array(blocks * WORDS);
  const own = new Uint32Array(WORDS);
  for (let block = 0; block < blocks; block++) {
    own.fill(0);
    for (let at = 0; at < BLOCK; at++) own[at >> 5] |= bits[places[block * BLOCK + at]] << (at & 31);
    for (let row = 0; row < rate; row++) {
      let sum = 0;
      for (let word = 0, at = row * WORDS; word < WORDS; word++, at++) sum ^= own[word] & rows[at];
      sum ^= sum >>> 16;
      sum ^= sum >>> 8;
      sum ^= sum >>> 4;
      found[block * WORDS + (row >> 5)] |= ((0x6996 >>> (sum & 15)) & 1) << (row & 31);
    }
  }
  return found;
}

/** `size` bytes from bit `start` on of blocks that hold `rate` bits each, and go on at the start where they end. */
export function bytesOf(held: Uint32Array, rate: number, start: number, size: number): Uint8Array {
  const count = (held.length / WORDS) * rate;
  const found = new Uint8Array(size);
  for (let bit = 0, at = start; bit < 8 * size; bit++, at++) {
    if (at === count) at = 0;
    const row = at % rate;
    const word = held[Math.floor(at / rate) * WORDS + (row >> 5)];
    found[bit >> 3] |= ((word >>> (row & 31)) & 1) << (bit & 7);
  }
  return found;
}
