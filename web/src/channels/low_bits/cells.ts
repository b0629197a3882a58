/** Cells: a few bytes of each Gaussian, recognisable with the key and noise without; see docs/format.md, "Cells". */
import { ecb } from '@noble/ciphers/aes.js';
import { expand } from '../../keys/derivation.ts';
import { IDENTITY_BYTES } from './bits.ts';

const BLOCK = 16;
const CELLS = 1 << 14; // at a time

/** What was found: rows of Gaussians, and the data of each. */
export interface Found {
  readonly rows: number[];
  readonly data: Uint8Array[];
}

/** Decrypts cells of `size` bytes of data for one use of a secret. */
export class CellCipher {
  readonly cellBytes: number;
  private readonly tagKey: Uint8Array;
  private readonly seedKey: Uint8Array;
  private readonly streamKey: Uint8Array;

  constructor(secret: Uint8Array, label: string, readonly size: number, private readonly tagBytes = 4) {
    this.cellBytes = tagBytes + size;
    [this.tagKey, this.seedKey, this.streamKey] = ['tag', 'seed', 'stream'].map((use) =>
      expand(secret, `${label}/${use}`, 32),
    );
  }

  /** Tries the bytes from `offset` on of every row of `low` [N, width]. */
  decrypt(names: Uint8Array, low: Uint8Array, width: number, offset: number, slot: number): Found {
    const found: Found = { rows: [], data: [] };
    const count = names.length / IDENTITY_BYTES;
    for (let start = 0; start < count; start += CELLS) {
      this.decryptSome(found, names, low, width, offset, slot, start, Math.min(count, start + CELLS));
    }
    return found;
  }

  private decryptSome(
    found: Found, names: Uint8Array, low: Uint8Array, width: number, offset: number, slot: number,
    start: number, end: number,
  ): void {
    const { size, tagBytes } = this;
    const count = end - start;
    const own = names.subarray(start * IDENTITY_BYTES, end * IDENTITY_BYTES);
    let seeds: Uint8Array = own.slice();
    for (let cell = 0; cell < count; cell++) {
      const from = (start + cell) * width + offset;
      for (let at = 0; at < tagBytes; at++) seeds[cell * BLOCK + at] ^= low[from + at];
      seeds[cell * BLOCK + tagBytes] ^= slot;
    }
    seeds = encrypted(this.seedKey, seeds);
    const blocks = Math.ceil(size / BLOCK);
    const counted = new Uint8Array(count * blocks * BLOCK);
    for (let cell = 0; cell < count; cell++) {
      const seed = seeds.subarray(cell * BLOCK, (cell + 1) * BLOCK);
      for (let block = 0; block < blocks; block++) {
        const to = (cell * blocks + block) * BLOCK;
        counted.set(seed, to);
        counted[to + BLOCK - 1] ^= block;
      }
    }
    const stream = encrypted(this.streamKey, counted);
    const messageBlocks = Math.ceil((1 + size) / BLOCK);
    const messages = new Uint8Array(count * messageBlocks * BLOCK);
    for (let cell = 0; cell < count; cell++) {
      const from = (start + cell) * width + offset + tagBytes;
      const to = cell * messageBlocks * BLOCK;
      messages[to] = slot;
      for (let at = 0; at < size; at++) {
        messages[to + 1 + at] = low[from + at] ^ stream[cell * blocks * BLOCK + at];
      }
    }
    let state = encrypted(this.tagKey, own.slice());
    for (let block = 0; block < messageBlocks; block++) {
      const mixed = state.slice();
      for (let cell = 0; cell < count; cell++) {
        const from = (cell * messageBlocks + block) * BLOCK;
        for (let at = 0; at < BLOCK; at++) mixed[cell * BLOCK + at] ^= messages[from + at];
      }
      state = encrypted(this.tagKey, mixed);
    }
    for (let cell = 0; cell < count; cell++) {
      const from = (start + cell) * width + offset;
      let different = 0;
      for (let at = 0; at < tagBytes; at++) different |= state[cell * BLOCK + at] ^ low[from + at];
      if (different === 0) {
        const message = cell * messageBlocks * BLOCK + 1;
        found.rows.push(start + cell);
        found.data.push(messages.slice(message, message + size));
      }
    }
  }
}

/** Every 16 bytes through AES-256: a permutation of blocks, not a mode of operation. */
function encrypted(key: Uint8Array, blocks: Uint8Array): Uint8Array {
  return blocks.length ? ecb(key, { disablePadding: true }).encrypt(blocks) : blocks;
}
