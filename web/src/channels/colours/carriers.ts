/**
 * Which numbers of a model carry something, and by what else of the model they are known again;
 * `keyss.channels.colours.carriers` on the other side.
 */
import { median, rowsOf } from '../../core/bytes.ts';
import { type Gaussians, opacity, where, withDegree } from '../../core/gaussians.ts';

export const [SCALE_STEP, COLOUR_STEP, OPACITY_STEP] = [1 / 16, 1 / 38.25, 1 / 255]; // of 8-bit formats
export const CELL = 0.25; // of a log scale
export const [COLOUR_NOISE, OPACITY_NOISE] = [0.009, 0.004]; // what formats move these numbers by, at most
export const NAME = 8; // numbers of a name: five, and zeros up to a block of AES
const [SCALE_STEPS, COLOUR_STEPS, OPACITY_STEPS] = [4, 5, 16]; // that make a cell
const MIN_OPACITY = 2.5 / 255;
const SCALE_NOISE = 0.018;
const SCALE_ROUNDED = SCALE_STEP / 2;
const CELLS = 30_000; // on either side of zero

/** What names and carriers are made of, of the C Gaussians that are visible and finite. */
export interface Numbers {
  readonly count: number;
  readonly size: number; // the median log scale: it tells by how much a model was scaled
  readonly logScales: Float64Array; // [C, 3]
  readonly opacities: Float64Array; // [C]
  readonly colours: Float64Array; // [C, 3] constant coefficients
}

export function numbersOf(model: Gaussians): Numbers {
  const bare = withDegree(model, 0);
  const seen = where(bare, (row) => {
    let sum = 0; // finite where all are
    for (let axis = 0; axis < 3; axis++) sum += bare.logScales[3 * row + axis] + bare.sh[3 * row + axis];
    return Number.isFinite(sum) && Math.fround(opacity(bare.opacityLogits[row])) > MIN_OPACITY;
  });
  const [logScales, colours] = [Float64Array.from(seen.logScales), Float64Array.from(seen.sh)];
  const sizes = Float64Array.from({ length: seen.count }, (_, row) => {
    return (logScales[3 * row] + logScales[3 * row + 1] + logScales[3 * row + 2]) / 3;
  });
  const opacities = Float64Array.from(seen.opacityLogits, (logit) => Math.fround(opacity(logit)));
  return { count: seen.count, size: median(sizes), logScales, opacities, colours };
}

/** C Gaussians as a reader sees them. */
export interface Carriers {
  readonly count: number;
  readonly names: Int16Array; // [C, NAME] numbers of cells: three log scales, opacity, red; zeros
  readonly doubt: Float64Array; // [C] chance that the name is not what it was when it was written
  readonly values: Float64Array; // [C, 2] green and blue
}

/** The carriers and their names. `offset`: what counts as a log scale of zero. */
export function carriersOf(numbers: Numbers, offset: number): Carriers {
  const { count, logScales, opacities, colours } = numbers;
  const scaleNoise = (offset % CELL === 0 ? SCALE_NOISE : SCALE_ROUNDED) / SCALE_STEP;
  const names = new Int16Array(NAME * count);
  const doubt = new Float64Array(count);
  const values = new Float64Array(2 * count);
  for (let row = 0; row < count; row++) {
    let stays = 1;
    const cell = (column: number, value: number, steps: number, noise: number): void => {
      const found = Math.floor(value / steps);
      const inside = value - found * steps;
      const nearest = Math.min(inside, steps - inside);
      stays *= 1 - Math.max(0, Math.min(0.5, (noise - nearest) / (2 * noise)));
      names[NAME * row + column] = Math.max(-CELLS, Math.min(CELLS, found));
    };
    for (let axis = 0; axis < 3; axis++) {
      cell(axis, (logScales[3 * row + axis] - offset) / SCALE_STEP - 0.5, SCALE_STEPS, scaleNoise);
    }
    cell(3, opacities[row] / OPACITY_STEP - 0.5, OPACITY_STEPS, OPACITY_NOISE / OPACITY_STEP);
    cell(4, colours[3 * row] / COLOUR_STEP, COLOUR_STEPS, COLOUR_NOISE / COLOUR_STEP);
    doubt[row] = 1 - stays;
    values[2 * row] = colours[3 * row + 1];
    values[2 * row + 1] = colours[3 * row + 2];
  }
  return { count, names, doubt, values };
}

/** As with an offset that is larger by so many cells. */
export function shifted(carriers: Carriers, cells: number): Carriers {
  const names = carriers.names.slice();
  for (let at = 0; at < names.length; at += NAME) {
    for (let axis = 0; axis < 3; axis++) names[at + axis] -= cells;
  }
  return { ...carriers, names };
}

/** The carriers of these rows. */
export function chosen({ names, doubt, values }: Carriers, rows: ArrayLike<number>): Carriers {
  return {
    count: rows.length, names: rowsOf(names, rows, NAME), doubt: rowsOf(doubt, rows, 1), values: rowsOf(values, rows, 2),
  };
}

/** How much a change of colour shows, from the name: log of area times squared opacity. */
export function impact(names: Int16Array, row: number): number {
  const [a, b, c] = [names[NAME * row], names[NAME * row + 1], names[NAME * row + 2]];
  const two = a + b + c - Math.min(a, b, c) + 1; // halves of a cell are added
  const seen = (names[NAME * row + 3] + 0.5) * OPACITY_STEPS * OPACITY_STEP;
  return two * CELL + 2 * Math.log(Math.max(1e-3, seen));
}
