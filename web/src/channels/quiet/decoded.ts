/**
 * The levels of a .ply that was decoded from a .spz, .sog or compressed .ply; counterpart of
 * `keyss.channels.quiet.decoded`.
 */
import type { Gaussians } from '../../core/gaussians.ts';
import { opacity } from '../../core/gaussians.ts';
import { fromSmallestThree } from '../../files/coded.ts';
import { CHUNK, VECTOR } from '../../files/compressed_ply.ts';
import { FINEST } from '../../files/sog.ts';
import { byRow, compressedPlyLevels, type Counted, type Levels, type OfAxis, sogLevels, spzLevels } from './fields.ts';

const [SIZE, SAMPLE, MOST, CLOSE] = [256, 1024, 0.9, 1e-5];
const [MAX_FRACTIONAL_BITS, MAX_POSITION] = [24, 2 ** 23 - 1];
const [SCALE_LIMIT, MIN_RANGE] = [20, 1e-5];
const AXES = [0, 1, 2];

/** Levels, and a mask of the Gaussians that are not exact decodings: they carry nothing. */
export interface Decoded {
  readonly levels: Levels;
  readonly silent: Uint8Array; // [N]
}

/** Levels, and the numbers that they decode to. */
interface Guess {
  readonly levels: Counted;
  readonly mean: OfAxis;
  readonly logScale: OfAxis;
  readonly quat: (row: number) => number[];
}

/** The decoded model; null if the model was decoded from none of the formats. */
export function decodedFrom(model: Gaussians): Decoded | null {
  const { count, opacityLogits } = model;
  if (!count || !distinct(opacityLogits.subarray(0, SAMPLE)) || !distinct(opacityLogits)) return null;
  for (const guess of [spz, sog, compressedPly]) {
    const found = guess(model);
    if (!found) continue;
    const silent = Uint8Array.from({ length: count }, (_, row) => (follows(model, row, found) ? 0 : 1));
    if (silent.reduce((sum, each) => sum + 1 - each, 0) >= MOST * count) {
      return { levels: { ...found.levels, unwritten: unwritten(model) }, silent };
    }
  }
  return null;
}

function unwritten({ count, sh, opacityLogits }: Gaussians): OfAxis {
  const [width, words] = [sh.length / count, [sh, opacityLogits].map((each) => new Uint32Array(Float32Array.from(each).buffer))];
  return (row, part) => (part < 3 ? words[0][width * row + part] : words[1][row]);
}

/** Distinct values in ascending order; null if there are more than 256. */
function distinct(values: Float32Array): Float32Array | null {
  const found = new Set<number>();
  for (const each of values) if (found.add(each).size > SIZE) return null;
  return Float32Array.from(found).sort();
}

function follows(model: Gaussians, row: number, { mean, logScale, quat }: Guess): boolean {
  const near = (own: number, other: number): boolean => Math.abs(own - Math.fround(other)) <= CLOSE * Math.abs(own);
  for (const axis of AXES) {
    if (!near(model.means[3 * row + axis], mean(row, axis))) return false;
    if (!near(model.logScales[3 * row + axis], logScale(row, axis))) return false;
  }
  const [own, other] = [model.quats.subarray(4 * row, 4 * row + 4), quat(row)];
  const sign = other.reduce((sum, each, part) => sum + each * own[part], 0) < 0 ? -1 : 1;
  return other.every((each, part) => Math.abs(own[part] - sign * each) < CLOSE);
}

/** The three smaller parts of quaternions of unit length, such that the other one is positive, as levels. */
function turnsOf(
  count: number, quat: (row: number) => number[], level: (part: number) => number, part: (level: number) => number,
): { turn: OfAxis; omitted: Uint8Array; back: (row: number) => number[] } {
  const [levels, omitted] = [new Int16Array(3 * count), new Uint8Array(count)];
  for (let row = 0; row < count; row++) {
    const own = quat(row);
    const length = Math.sqrt(own.reduce((sum, each) => sum + each * each, 0)) || 1;
    const largest = own.reduce((best, each, at) => (Math.abs(each) > Math.abs(own[best]) ? at : best), 0);
    const by = (own[largest] < 0 ? -1 : 1) / length;
    omitted[row] = largest;
    levels.set(own.filter((_, at) => at !== largest).map((each) => level(each * by)), 3 * row);
  }
  const turn = byRow(levels, 3);
  return { turn, omitted, back: (row) => fromSmallestThree(omitted[row], AXES.map((axis) => part(turn(row, axis)))) };
}

function quatOf({ quats }: Gaussians, row: number): number[] {
  return [...quats.subarray(4 * row, 4 * row + 4)];
}

