/**
 * Bits in numbers: dithered quantisation index modulation (Chen and Wornell 2001), read softly;
 * `keyss.channels.colours.lattice` on the other side.
 */
import { ecb } from '@noble/ciphers/aes.js';
import { mix, type Words, wordsOf } from '../../core/words.ts';
import { expand } from '../../keys/keys.ts';
import { type Carriers, impact } from './carriers.ts';

export const COLUMNS = 2; // numbers of a Gaussian that are written
export const MAX_BITS = 5; // of a number
const SPACING = 0.0275; // between neighbouring points
export const LEVELS = 64;
const BIT = Math.log(4); // of impact; a level is a quarter of a bit
const MIDDLE = 24; // level at which an impact of zero carries nothing any more
const NOISE = 0.23; // standard deviation of a format's rounding, in spacings

/** [C] bits of each of a carrier's numbers: at most `depth`, and more at a higher level (below LEVELS). */
export function bitCounts({ count, names }: Carriers, level: number, depth: number): Uint8Array {
  return Uint8Array.from({ length: count }, (_, row) => {
    return Math.max(0, Math.min(depth, Math.floor((level - MIDDLE) / 4 - impact(names, row) / BIT)));
  });
}

/** [B] the seeds of all bits of Gaussians, for the fountain; `numbers` [C]: of `rank`; `bits` [C]: of each number. */
export function seedsOf(numbers: Words, bits: Uint8Array): Words {
  const found = new Uint32Array(2 * COLUMNS * sum(bits));
  let to = 0;
  bits.forEach((count, row) => {
    for (let bit = 1; bit <= COLUMNS * count; bit++, to++) {
      const [low, high] = mix(bit);
      found.set(mix(numbers[2 * row] ^ low, numbers[2 * row + 1] ^ high), 2 * to);
    }
  });
  return found;
}

/** [B] logarithms of P(0) / P(1); `dither` [C, 2]; `bits`, `doubt` [C]: of each number; chance that it holds something else. */
export function readBits(dither: Float64Array, { values }: Carriers, bits: Uint8Array, doubt: Float64Array): Float32Array {
  const found = new Float32Array(COLUMNS * sum(bits));
  const [weights, labels] = [new Float64Array(4), new Uint8Array(4)]; // of the points around a number
  let to = 0;
  values.forEach((value, at) => {
    const row = Math.floor(at / COLUMNS);
    const period = 2 ** bits[row];
    const off = value / SPACING - dither[at] * period;
    const place = off - Math.floor(off / period) * period;
    let all = 0;
    for (let each = 0; each < 4; each++) {
      const point = Math.floor(place) - 1 + each;
      weights[each] = Math.exp(-((place - point) ** 2) / (2 * NOISE ** 2));
      labels[each] = (point & (period - 1)) ^ ((point & (period - 1)) >> 1);
      all += weights[each];
    }
    for (let bit = bits[row] - 1; bit >= 0; bit--) {
      let ones = 0;
      for (let each = 0; each < 4; each++) if ((labels[each] >> bit) & 1) ones += weights[each];
      const chance = Math.max(1e-9, Math.min(1 - 1e-9, ((1 - doubt[row]) * ones) / all + doubt[row] / 2));
      found[to++] = Math.log((1 - chance) / chance);
    }
  });
  return found;
}

export function sum(values: Uint8Array | Float64Array): number {
  let found = 0;
  for (const each of values) found += each;
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
  return wordsOf(ecb(expand(secret, `colours/${label}`, 32), { disablePadding: true }).encrypt(bytes));
}
