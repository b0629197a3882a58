/** Decodes a model from one string of bytes; counterpart of `keyss.methods.codec.model_bytes`. */
import { viewOf } from '../core/bytes.ts';
import { damaged } from '../core/errors.ts';
import { coefficients, emptyGaussians, type Gaussians } from '../core/gaussians.ts';
import { decodeTable } from './entropy.ts';

const ALWAYS = 1 << 16; // Gaussians allowed in any payload
const MIN_BYTES = 2; // per Gaussian in larger models
const PER_CARRIER = 8; // Gaussians of larger models; some carriers may be lost
const HEAD_BYTES = 53; // Gaussians (4), SH degree (1), centres (20), steps (24), typical weight (4)
const BLOCK = 1 << 13; // Gaussians that are coded together
const [MAX_CENTRE, MAX_STEP] = [1e30, 1e6];
const DIFFERENCE = 1.5; // step of constant colour differences relative to brightness
const PER_OCTAVE = 0.5 / Math.LN2; // half octaves of the step
const FINER = 6; // half octaves: maximum change of a step
const LEAST_W = 1 / 16; // minimum of w squared
const [BRIGHTNESS, RED_GREEN, BLUE] = [1 / Math.sqrt(3), 1 / Math.sqrt(2), 1 / Math.sqrt(6)];
// For x, y, z, log scales, opacity, colours and quaternion; harmonics have two more groups and no shares.
const [SHARES, GROUPS] = [[8, 8, 8, 2, 2, 2, 2, 6, 6, 6, 0, 0, 0], [0, 0, 0, 1, 1, 1, 2, 3, 4, 4, 5, 5, 5]];

/** What all blocks of a model share. */
interface Head {
  readonly count: number;
  readonly shDegree: number;
  readonly centres: readonly number[];
  readonly steps: readonly number[];
  readonly typical: number; // logarithm of area x opacity^2
}

/**
 * The model in a payload that a model of `carriers` Gaussians holds. Raises InputError for damage, and for more than
 * 2^16 Gaussians if they exceed 8 times `carriers` or take less than 2 bytes each.
 */
export function decodeModel(data: Uint8Array, carriers: number): Gaussians {
  if (data.length < HEAD_BYTES) throw damaged();
  const view = viewOf(data);
  const [count, shDegree] = [view.getUint32(0, true), data[4]];
  const numbers = Array.from({ length: 12 }, (_, at) => view.getFloat32(5 + 4 * at, true));
  const head = { count, shDegree, centres: numbers.slice(0, 5), steps: numbers.slice(5, 11), typical: numbers[11] };
  const largest = Math.max(ALWAYS, Math.min(Math.floor(data.length / MIN_BYTES), PER_CARRIER * carriers));
  const centred = [...head.centres, head.typical].every((each) => Math.abs(each) < MAX_CENTRE);
  const bounded = centred && head.steps.every((each) => each > 0 && each <= MAX_STEP);
  if (!(count > 0 && count <= largest && shDegree <= 3 && bounded)) throw damaged();
  const blocks = Math.ceil(count / BLOCK);
  let start = HEAD_BYTES + 4 * blocks;
  if (start > data.length) throw damaged();
  const model = emptyGaussians(count, shDegree);
  for (let block = 0; block < blocks; block++) {
    const end = start + view.getUint32(HEAD_BYTES + 4 * block, true);
    if (end > data.length) throw damaged();
    decodeBlock(data.subarray(start, end), head, model, block * BLOCK);
    start = end;
  }
  if (start !== data.length) throw damaged();
  return model;
}

/** Decodes a block into the rows of `model` from `first` on. */
function decodeBlock(data: Uint8Array, head: Head, model: Gaussians, first: number): void {
  const { centres, typical } = head;
  const k = coefficients(head.shDegree);
  const [shares, groups] = [[...SHARES], [...GROUPS]];
  for (let each = 1; each < k; each++) {
    shares.push(0, 0, 0);
    groups.push(6, 7, 7);
  }
  const count = Math.min(BLOCK, head.count - first);
  const table = decodeTable(data, count, shares, groups);
  const [means, scales, opacity, colours, quats, harmonics] = head.steps;
  const own = new Float64Array(3);
  for (let row = 0, to = first; row < count; row++, to++) {
    for (let axis = 0; axis < 3; axis++) {
      model.means[3 * to + axis] = table[axis][row] * means + centres[axis];
      model.logScales[3 * to + axis] = own[axis] = table[3 + axis][row] * scales + centres[3];
    }
    const logit = (model.opacityLogits[to] = table[6][row] * opacity + centres[4]);
    const [a, b, c] = own;
    const [larger, smaller] = a > b ? [a, b] : [b, a];
    const size = c > larger ? c + larger : larger + Math.max(smaller, c); // of the two longest axes
    const finer = Math.floor((size + 2 * Math.min(logit, 0) - typical) * PER_OCTAVE + 0.5);
    const factor = FACTORS[Math.min(Math.max(finer, -FINER), FINER) + FINER];
    const [x, y, z] = [table[10][row] * (quats * factor), table[11][row] * (quats * factor), table[12][row] * (quats * factor)];
    model.quats[4 * to] = Math.sqrt(Math.max(1 - (x * x + y * y + z * z), LEAST_W));
    model.quats[4 * to + 1] = x;
    model.quats[4 * to + 2] = y;
    model.quats[4 * to + 3] = z;
    const different = colours * DIFFERENCE;
    putColours(model.sh, 3 * k * to, table[7][row] * colours, table[8][row] * different, table[9][row] * different);
    const step = harmonics * factor;
    for (let each = 1, from = 13; each < k; each++, from += 3) {
      putColours(model.sh, 3 * (k * to + each), table[from][row] * step, table[from + 1][row] * step, table[from + 2][row] * step);
    }
  }
}

/** Factors on steps that are finer by -FINER to FINER half octaves. */
const FACTORS = Float64Array.from({ length: 2 * FINER + 1 }, (_, at) => {
  const finer = at - FINER;
  return (finer % 2 ? Math.SQRT2 : 1) * 2 ** -Math.floor((finer + 1) / 2);
});

/** Writes red, green and blue from brightness and two colour differences. */
function putColours(to: Float32Array, at: number, brightness: number, first: number, second: number): void {
  to[at] = brightness * BRIGHTNESS + first * RED_GREEN + second * BLUE;
  to[at + 1] = brightness * BRIGHTNESS - first * RED_GREEN + second * BLUE;
  to[at + 2] = brightness * BRIGHTNESS - 2 * second * BLUE;
}