function spz(model: Gaussians): Guess | null {
  const { count, means, logScales } = model;
  if (!logScales.every((each) => Number.isInteger(16 * each))) return null;
  let bits = 0;
  while (!means.every((each) => Number.isInteger(each * 2 ** bits))) if (++bits > MAX_FRACTIONAL_BITS) return null;
  if (means.some((each) => Math.abs(each * 2 ** bits) > MAX_POSITION)) return null;
  const upright = (row: number): number[] => {
    const [w, x, y, z] = quatOf(model, row);
    return [x, -y, -z, w];
  };
  const level = (part: number): number => Math.sign(part) * Math.min(511, Math.floor(Math.abs(part) * (511 / Math.sqrt(0.5)) + 0.5));
  const { turn, back } = turnsOf(count, upright, level, (each) => each * (Math.sqrt(0.5) / 511));
  const scales = Uint8Array.from(logScales, (each) => Math.min(255, Math.max(0, 16 * each + 160)));
  const place = (row: number, axis: number): number => means[3 * row + axis] * 2 ** bits * (axis ? -1 : 1);
  return {
    levels: spzLevels(count, bits, byRow(scales, 3), place, turn),
    mean: byRow(means, 3), logScale: (row, axis) => scales[3 * row + axis] / 16 - 10,
    quat: (row) => {
      const [x, y, z, w] = back(row);
      return [w, x, -y, -z];
    },
  };
}

function sog(model: Gaussians): Guess | null {
  const { count, means, logScales, opacityLogits, sh } = model;
  const width = sh.length / count;
  const constant = Float32Array.from({ length: 3 * count }, (_, at) => sh[width * Math.floor(at / 3) + (at % 3)]);
  const books = [logScales, constant].map(distinct);
  if (!books[0] || !books[1]) return null;
  const [scaleAt, colourAt] = books.map((book) => new Map([...book!].map((each, at) => [each, at])));
  const logs = Float64Array.from(means, (each) => Math.sign(each) * Math.log1p(Math.abs(each)));
  const [mins, maxs] = [[0, 0, 0].fill(Infinity), [0, 0, 0].fill(-Infinity)];
  logs.forEach((each, at) => {
    mins[at % 3] = Math.min(mins[at % 3], each);
    maxs[at % 3] = Math.max(maxs[at % 3], each);
  });
  const extent = AXES.map((axis) => (maxs[axis] > mins[axis] ? maxs[axis] - mins[axis] : 1));
  const places = Uint16Array.from(logs, (each, at) => Math.round(((each - mins[at % 3]) / extent[at % 3]) * FINEST));
  const { turn, omitted, back } = turnsOf(
    count, (row) => quatOf(model, row),
    (part) => Math.round(((part * Math.SQRT2 + 1) / 2) * 255), (level) => ((level / 255) * 2 - 1) * Math.sqrt(0.5),
  );
  const unwritten = (row: number): number[] => [
    ...AXES.map((axis) => scaleAt.get(logScales[3 * row + axis])!), ...AXES.map((axis) => colourAt.get(constant[3 * row + axis])!),
    Math.round(255 * opacity(opacityLogits[row])), 0, omitted[row],
  ];
  return {
    levels: sogLevels({ count, mins, maxs }, byRow(logScales, 3), byRow(places, 3), turn, unwritten),
    logScale: byRow(logScales, 3), quat: back,
    mean: (row, axis) => {
      const log = mins[axis] + extent[axis] * (places[3 * row + axis] / FINEST);
      return Math.sign(log) * Math.expm1(Math.abs(log));
    },
  };
}

function compressedPly(model: Gaussians): Guess {
  const { count, means, logScales } = model;
  const chunks = Math.ceil(count / CHUNK);
  const [placeBounds, scaleBounds] = [means, logScales].map((values) => AXES.map((axis) => [Infinity, -Infinity].map(
    (worst, end) => {
      const bounds = new Float64Array(chunks).fill(worst);
      for (let row = 0; row < count; row++) {
        const [chunk, value] = [Math.floor(row / CHUNK), values[3 * row + axis]];
        bounds[chunk] = end ? Math.max(bounds[chunk], value) : Math.min(bounds[chunk], value);
      }
      return bounds;
    },
  )));
  for (const pair of scaleBounds) {
    for (const bounds of pair) bounds.forEach((each, at) => (bounds[at] = Math.min(SCALE_LIMIT, Math.max(-SCALE_LIMIT, each))));
  }
  const level = (values: Float32Array, bounds: Float64Array[][]): OfAxis => (row, axis) => {
    const [low, high] = bounds[axis].map((each) => each[Math.floor(row / CHUNK)]);
    const share = high - low < MIN_RANGE ? 0 : (values[3 * row + axis] - low) / (high - low);
    return Math.floor(Math.min(1, Math.max(0, share)) * VECTOR[axis] + 0.5);
  };
  const value = (values: Float32Array, bounds: Float64Array[][]): OfAxis => (row, axis) => {
    const [low, high] = bounds[axis].map((each) => each[Math.floor(row / CHUNK)]);
    const share = level(values, bounds)(row, axis) / VECTOR[axis];
    return low * (1 - share) + high * share;
  };
  const { turn, back } = turnsOf(
    count, (row) => quatOf(model, row),
    (part) => Math.min(1023, Math.max(0, Math.round((part * Math.sqrt(0.5) + 0.5) * 1023))), (each) => (each / 1023 - 0.5) * Math.SQRT2,
  );
  return {
    levels: compressedPlyLevels(count, scaleBounds, level(logScales, scaleBounds), turn),
    mean: value(means, placeBounds), logScale: value(logScales, scaleBounds), quat: back,
  };
}
