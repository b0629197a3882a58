/**
 * Bits in numbers: dithered quantisation index modulation (Chen and Wornell 2001), read softly;
 * `keyss.channels.colours.lattice` on the other side.
 */
import { ecb } from '@noble/ciphers/aes.js';
import { mixAt, type Words, wordsOf } from '../../core/words.ts';
import { expand } from '../../keys/derivation.ts';
import { type Carriers, impact } from './carriers.ts';

export const COLUMNS = 2; // numbers of a Gaussian that are written
const SPACING = 0.0275; // between neighbouring points
export const LEVELS = 64;
const MOST_BITS = 5; // of a number
const FOUR = Math.log(4);
const [LEVEL_STEP, MIDDLE] = [FOUR / 4, 44];
const NOISE = 0.23; // standard deviation of what formats do to a number, of the spacing

/** `level`: below LEVELS, the more the more bits. `depth`: bits of a number, at most. */
export interface Lattice {
  readonly level: number;
  readonly depth: number;
}

/** [C] bits of each of a carrier's numbers. */
export function bitsOf({ level, depth }: Lattice, { count, names }: Carriers): Uint8Array {
  const water = (level - MIDDLE) * LEVEL_STEP + MOST_BITS * FOUR;
  const found = new Uint8Array(count);
  for (let row = 0; row < count; row++) {
    found[row] = Math.max(0, Math.min(depth, Math.floor((water - impact(names, row)) / FOUR)));
  }
  return found;
}

/** [B] what each bit is, as the fountain understands it: of each carrier's number the first, second, ... `counts` [C]. */
export function seedsOf(numbers: Words, counts: ArrayLike<number>): Words {
  let size = 0;
  for (let row = 0; row < counts.length; row++) size += counts[row];
  const found = new Uint32Array(2 * size);
  const order = new Uint32Array(2);
  let to = 0;
  for (let row = 0; row < counts.length; row++) {
    for (let bit = 1; bit <= counts[row]; bit++, to++) {
      [order[0], order[1]] = [bit, 0];
      mixAt(order, 0);
      found[2 * to] = numbers[2 * row] ^ order[0];
      found[2 * to + 1] = numbers[2 * row + 1] ^ order[1];
      mixAt(found, to);
    }
  }
  return found;
}

/** [B] logarithms of P(0) / P(1); `dither` [C, 2]; `doubt` [C]: chance that a carrier holds something else. */
export function readBits(
  lattice: Lattice, dither: Float64Array, carriers: Carriers, doubt: Float64Array, bits = bitsOf(lattice, carriers),
): Float32Array {
  const { count, values } = carriers;
  const found = new Float32Array(COLUMNS * bits.reduce((sum, each) => sum + each, 0));
  const weights = new Float64Array(4);
  let to = 0;
  for (let row = 0; row < count; row++) {
    const own = bits[row];
    const period = 2 ** own;
    if (own > MOST_BITS) to += COLUMNS * own; // no writer has so many: nothing is known of them
    else for (let column = 0; own && column < COLUMNS; column++) {
      const at = COLUMNS * row + column;
      const off = values[at] / SPACING - dither[at] * period;
      const place = off - Math.floor(off / period) * period;
      const first = Math.floor(place) - 1;
      let sum = 0;
      for (let point = 0; point < 4; point++) {
        weights[point] = Math.exp(-((place - first - point) ** 2) / (2 * NOISE ** 2));
        sum += weights[point];
      }
      for (let bit = own - 1; bit >= 0; bit--) {
        let ones = 0;
        for (let point = 0; point < 4; point++) {
          const label = (first + point) & (period - 1);
          ones += ((label ^ (label >> 1)) >> bit) & 1 ? weights[point] : 0;
        }
        const chance = Math.max(1e-9, Math.min(1 - 1e-9, ((1 - doubt[row]) * ones) / sum + doubt[row] / 2));
        found[to++] = Math.log((1 - chance) / chance);
      }
    }
  }
  return found;
}

/** [C, 2] numbers in [0, 1) that only the secret tells. */
export function dithers(secret: Uint8Array, names: Int16Array): Float64Array {
  const words = encrypted(secret, 'dither', names);
  const found = new Float64Array(words.length >> 1);
  for (let at = 0; at < found.length; at++) {
    found[at] = (words[2 * at + 1] * 2 ** 21 + (words[2 * at] >>> 11)) / 2 ** 53;
  }
  return found;
}

/** [C] a number for each name [C, NAME]; equal for equal names. */
export function rank(secret: Uint8Array, label: string, names: Int16Array): Words {
  const words = encrypted(secret, label, names);
  const found = new Uint32Array(words.length >> 1);
  for (let row = 0; row < found.length >> 1; row++) {
    found[2 * row] = words[4 * row];
    found[2 * row + 1] = words[4 * row + 1];
  }
  return found;
}

/** [C, 2] of AES-256 of the names: a pseudo-random function of them. */
function encrypted(secret: Uint8Array, label: string, names: Int16Array): Words {
  const bytes = new Uint8Array(names.buffer, names.byteOffset, names.byteLength);
  if (!bytes.length) return new Uint32Array(0);
  return wordsOf(ecb(expand(secret, `robust/${label}`, 32), { disablePadding: true }).encrypt(bytes));
}
