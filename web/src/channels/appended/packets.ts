/** Packets: 6 bytes, and which ones they are, in words of 84 bits; `keyss.channels.appended.packets` on the other side. */
import { ecb } from '@noble/ciphers/aes.js';
import { mostFrequent } from '../../core/bytes.ts';
import { tooMuchLost } from '../../core/errors.ts';
import { mixAt } from '../../core/words.ts';
import { decodeCodeword } from '../reed_solomon.ts';

const PACKET_BYTES = 6;
const NUMBER_BITS = 20;
const LENGTH_BITS = 8; // of the packets of a block that hold data
const MOST_DATA = 150; // packets of a block that hold data
const MOST_CHUNKS = 255;
const MOST_BLOCKS = Math.min(1 << (NUMBER_BITS - LENGTH_BITS), Math.floor((1 << NUMBER_BITS) / MOST_CHUNKS)) - 1;
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

/** Calls `found` with the number of each packet among the words and its row. */
export function readPackets(
  key: Uint8Array, { count, blocks, tags }: TaggedWords, found: (number: number, row: number) => void,
): void {
  if (!count) return;
  const encrypted = ecb(key, { disablePadding: true }).encrypt(blocks); // as a pseudorandom function
  const view = new DataView(encrypted.buffer, encrypted.byteOffset);
  const state = new Uint32Array(2);
  for (let row = 0; row < count; row++) {
    const [high, low] = [view.getUint32(16 * row), view.getUint32(16 * row + 4)]; // of which 36 bits are the mask
    const tag = tags[2 * row] ^ ((high << 4) | (low >>> 28));
    const number = (((tags[2 * row + 1] ^ (high >>> 28)) << 16) | (tag >>> 16)) >>> 0;
    [state[0], state[1]] = [number, 0];
    mixAt(state, 0);
    if (state[1] >>> 16 === (tag & 0xffff)) found(number, row);
  }
}

/** The number that most headers tell; null where there are too few. */
export function readHeader(key: Uint8Array, words: TaggedWords): number | null {
  const numbers: number[] = [];
  readPackets(key, words, (number) => numbers.push(number));
  const [value, count] = mostFrequent(numbers) ?? [0, 0];
  return count >= AGREEING_HEADERS ? value : null;
}

/** Packets of a payload in blocks of one size. */
export class Blocks {
  private constructor(readonly count: number, readonly data: number) {}

  /** null where no writer would have written this header. */
  static ofHeader(header: number): Blocks | null {
    const [count, data] = [header >> LENGTH_BITS, header & ((1 << LENGTH_BITS) - 1)];
    return count > 0 && count <= MOST_BLOCKS && data > 0 && data <= MOST_DATA ? new Blocks(count, data) : null;
  }

  /** Packets of a block. */
  get length(): number {
    let length = this.data;
    while (length * LEFT - DEVIATIONS * Math.sqrt(length * LEFT * (1 - LEFT)) < this.data) length++;
    return Math.min(length, MOST_CHUNKS);
  }

  /** The encrypted payload. Raises InputError where too few packets are left. */
  decode(key: Uint8Array, words: TaggedWords): Uint8Array {
    const { count, data, length } = this;
    const rows = new Int32Array(count * length).fill(-1);
    readPackets(key, words, (number, row) => {
      // Two packets with one number: one is there by chance, and both are left out.
      if (number < rows.length) rows[number] = rows[number] === -1 ? row : -2;
    });
    const found = new Uint8Array(count * data * PACKET_BYTES);
    for (let block = 0; block < count; block++) {
      const left = new Map<number, Uint8Array>();
      for (let index = 0; index < length; index++) {
        const row = rows[index * count + block];
        if (row >= 0) left.set(index, words.blocks.subarray(16 * row, 16 * row + PACKET_BYTES));
      }
      const decoded = decodeCodeword(left, data, length);
      if (decoded === null) throw tooMuchLost();
      decoded.forEach((packet, index) => found.set(packet, (index * count + block) * PACKET_BYTES));
    }
    return found;
  }
}
