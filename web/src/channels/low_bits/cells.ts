/** Cells: a few bytes of each Gaussian, recognisable with the key and noise without; see docs/format.md, "Cells". */
import { ecb } from '@noble/ciphers/aes.js';
import { expand } from '../../keys/keys.ts';

export const TAG_BYTES = 4;
const BLOCK = 16; // of AES, and an identity
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

  constructor(secret: Uint8Array, label: string, readonly size: number) {
    this.cellBytes = TAG_BYTES + size;
    [this.tagKey, this.seedKey, this.streamKey] = ['tag', 'seed', 'stream'].map((use) =>
      expand(secret, `${label}/${use}`, 32),
    );
  }

  /** Tries the bytes from `offset` on of every row of `low` [N, width]. */
  decrypt(names: Uint8Array, low: Uint8Array, width: number, offset: number, slot: number): Found {
    const found: Found = { rows: [], data: [] };
    const count = names.length / BLOCK;
    for (let start = 0; start < count; start += CELLS) {
      this.decryptSome(found, names, low, width, offset, slot, start, Math.min(count, start + CELLS));
    }
    return found;
  }

  /** [N, size] what data of zeros would become: pads that follow from the secret and the names. */
  stream(names: Uint8Array): Uint8Array {
    const [count, blocks] = [names.length / BLOCK, Math.ceil((1 + this.size) / BLOCK)];
    let tags = encrypted(this.tagKey, names);
    for (let block = 0; block < blocks; block++) tags = encrypted(this.tagKey, tags);
    let seeds: Uint8Array = names.slice();
    for (let cell = 0; cell < count; cell++) {
      for (let at = 0; at < TAG_BYTES; at++) seeds[cell * BLOCK + at] ^= tags[cell * BLOCK + at];
    }
    seeds = encrypted(this.seedKey, seeds);
    const found = new Uint8Array(count * this.size);
    for (let block = 0; block * BLOCK < this.size; block++) {
      const counted = seeds.slice();
      for (let cell = 0; cell < count; cell++) counted[(cell + 1) * BLOCK - 1] ^= block;
      const stream = encrypted(this.streamKey, counted);
      const width = Math.min(BLOCK, this.size - block * BLOCK);
      for (let cell = 0; cell < count; cell++) {
        found.set(stream.subarray(cell * BLOCK, cell * BLOCK + width), cell * this.size + block * BLOCK);
      }
    }
    return found;
  }

  private decryptSome(
    found: Found, names: Uint8Array, low: Uint8Array, width: number, offset: number, slot: number,
    start: number, end: number,
  ): void {
    const { size } = this;
    const count = end - start;
    const from = (cell: number): number => (start + cell) * width + offset;
    const own = names.subarray(start * BLOCK, end * BLOCK);
    let seeds: Uint8Array = own.slice();
    for (let cell = 0; cell < count; cell++) {
      for (let at = 0; at < TAG_BYTES; at++) seeds[cell * BLOCK + at] ^= low[from(cell) + at];
      seeds[cell * BLOCK + TAG_BYTES] ^= slot;
    }
    seeds = encrypted(this.seedKey, seeds);
    const stride = Math.ceil((1 + size) / BLOCK) * BLOCK;
    const messages = new Uint8Array(count * stride); // slot, data, and zeros up to a block
    for (let block = 0; block * BLOCK < size; block++) {
      const counted = seeds.slice();
      for (let cell = 0; cell < count; cell++) counted[(cell + 1) * BLOCK - 1] ^= block;
      const stream = encrypted(this.streamKey, counted);
      for (let cell = 0; cell < count; cell++) {
        messages[cell * stride] = slot;
        for (let at = block * BLOCK; at < Math.min(size, (block + 1) * BLOCK); at++) {
          messages[cell * stride + 1 + at] = low[from(cell) + TAG_BYTES + at] ^ stream[cell * BLOCK + (at % BLOCK)];
        }
      }
    }
    let state = encrypted(this.tagKey, own);
    for (let block = 0; block < stride; block += BLOCK) {
      for (let at = 0; at < state.length; at++) state[at] ^= messages[Math.floor(at / BLOCK) * stride + block + (at % BLOCK)];
      state = encrypted(this.tagKey, state);
    }
    for (let cell = 0; cell < count; cell++) {
      let different = 0;
      for (let at = 0; at < TAG_BYTES; at++) different |= state[cell * BLOCK + at] ^ low[from(cell) + at];
      if (different !== 0) continue;
      found.rows.push(start + cell);
      found.data.push(messages.slice(cell * stride + 1, cell * stride + 1 + size));
    }
  }
}

/** Every 16 bytes through AES-256: a permutation of blocks, not a mode of operation. */
function encrypted(key: Uint8Array, blocks: Uint8Array): Uint8Array {
  return blocks.length ? ecb(key, { disablePadding: true }).encrypt(blocks) : blocks;
}
