/**
 * Words of 84 bits in faint Gaussians, read after a format has rounded them (docs/channels.md); counterpart of
 * `keyss.channels.appended.words`.
 */
import { COLUMNS, type Gaussians, opacity, where, withDegree } from '../../core/gaussians.ts';
import { moved, type Similarity } from '../../core/similarity.ts';
import type { Words } from '../../core/words.ts';

export const [COLOUR_BITS, SCALE_BITS, POSITION_BITS, TURN_BITS] = [7, 6, 10, 5];
const [FAINTEST, STRONGEST] = [0.4 / 255, 1.6 / 255]; // after rounding
const [COLOUR_STEP, SCALE_STEP] = [0.0275, 0.08];
const TURNS_REACH = (256 / 511) * Math.SQRT1_2; // bound of x, y and z, so that w is the largest
const [FARTHEST, MAX_SHIFTS] = [1 << 12, 500]; // steps of log scales: range, and number of offsets tried

/** The Gaussians as faint as appended ones, without harmonics. */
export function candidates(model: Gaussians): Gaussians {
  const faint = where(model, (row) => {
    const own = opacity(model.opacityLogits[row]);
    return own > FAINTEST && own < STRONGEST && COLUMNS.every((column) => {
      const width = model[column].length / model.count;
      return model[column].subarray(width * row, width * (row + 1)).every(Number.isFinite);
    });
  });
  return withDegree(faint, 0);
}

/** [N, 3] the nearest lattice points of colours. */
export function coloursOf(faint: Gaussians): Uint8Array {
  return Uint8Array.from(faint.sh, (each) => nearest(each / COLOUR_STEP + 2 ** (COLOUR_BITS - 1) - 0.5, COLOUR_BITS));
}

/** [N, 3] log scales in steps of their lattice, which lies anywhere: see `likelyShifts`. */
export function scaleSteps(faint: Gaussians): Float64Array {
  return Float64Array.from(faint.logScales, (each) => each / SCALE_STEP);
}

/** [N, 3] the nearest lattice points of log scales, of a lattice that begins at `shift`. */
export function scalesAt(steps: Float64Array, shift: number): Uint8Array {
  return Uint8Array.from(steps, (each) => nearest(each - shift, SCALE_BITS));
}

/** Where the lattice may begin if most of the log scales lie on it, the likeliest first. */
export function likelyShifts(steps: Float64Array): number[] {
  let [cosines, sines] = [0, 0];
  for (const each of steps) {
    cosines += Math.cos(2 * Math.PI * each);
    sines += Math.sin(2 * Math.PI * each);
  }
  const phase = Math.atan2(sines, cosines) / (2 * Math.PI);
  const counts = new Uint32Array(2 * FARTHEST + 1);
  for (const each of steps) counts[Math.max(-FARTHEST, Math.min(FARTHEST, Math.round(each - phase))) + FARTHEST]++;
  let [inside, most, best] = [0, -1, 0]; // of the levels up to `last`
  for (let last = 0; last < counts.length + 2 ** SCALE_BITS - 1; last++) {
    inside += (counts[last] ?? 0) - (counts[last - 2 ** SCALE_BITS] ?? 0);
    if (inside > most) [most, best] = [inside, last];
  }
  const first = best - 2 ** SCALE_BITS + 1 - FARTHEST;
  return [0, 1, -1, 2, -2].map((each) => first + phase + each);
}

/** Possible offsets of the lattice if only some log scales lie on it. */
export function allShifts(steps: Float64Array): number[] {
  const sorted = steps.map((each) => Math.max(-FARTHEST, Math.min(FARTHEST, each))).sort();
  const [low, high] = [0.01, 0.99].map((share) => sorted[Math.round(share * (sorted.length - 1))]);
  const end = Math.max(Math.min(high - 2 ** (SCALE_BITS - 2), low + MAX_SHIFTS), low);
  const found: number[] = [];
  for (let shift = low - 2 ** (SCALE_BITS - 1); shift < end; shift += 0.25) found.push(shift);
  return found;
}

/** [N] the first 39 bits of words, colours and scales [N, 3]: invariant under similarity transforms. */
export function invariantsOf(colours: Uint8Array, scales: Uint8Array): Words {
  const found = new Uint32Array((2 * colours.length) / 3);
  for (let row = 0; row < colours.length / 3; row++) {
    const at = 3 * row;
    const colour = (colours[at] << 14) | (colours[at + 1] << 7) | colours[at + 2]; // 21 bits
    const scale = (scales[at] << 12) | (scales[at + 1] << 6) | scales[at + 2]; // 18 bits
    found[2 * row] = (colour << 18) | scale;
    found[2 * row + 1] = colour >>> 14;
  }
  return found;
}

/** [N, 6] nearest lattice points of positions and rotations; `toOwn`: from the world to the own frame. */
export function inOwnFrame(faint: Gaussians, toOwn: Similarity): Uint16Array {
  const found = new Uint16Array(6 * faint.count);
  const { means, quats } = moved(toOwn, faint);
  for (let row = 0; row < faint.count; row++) {
    for (let axis = 0; axis < 3; axis++) {
      found[6 * row + axis] = nearest(means[3 * row + axis] * 2 ** POSITION_BITS - 0.5, POSITION_BITS);
    }
    const turned = [...quats.subarray(4 * row, 4 * row + 4)];
    withLargestW(turned).slice(1).forEach((part, axis) => {
      found[6 * row + 3 + axis] = nearest(((part + TURNS_REACH) / (2 * TURNS_REACH)) * 2 ** TURN_BITS - 0.5, TURN_BITS);
    });
  }
  return found;
}

const ORDER = [[0, 1, 2, 3], [1, 0, 3, 2], [2, 3, 0, 1], [3, 2, 1, 0]]; // q, q i, q j, q k
const SIGNS = [[1, 1, 1, 1], [-1, 1, 1, -1], [-1, -1, 1, 1], [-1, 1, -1, 1]];

/** The unit quaternion wxyz of the same ellipsoid with w the largest component. */
function withLargestW(quat: number[]): number[] {
  const length = Math.max(1e-30, Math.hypot(...quat));
  const largest = [0, 1, 2, 3].reduce((a, b) => (Math.abs(quat[b]) > Math.abs(quat[a]) ? b : a));
  const found = ORDER[largest].map((part, at) => (quat[part] / length) * SIGNS[largest][at]);
  return found[0] < 0 ? found.map((each) => -each) : found;
}

function nearest(steps: number, bits: number): number {
  return Math.max(0, Math.min(2 ** bits - 1, Math.round(steps)));
}
