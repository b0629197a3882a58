/**
 * Bits in numbers: dithered quantisation index modulation (Chen and Wornell 2001), read softly;
 * `keyss.channels.colours.lattice` on the other side.
 */
import { ecb } from '@noble/ciphers/aes.js';
import { mixed, type Words, wordsOf } from '../../core/words.ts';
import { expand } from '../../keys/derivation.ts';
import type { Carriers } from './carriers.ts';

export const COLUMNS = 2; // numbers of a Gaussian that are written
const SPACING = 0.0275; // between the points of both lattices
const NOISE = 0.23; // standard deviation of a format's rounding, in spacings

/** [2 C] the seeds of all numbers of Gaussians, for the fountain; `numbers` [C]: of `rank`. */
export function seedsOf(numbers: Words): Words {
  const found = new Uint32Array(COLUMNS * numbers.length);
  const orders = mixed(Uint32Array.of(1, 0, 2, 0));
  for (let to = 0; to < found.length; to++) {
    found[to] = numbers[2 * Math.floor(to / (2 * COLUMNS)) + (to & 1)] ^ orders[to % (2 * COLUMNS)];
  }
  return mixed(found);
}

/** [2 C] logarithms of P(0) / P(1); `dither` [C, 2]; `doubt` [C]: chance that a carrier holds something else. */
export function readBits(dither: Float64Array, { values }: Carriers, doubt: Float64Array): Float32Array {
  return Float32Array.from(values, (value, at) => {
    const off = value / SPACING - 2 * dither[at];
    const place = off - 2 * Math.floor(off / 2);
    const first = Math.floor(place) - 1;
    let [ones, sum] = [0, 0];
    for (let point = first; point < first + 4; point++) {
      const weight = Math.exp(-((place - point) ** 2) / (2 * NOISE ** 2));
      sum += weight;
      if (point & 1) ones += weight;
    }
    const sure = 1 - doubt[Math.floor(at / COLUMNS)];
    const chance = Math.max(1e-9, Math.min(1 - 1e-9, (sure * ones) / sum + (1 - sure) / 2));
    return Math.log((1 - chance) / chance);
  });
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
