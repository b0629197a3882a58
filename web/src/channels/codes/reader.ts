/**
 * What a key opens in the last bits of the codes of a .spz, .sog or compressed .ply; `keyss.channels.codes` on the other
 * side.
 *
 * All that does not depend on the key is done before there is one: a key that opens nothing makes the same passes.
 */
import { ascii } from '../../core/bytes.ts';
import type { Codes } from '../../files/models.ts';
import { decrypted, type Derive, expand, SALT_BYTES } from '../../keys/keys.ts';
import { here } from '../../keys/pool.ts';
import { type Content, type Reader, unpackPayload } from '../content.ts';
import { lastBits } from './fields.ts';
import { findHeader, order, Room, ZONE_RATE } from './layout.ts';
import { BLOCK, bytesOf, matrix, products } from './syndromes.ts';

const ASSOCIATED = ascii('keyss/v1/codes/data');
const USUAL_RATE = 800; // of a key that opens nothing
const MAX_BITS = 2 ** 30; // more would take more memory than tabs have

export class CodesReader implements Reader {
  readonly derivations = 1;

  private constructor(
    private readonly room: Room,
    private readonly zone: Uint8Array, // salt and slots
    private readonly held: Uint32Array, // what blocks of data hold at most
  ) {}

  /** Null for codes that have no room for anything. `silent` [N]: Gaussians that carry nothing. */
  static of(codes: Codes, silent?: Uint8Array): CodesReader | null {
    const bits = lastBits(codes, silent);
    const room = new Room(bits.length);
    if (!room.slots || room.bits > MAX_BITS) return null;
    const noSalt = new Uint8Array(SALT_BYTES);
    const every = order(noSalt, room.bits);
    const zoned = products(bits, every.subarray(0, room.zoneBits), matrix(noSalt, ZONE_RATE));
    const zone = bytesOf(zoned, ZONE_RATE, 0, room.zoneBytes);
    const salt = zone.subarray(0, SALT_BYTES);
    const others = every.subarray(room.zoneBits);
    const places = order(salt, others.length).subarray(0, room.dataBlocks * BLOCK).map((place) => others[place]);
    const seed = new Uint8Array(2 * SALT_BYTES);
    seed.set(salt);
    return new CodesReader(room, zone, products(bits, places, matrix(seed, BLOCK)));
  }

  get salt(): Uint8Array {
    return this.zone.subarray(0, SALT_BYTES);
  }

  /** What `key` opens, null for nothing. Raises InputError for damage. */
  async open(key: string, derive: Derive = here): Promise<Content | null> {
    const secret = await derive(key, this.salt);
    const header = findHeader(this.zone, secret, this.room);
    const most = Math.floor((this.room.dataBlocks * USUAL_RATE) / 8);
    const { rate, start, size } = header ?? { rate: USUAL_RATE, start: 0, size: most };
    const encrypted = bytesOf(this.held, rate, start, size);
    try {
      return unpackPayload(await decrypted(expand(secret, 'codes/data', 32), encrypted, ASSOCIATED));
    } catch (error) {
      if (header === null) return null;
      throw error;
    }
  }
}
