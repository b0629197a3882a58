/** Decodes a model from one string of bytes; counterpart of `keyss.methods.codec.model_bytes`. */
import { viewOf } from '../core/bytes.ts';
import { damaged } from '../core/errors.ts';
import { coefficients, emptyGaussians, type Gaussians } from '../core/gaussians.ts';
import { decodeTable } from './entropy.ts';

const ALWAYS = 1 << 16; // Gaussians allowed in any payload
const MIN_BYTES = 2; // per Gaussian in larger models
const HEAD_BYTES = 49; // Gaussians (4), SH degree (1), centres (20), steps (24)
const [MAX_CENTRE, MAX_STEP] = [1e30, 1e6];
const DIFFERENCE = 1.5; // step of constant colour differences relative to brightness
const PER_OCTAVE = 0.5 / Math.LN2; // half octaves of the step
const FINER = 6; // half octaves: maximum change of a step
const LEAST_W = 1 / 16; // minimum of w squared
const [BRIGHTNESS, RED_GREEN, BLUE] = [1 / Math.sqrt(3), 1 / Math.sqrt(2), 1 / Math.sqrt(6)];
// For x, y, z, log scales, opacity, colours and quaternion; harmonics have two more groups and no shares.
const [SHARES, GROUPS] = [[8, 8, 8, 2, 2, 2, 2, 6, 6, 6, 0, 0, 0], [0, 0, 0, 1, 1, 1, 2, 3, 4, 4, 5, 5, 5]];

/**
 * The model in a payload that a model of `carriers` Gaussians holds. Raises InputError for damage, and for more than
 * 2^16 Gaussians if they exceed `carriers` or take less than 2 bytes each.
 */
export function decodeModel(data: Uint8Array, carriers: number): Gaussians {
  if (data.length < HEAD_BYTES) throw damaged();
  const view = viewOf(data);
  const [count, shDegree] = [view.getUint32(0, true), data[4]];
  const numbers = Array.from({ length: 11 }, (_, at) => view.getFloat32(5 + 4 * at, true));
  const [centres, steps] = [numbers.slice(0, 5), numbers.slice(5)];
  const largest = Math.max(ALWAYS, Math.min(Math.floor(data.length / MIN_BYTES), carriers));
  const centred = centres.every((each) => Math.abs(each) < MAX_CENTRE);
  const bounded = centred && steps.every((each) => each > 0 && each <= MAX_STEP);
  if (!(count > 0 && count <= largest && shDegree <= 3 && bounded)) throw damaged();
  const k = coefficients(shDegree);
  const [shares, groups] = [[...SHARES], [...GROUPS]];
  for (let each = 1; each < k; each++) {
    shares.push(0, 0, 0);
    groups.push(6, 7, 7);
  }
  const table = decodeTable(data.subarray(HEAD_BYTES), count, shares, groups);
  const found = emptyGaussians(count, shDegree);
  const [means, scales, opacity, colours, quats, harmonics] = steps;
  for (let row = 0; row < count; row++) {
    for (let axis = 0; axis < 3; axis++) {
      found.means[3 * row + axis] = table[axis][row] * means + centres[axis];
      found.logScales[3 * row + axis] = table[3 + axis][row] * scales + centres[3];
    }
    found.opacityLogits[row] = table[6][row] * opacity + centres[4];
  }
  finerSteps(found).forEach((finer, row) => {
    const scale = (step: number): number => step * (finer % 2 ? Math.SQRT2 : 1) * 2 ** -Math.floor((finer + 1) / 2);
    const [x, y, z] = [10, 11, 12].map((column) => table[column][row] * scale(quats));
    found.quats.set([Math.sqrt(Math.max(1 - (x * x + y * y + z * z), LEAST_W)), x, y, z], 4 * row);
    const own = scale(harmonics);
    for (let each = 0; each < k; each++) {
      const first = each ? 10 + 3 * each : 7;
      const [bright, different] = each ? [own, own] : [colours, colours * DIFFERENCE];
      const [a, b, c] = [table[first][row] * bright, table[first + 1][row] * different, table[first + 2][row] * different];
      putColours(found.sh, 3 * (k * row + each), a, b, c);
    }
  });
  return found;
}

/** [N] half octaves by which a Gaussian's steps are finer than the median one's, by area and opacity. */
function finerSteps({ count, logScales, opacityLogits }: Gaussians): Int8Array {
  const seen = Float64Array.from({ length: count }, (_, row) => {
    const [, second, third] = logScales.slice(3 * row, 3 * row + 3).sort();
    return third + second + 2 * Math.min(opacityLogits[row], 0);
  });
  const middle = seen.slice().sort()[(count - 1) >> 1];
  return Int8Array.from(seen, (each) => {
    const found = Math.floor((each - middle) * PER_OCTAVE + 0.5);
    return Math.min(Math.max(found, -FINER), FINER);
  });
}

/** Writes red, green and blue from brightness and two colour differences. */
function putColours(to: Float32Array, at: number, brightness: number, first: number, second: number): void {
  to[at] = brightness * BRIGHTNESS + first * RED_GREEN + second * BLUE;
  to[at + 1] = brightness * BRIGHTNESS - first * RED_GREEN + second * BLUE;
  to[at + 2] = brightness * BRIGHTNESS - 2 * second * BLUE;
}
