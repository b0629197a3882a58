/** Packets of a payload in blocks of one size; `_Blocks` in `keyss.channels.appended.channel` on the other side. */
import { InputError } from '../../core/errors.ts';
import { decodeCodeword } from '../reed_solomon.ts';
import { NUMBER_BITS, PACKET_BYTES, readPackets, type TaggedWords } from './packets.ts';

const LENGTH_BITS = 8; // of the packets of a block that hold data
const MOST_DATA = 150; // packets of a block that hold data
const MOST_CHUNKS = 255;
const MOST_BLOCKS = Math.min(1 << (NUMBER_BITS - LENGTH_BITS), Math.floor((1 << NUMBER_BITS) / MOST_CHUNKS)) - 1;
const [LEFT, DEVIATIONS] = [0.72, 4.5]; // of packets that may be relied upon

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
      if (decoded === null) throw new InputError('The key is right, but too much of the model was lost or changed.');
      decoded.forEach((packet, index) => found.set(packet, (index * count + block) * PACKET_BYTES));
    }
    return found;
  }
}
