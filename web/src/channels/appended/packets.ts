/** Packets: data bytes and a number in words of 84 bits; counterpart of `keyss.channels.appended.packets`. */
import { ecb } from '@noble/ciphers/aes.js';
import type { Codewords } from '../reed_solomon.ts';

export const WIDTHS = [8, 6]; // data bytes per packet
const HEADER_BITS = 20;
const WORD_BYTES = 11;
const MAX_DATA = 5895; // packets per codeword
const [LEFT, DEVIATIONS] = [0.74, 4.2]; // expected share of surviving packets, and the margin
const AGREEING_HEADERS = 12; // fewer agree by chance among a million words

/** N words: data bytes, then a tag. */
export interface TaggedWords {
  readonly count: number;
  readonly bytes: Uint8Array; // [N, 11]; the last four bits are zero
}

/** Words of colours, scales [N, 3] and positions and turns [N, 6]. */
export function wordsOfPoints(colours: Uint8Array, scales: Uint8Array, others: Uint16Array): TaggedWords {
  const count = colours.length / 3;
  const bytes = new Uint8Array(WORD_BYTES * count);
  const view = new DataView(bytes.buffer);
  for (let row = 0; row < count; row++) {
    const [r, g, b] = colours.subarray(3 * row, 3 * row + 3);
    const [u, v, w] = scales.subarray(3 * row, 3 * row + 3);
    const [x, y, z, i, j, k] = others.subarray(6 * row, 6 * row + 6);
    const at = WORD_BYTES * row;
    // 7 + 7 + 7 + 6 + 5 bits, then 1 + 6 + 10 + 10 + 5, then 5 + 5 + 5 + 1 and 4.
    view.setUint32(at, (r << 25) | (g << 18) | (b << 11) | (u << 5) | (v >> 1));
    view.setUint32(at + 4, ((v & 1) << 31) | (w << 25) | (x << 15) | (y << 5) | (z >> 5));
    view.setUint16(at + 8, ((z & 31) << 11) | (i << 6) | (j << 1) | (k >> 4));
    bytes[at + 10] = (k & 15) << 4;
  }
  return { count, bytes };
}

/** [number, data] of each word, as if all were packets. */
export function readPackets(key: Uint8Array, { count, bytes }: TaggedWords, width: number): [number, Uint8Array][] {
  const found: [number, Uint8Array][] = [];
  if (!count) return found;
  const blocks = new Uint8Array(16 * count);
  for (let row = 0; row < count; row++) blocks.set(bytes.subarray(WORD_BYTES * row, WORD_BYTES * row + width), 16 * row);
  const encrypted = ecb(key, { disablePadding: true }).encrypt(blocks); // as a pseudorandom function
  for (let row = 0; row < count; row++) {
    let tag = 0;
    for (let byte = 0; byte < WORD_BYTES - width; byte++) {
      tag = 256 * tag + (bytes[WORD_BYTES * row + width + byte] ^ encrypted[16 * row + byte]); // may pass 2^32
    }
    found.push([Math.floor(tag / 16), blocks.subarray(16 * row, 16 * row + width)]);
  }
  return found;
}

/** The codewords by majority of the headers; null if too few agree. */
export function readHeader(key: Uint8Array, words: TaggedWords, width: number): Codewords | null {
  const votes = new Uint32Array(1 << HEADER_BITS);
  for (const [number] of readPackets(key, words, width)) if (number < votes.length) votes[number]++;
  const header = votes.reduce((best, each, value) => (each > votes[best] ? value : best), 0);
  if (!(votes[header] >= AGREEING_HEADERS && header > 0)) return null;
  const count = Math.ceil(header / MAX_DATA);
  const k = Math.ceil(header / count);
  let n = k;
  while (n * LEFT - DEVIATIONS * Math.sqrt(n * LEFT * (1 - LEFT)) < k) n++;
  return { count, n, k, width };
}
