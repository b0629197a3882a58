/** Dithered quantisation index modulation with soft decisions; counterpart of `keyss.channels.colours.qim`. */
import { mix, type Words } from '../../core/words.ts';
import { type Carriers, fractions, randomPairs } from './carriers.ts';

export const COLUMNS = 2; // modulated values per Gaussian
export const ONE = 0; // level at which every value carries one bit
const MAX_BITS = 5; // per value
const SPACING = 0.0275; // between neighbouring points
const BIT = Math.log(4); // in impact; a level is a quarter of a bit
const MIDDLE = 24; // level at which an impact of zero carries nothing
const NOISE = 0.23; // standard deviation of rounding, in spacings
const POINTS = [-1, 0, 1, 2]; // candidate points, relative to the one below

/** [C] bits per value of carriers: more at higher levels, one less per factor 4 of impact. */
export function bitCounts(impact: Float64Array, level: number): Uint8Array {
  if (level === ONE) return new Uint8Array(impact.length).fill(1);
  return Uint8Array.from(impact, (each) => Math.max(0, Math.min(MAX_BITS, Math.floor((level - MIDDLE) / 4 - each / BIT))));
}

/** [B] the seeds of all bits of carriers, for the fountain; `bits` [C]: of each number. */
export function seedsOf(secret: Uint8Array, label: string, { ids }: Carriers, bits: Uint8Array): Words {
  const [pairs, found] = [randomPairs(secret, label, ids), [] as number[]];
  bits.forEach((count, row) => {
    for (let column = 0; column < COLUMNS; column++) {
      for (let bit = 0; bit < count; bit++) {
        const [low, high] = mix(column * MAX_BITS + bit);
        found.push(...mix(pairs[4 * row] ^ low, pairs[4 * row + 1] ^ high));
      }
    }
  });
  return Uint32Array.from(found);
}

/** [B] P(0) - P(1) of all bits of carriers, `bits` [C] in each number. */
export function readBits(secret: Uint8Array, { ids, colours }: Carriers, bits: Uint8Array): Float64Array {
  const [dithers, found] = [fractions(secret, 'dither', ids), [] as number[]];
  bits.forEach((count, row) => {
    const period = 2 ** count;
    for (let column = 0; column < COLUMNS; column++) {
      const off = colours[3 * row + 1 + column] / SPACING - dithers[COLUMNS * row + column] * period;
      const place = off - Math.floor(off / period) * period;
      const points = POINTS.map((each) => Math.floor(place) + each);
      const weights = points.map((point) => Math.exp(-((place - point) ** 2) / (2 * NOISE ** 2)));
      const all = weights.reduce((sum, each) => sum + each);
      for (let bit = count - 1; bit >= 0; bit--) {
        const signed = weights.map((weight, at) => {
          const label = points[at] & (period - 1);
          return ((label ^ (label >> 1)) >> bit) & 1 ? -weight : weight;
        });
        found.push(signed.reduce((sum, each) => sum + each) / all);
      }
    }
  });
  return Float64Array.from(found);
}
