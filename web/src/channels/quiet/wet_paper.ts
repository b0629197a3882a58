/**
 * Reader of wet paper codes (Fridrich et al. 2005): the message of a block of bits is its product with a public random
 * matrix, modulo 2; counterpart of `keyss.channels.quiet.wet_paper`.
 */
import { sortingOrder } from '../../core/words.ts';
import { streamWords } from '../../keys/keys.ts';

export const BLOCK = 1024;
export const BLOCK_BYTES = BLOCK / 8;
const WORDS = BLOCK / 32;
const PUBLIC = new Uint8Array(32); // the seed of order and matrix

/** [B, BLOCK_BYTES] the messages of all blocks of `bits` (0 or 1), each padded with noise. */
export function readBlocks(bits: Uint8Array): Uint8Array {
  const high = new Uint32Array(bits.length);
  streamWords(PUBLIC, 'codes/order', 2 * bits.length, (word, at) => {
    if (at & 1) high[at >>> 1] = word;
  });
  const [places, blocks] = [sortingOrder(high, 1), Math.floor(bits.length / BLOCK)];
  const rows = new Uint32Array(BLOCK * WORDS);
  streamWords(PUBLIC, 'codes/matrix', rows.length, (word, at) => (rows[at] = word));
  const found = new Uint32Array(blocks * WORDS);
  const own = new Uint32Array(WORDS);
  for (let block = 0; block < blocks; block++) {
    own.fill(0);
    for (let at = 0; at < BLOCK; at++) own[at >> 5] |= bits[places[block * BLOCK + at]] << (at & 31);
    for (let row = 0; row < BLOCK; row++) {
      let sum = 0;
      for (let word = 0, at = row * WORDS; word < WORDS; word++, at++) sum ^= own[word] & rows[at];
      sum ^= sum >>> 16;
      sum ^= sum >>> 8;
      sum ^= sum >>> 4;
      found[block * WORDS + (row >> 5)] |= ((0x6996 >>> (sum & 15)) & 1) << (row & 31);
    }
  }
  return new Uint8Array(found.buffer);
}
