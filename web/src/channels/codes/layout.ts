/** Where what lies among the last bits of all levels; `keyss.channels.codes.layout` on the other side. */
import { chacha20poly1305 } from '@noble/ciphers/chacha.js';
import { ascii, viewOf } from '../../core/bytes.ts';
import { damaged, otherVersion } from '../../core/errors.ts';
import { expand, SALT_BYTES, streamWords } from '../../keys/keys.ts';
import { sortingOrder } from '../../core/words.ts';
import { BLOCK } from './syndromes.ts';

const VERSION = 1;
const [MIN_SLOTS, MAX_SLOTS] = [4, 256];
const [MIN_SHARE, SHARE] = [1 / 4, 1 / 32]; // of all bits that the least slots, and more of them, may take
const HEADER_BYTES = 12; // version (1), bits that a block holds (2), first bit (4), bytes of data (4), unused (1)
const SLOT_BYTES = HEADER_BYTES + 16;
const ASSOCIATED = ascii('keyss/v1/codes');
export const ZONE_RATE = 384; // bits that a block of salt and slots holds

/** What a slot tells. */
export interface Header {
  readonly rate: number; // bits that a block of data holds
  readonly start: number; // of the data, in bits
  readonly size: number; // bytes
}

/** What fits into a number of bits. */
export class Room {
  readonly slots: number; // a power of two; 0 where there is no room for what is needed at least
  readonly zoneBits: number; // in which salt and slots lie
  readonly dataBlocks: number;

  constructor(readonly bits: number) {
    this.slots = slotsIn(bits);
    this.zoneBits = zoneBlocks(this.slots) * BLOCK;
    this.dataBlocks = Math.max(0, Math.floor((bits - this.zoneBits) / BLOCK));
  }

  /** Bytes of salt and slots. */
  get zoneBytes(): number {
    return SALT_BYTES + this.slots * SLOT_BYTES;
  }
}

function slotsIn(bits: number): number {
  if (zoneBlocks(MIN_SLOTS) * BLOCK > bits * MIN_SHARE) return 0;
  let found = MIN_SLOTS;
  while (found < MAX_SLOTS && zoneBlocks(2 * found) * BLOCK <= bits * SHARE) found *= 2;
  return found;
}

function zoneBlocks(slots: number): number {
  return Math.ceil((8 * (SALT_BYTES + slots * SLOT_BYTES)) / ZONE_RATE);
}

/** The bits [count] in a random order that follows from a salt. */
export function order(salt: Uint8Array, count: number): Uint32Array {
  const seed = new Uint8Array(2 * SALT_BYTES);
  seed.set(salt);
  const high = new Uint32Array(count);
  streamWords(seed, 'codes/order', 2 * count, (word, at) => {
    if (at & 1) high[at >>> 1] = word;
  });
  return sortingOrder(high, 1);
}

/** The header that what a key became opens; all slots are tried. Raises InputError for one that makes no sense. */
export function findHeader(zone: Uint8Array, master: Uint8Array, room: Room): Header | null {
  const key = expand(master, 'codes/header', 32);
  let found: Uint8Array | null = null;
  for (let slot = 0; slot < room.slots; slot++) {
    const nonce = new Uint8Array(12);
    viewOf(nonce).setUint32(0, slot, true);
    const start = SALT_BYTES + slot * SLOT_BYTES;
    try {
      const packed = chacha20poly1305(key, nonce, ASSOCIATED).decrypt(zone.subarray(start, start + SLOT_BYTES));
      found ??= packed;
    } catch {
      // noise, or another key's
    }
  }
  if (found === null) return null;
  const view = viewOf(found);
  if (found[0] !== VERSION) throw otherVersion();
  const [rate, start, size] = [view.getUint16(1, true), view.getUint32(3, true), view.getUint32(7, true)];
  const bits = room.dataBlocks * rate;
  if (!(rate <= BLOCK && size > 0 && 8 * size <= bits && start < bits)) throw damaged();
  return { rate, start, size };
}
