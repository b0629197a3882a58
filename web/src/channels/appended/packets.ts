/** Packets: 6 bytes, and which ones they are, in words of 84 bits; `keyss.channels.appended.packets` on the other side. */
import { ecb } from '@noble/ciphers/aes.js';
import { mostFrequent } from '../../core/bytes.ts';
import { mix } from '../../core/words.ts';
import type { Codewords } from '../reed_solomon.ts';

const PACKET_BYTES = 6;
const NUMBER_BITS = 20;
const DATA_BITS = 8; // of a header: packets of a codeword that hold data
const MAX_DATA = 150;
const MAX_CHUNKS = 255;
const MAX_CODEWORDS = Math.min(1 << (NUMBER_BITS - DATA_BITS), Math.floor((1 << NUMBER_BITS) / MAX_CHUNKS)) - 1;
const [LEFT, DEVIATIONS] = [0.72, 4.5]; // of packets that may be relied upon
const AGREEING_HEADERS = 3; // one or two may be there by chance

/** N words: 48 bits of data, and 36 of tag. */
export interface TaggedWords {
  readonly count: number;
  readonly blocks: Uint8Array; // [N, 16] data, and zeros up to a block of AES
  readonly tags: Uint32Array; // [N, 2] the low 32 bits, and the others
}

/** Words of colours, scales [N, 3] and positions and turns [N, 6]. */
export function wordsOfPoints(colours: Uint8Array, scales: Uint8Array, others: Uint16Array): TaggedWords {
  const count = colours.length / 3;
  const [blocks, tags] = [new Uint8Array(16 * count), new Uint32Array(2 * count)];
  const view = new DataView(blocks.buffer);
  for (let row = 0; row < count; row++) {
    const [r, g, b] = colours.subarray(3 * row, 3 * row + 3);
    const [u, v, w] = scales.subarray(3 * row, 3 * row + 3);
    const [x, y, z, i, j, k] = others.subarray(6 * row, 6 * row + 6);
    // 7 + 7 + 7 + 6 + 5 bits, then 1 + 6 + 9: the last bit of x belongs to the tag.
    view.setUint32(16 * row, (r << 25) | (g << 18) | (b << 11) | (u << 5) | (v >> 1));
    view.setUint16(16 * row + 4, ((v & 1) << 15) | (w << 9) | (x >> 1));
    tags[2 * row] = (y << 25) | (z << 15) | (i << 10) | (j << 5) | k;
    tags[2 * row + 1] = ((x & 1) << 3) | (y >> 7);
  }
  return { count, blocks, tags };
}

/** The number of each packet among the words, and its data. */
export function readPackets(key: Uint8Array, { count, blocks, tags }: TaggedWords): [number, Uint8Array][] {
  const found: [number, Uint8Array][] = [];
  if (!count) return found;
  const encrypted = ecb(key, { disablePadding: true }).encrypt(blocks); // as a pseudorandom function
  const view = new DataView(encrypted.buffer, encrypted.byteOffset);
  for (let row = 0; row < count; row++) {
    const [high, low] = [view.getUint32(16 * row), view.getUint32(16 * row + 4)]; // of which 36 bits are the mask
    const tag = tags[2 * row] ^ ((high << 4) | (low >>> 28));
    const number = (((tags[2 * row + 1] ^ (high >>> 28)) << 16) | (tag >>> 16)) >>> 0;
    if (mix(number)[1] >>> 16 === (tag & 0xffff)) found.push([number, blocks.subarray(16 * row, 16 * row + PACKET_BYTES)]);
  }
  return found;
}

/** The number that most headers tell; null where there are too few. */
export function readHeader(key: Uint8Array, words: TaggedWords): number | null {
  const [value, count] = mostFrequent(readPackets(key, words).map(([number]) => number)) ?? [0, 0];
  return count >= AGREEING_HEADERS ? value : null;
}

/** The codewords of a payload; null where no writer would have written this header. */
export function codewordsOf(header: number): Codewords | null {
  const [count, k] = [header >> DATA_BITS, header & ((1 << DATA_BITS) - 1)];
  if (!(count > 0 && count <= MAX_CODEWORDS && k > 0 && k <= MAX_DATA)) return null;
  let n = k;
  while (n * LEFT - DEVIATIONS * Math.sqrt(n * LEFT * (1 - LEFT)) < k) n++;
  return { count, n: Math.min(n, MAX_CHUNKS), k, width: PACKET_BYTES };
}
