/** Cells: a few bytes of each carrier, recognisable with the key and noise without; see docs/byte-layout.md, "Cells". */
import { encryptBlocks } from '../../keys/aes.ts';
import { expand } from '../../keys/keys.ts';

export const TAG_BYTES = 4;
const BLOCK = 16; // bytes of a block of AES, and of an ID
const CELLS = 1 << 14; // at a time

/** The data of a cell, and its carrier. */
export interface Cell {
  readonly row: number;
  readonly data: Uint8Array;
}

/** Decrypts cells of `size` bytes of data for one use of a secret. */
export class CellCipher {
  private readonly tagKey: Uint8Array;
  private readonly seedKey: Uint8Array;
  private readonly streamKey: Uint8Array;

  constructor(secret: Uint8Array, label: string, readonly size: number) {
    [this.tagKey, this.seedKey, this.streamKey] = ['tag', 'seed', 'stream'].map((use) => expand(secret, `${label}/${use}`));
  }

  /** The cells with a valid tag among the first bytes of every row of `low` [N, width]. */
  decrypt(ids: Uint8Array, low: Uint8Array, width: number): Cell[] {
    const [{ size, stride }, found] = [this, [] as Cell[]];
    for (let start = 0; start < ids.length / BLOCK; start += CELLS) {
      const own = ids.subarray(start * BLOCK, (start + CELLS) * BLOCK);
      const cells = low.subarray(start * width);
      const [count, streams] = [own.length / BLOCK, this.streams(own, cells, width)];
      const messages = new Uint8Array(count * stride); // data, and zeros up to a block
      for (let cell = 0; cell < count; cell++) {
        const [to, from] = [cell * stride, cell * width + TAG_BYTES];
        for (let at = 0; at < size; at++) messages[to + at] = cells[from + at] ^ streams[cell * size + at];
      }
      const states = this.states(own, messages);
      for (let cell = 0; cell < count; cell++) {
        let different = 0;
        for (let at = 0; at < TAG_BYTES; at++) different |= states[cell * BLOCK + at] ^ cells[cell * width + at];
        if (different === 0) found.push({ row: start + cell, data: messages.slice(cell * stride, cell * stride + size) });
      }
    }
    return found;
  }

  /** [N, size] the key streams of cells whose data are zeros: a pseudo-random function of `ids`. */
  pads(ids: Uint8Array): Uint8Array {
    const states = this.states(ids, new Uint8Array((ids.length / BLOCK) * this.stride));
    return this.streams(ids, states, BLOCK);
  }

  private get stride(): number {
    return Math.ceil(this.size / BLOCK) * BLOCK;
  }

  /** [N, 16] that begin with the tags of `messages` [N, stride]. */
  private states(ids: Uint8Array, messages: Uint8Array): Uint8Array {
    const { stride } = this;
    let state = encryptBlocks(this.tagKey, ids);
    for (let block = 0; block < stride; block += BLOCK) {
      for (let at = 0; at < state.length; at++) state[at] ^= messages[Math.floor(at / BLOCK) * stride + block + (at % BLOCK)];
      state = encryptBlocks(this.tagKey, state);
    }
    return state;
  }

  /** [N, size] the key streams; every `width` bytes of `cells` begin with a tag. */
  private streams(ids: Uint8Array, cells: Uint8Array, width: number): Uint8Array {
    const [{ size }, count] = [this, ids.length / BLOCK];
    const found = new Uint8Array(count * size);
    let seeds: Uint8Array = ids.slice();
    for (let cell = 0; cell < count; cell++) {
      for (let at = 0; at < TAG_BYTES; at++) seeds[cell * BLOCK + at] ^= cells[cell * width + at];
    }
    seeds = encryptBlocks(this.seedKey, seeds);
    for (let start = 0; start < size; start += BLOCK) {
      const counted = seeds.slice();
      for (let cell = 0; cell < count; cell++) counted[(cell + 1) * BLOCK - 1] ^= start / BLOCK;
      const stream = encryptBlocks(this.streamKey, counted);
      const end = Math.min(BLOCK, size - start);
      for (let cell = 0; cell < count; cell++) {
        for (let at = 0; at < end; at++) found[cell * size + start + at] = stream[cell * BLOCK + at];
      }
    }
    return found;
  }
}
