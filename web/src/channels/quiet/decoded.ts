/**
 * The codes behind a .ply that a program decoded from a .spz, .sog or compressed .ply; `keyss.channels.quiet.decoded` on
 * the other side.
 */
import type { Gaussians } from '../../core/gaussians.ts';
import { opacity } from '../../core/gaussians.ts';
import { fromSmallestThree } from '../../files/coded.ts';
import { CHUNK, VECTOR } from '../../files/compressed_ply.ts';
import type { Codes } from '../../files/models.ts';
import { FINEST, LARGEST } from '../../files/sog.ts';

const [SIZE, SAMPLE, MOST, CLOSE] = [256, 1024, 0.9, 1e-5];
const [MAX_FRACTIONAL_BITS, MAX_POSITION] = [24, 2 ** 23 - 1];
const [SCALE_LIMIT, MIN_RANGE] = [20, 1e-5];
const AXES = [0, 1, 2];

/** Codes, and which Gaussians do not follow from them: these carry nothing. */
export interface Decoded {
  readonly codes: Codes;
  readonly silent: Uint8Array; // [N]
}

/** Codes, and what they stand for. */
interface Guess {
  readonly codes: Codes;
  readonly mean: (row: number, axis: number) => number;
  readonly logScale: (row: number, axis: number) => number;
  readonly quat: (row: number) => number[];
}

/** Null for a model whose numbers lie on the steps of no format. */
export function decodedFrom(model: Gaussians): Decoded | null {
  const { count, opacityLogits } = model;
  if (!count || !distinct(opacityLogits.subarray(0, SAMPLE)) || !distinct(opacityLogits)) return null;
  for (const guess of [spz, sog, compressedPly]) {
    const found = guess(model);
    if (!found) continue;
    const silent = Uint8Array.from({ length: count }, (_, row) => (follows(model, row, found) ? 0 : 1));
    if (silent.reduce((sum, each) => sum + 1 - each, 0) >= MOST * count) return { codes: found.codes, silent };
  }
  return null;
}

/** In ascending order, null for more than 256. */
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

/** The index of the largest part of a quaternion, and the others, such that it is positive. */
function smallestThree(quat: readonly number[]): [number, number[]] {
  const length = Math.sqrt(quat.reduce((sum, each) => sum + each * each, 0)) || 1;
  let largest = 0;
  quat.forEach((each, part) => (largest = Math.abs(each) > Math.abs(quat[largest]) ? part : largest));
  const by = (quat[largest] < 0 ? -1 : 1) / length;
  return [largest, quat.filter((_, part) => part !== largest).map((each) => each * by)];
}

function quatOf({ quats }: Gaussians, row: number): number[] {
  return [...quats.subarray(4 * row, 4 * row + 4)];
}

function bytesOf(words: Uint32Array | Int32Array): Uint8Array {
  return new Uint8Array(words.buffer);
}

function spz(model: Gaussians): Guess | null {
  const { count, means, logScales } = model;
  if (!logScales.every((each) => Number.isInteger(16 * each))) return null;
  let bits = 0;
  while (!means.every((each) => Number.isInteger(each * 2 ** bits))) if (++bits > MAX_FRACTIONAL_BITS) return null;
  if (means.some((each) => Math.abs(each * 2 ** bits) > MAX_POSITION)) return null;
  const [words, places] = [new Uint32Array(count), new Uint8Array(9 * count)];
  const turned: number[][] = [];
  for (let row = 0; row < count; row++) {
    const [w, x, y, z] = quatOf(model, row);
    const [largest, others] = smallestThree([x, -y, -z, w]);
    const parts = others.map((each) => Math.min(511, Math.floor(Math.abs(each) * (511 / Math.sqrt(0.5)) + 0.5)));
    const signed = parts.map((each, part) => (others[part] < 0 ? 512 : 0) | each);
    words[row] = (largest << 30) | (signed[0] << 20) | (signed[1] << 10) | signed[2];
    const back = parts.map((each, part) => (others[part] < 0 ? -1 : 1) * each * (Math.sqrt(0.5) / 511));
    const [a, b, c, d] = fromSmallestThree(largest, back);
    turned.push([d, a, -b, -c]);
    for (const axis of AXES) {
      const level = means[3 * row + axis] * 2 ** bits * (axis ? -1 : 1);
      for (const byte of AXES) places[9 * row + 3 * axis + byte] = level >> (8 * byte);
    }
  }
  const scales = Uint8Array.from(logScales, (each) => Math.min(255, Math.max(0, 16 * each + 160)));
  const none = new Uint8Array(0);
  const codes = {
    kind: 'spz', version: 3, count, shDegree: 0, fractionalBits: bits, positions: places, alphas: none, colours: none,
    scales, rotations: bytesOf(words), harmonics: none,
  } as const;
  return {
    codes, mean: (row, axis) => means[3 * row + axis], quat: (row) => turned[row],
    logScale: (row, axis) => scales[3 * row + axis] / 16 - 10,
  };
}

function sog(model: Gaussians): Guess | null {
  const { count, means, logScales, opacityLogits, sh } = model;
  const width = sh.length / count;
  const constant = Float32Array.from({ length: 3 * count }, (_, at) => sh[width * Math.floor(at / 3) + (at % 3)]);
  const [scaleBook, colourBook] = [distinct(logScales), distinct(constant)];
  if (!scaleBook || !colourBook) return null;
  const [scaleAt, colourAt] = [scaleBook, colourBook].map((book) => new Map([...book].map((each, at) => [each, at])));
  const logs = Float64Array.from(means, (each) => Math.sign(each) * Math.log1p(Math.abs(each)));
  const [mins, maxs] = [[0, 0, 0].fill(Infinity), [0, 0, 0].fill(-Infinity)];
  logs.forEach((each, at) => {
    mins[at % 3] = Math.min(mins[at % 3], each);
    maxs[at % 3] = Math.max(maxs[at % 3], each);
  });
  const extent = AXES.map((axis) => (maxs[axis] > mins[axis] ? maxs[axis] - mins[axis] : 1));
  const positions = Uint16Array.from(logs, (each, at) => Math.round(((each - mins[at % 3]) / extent[at % 3]) * FINEST));
  const [quats, scales, colours] = [0, 1, 2].map(() => new Uint8Array(4 * count));
  for (let row = 0; row < count; row++) {
    const [largest, others] = smallestThree(quatOf(model, row));
    quats.set(others.map((each) => Math.round(((each * Math.SQRT2 + 1) / 2) * 255)), 4 * row);
    quats[4 * row + 3] = LARGEST + largest;
    for (const axis of AXES) {
      scales[4 * row + axis] = scaleAt.get(logScales[3 * row + axis])!;
      colours[4 * row + axis] = colourAt.get(constant[3 * row + axis])!;
    }
    colours[4 * row + 3] = Math.round(255 * opacity(opacityLogits[row]));
  }
  const codes = {
    kind: 'sog', count, mins, maxs, positions, quats, scaleBook, scales, colourBook, colours, shDegree: 0,
    labels: new Uint16Array(count), harmonicBook: new Float32Array(0), palette: new Uint8Array(0),
  } as const;
  return {
    codes, logScale: (row, axis) => logScales[3 * row + axis],
    mean: (row, axis) => {
      const log = mins[axis] + extent[axis] * (positions[3 * row + axis] / FINEST);
      return Math.sign(log) * Math.expm1(Math.abs(log));
    },
    quat: (row) => {
      const others = AXES.map((part) => ((quats[4 * row + part] / 255) * 2 - 1) * Math.sqrt(0.5));
      return fromSmallestThree(quats[4 * row + 3] - LARGEST, others);
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
  const level = (values: Float32Array, bounds: Float64Array[][], row: number, axis: number): number => {
    const [low, high] = bounds[axis].map((each) => each[Math.floor(row / CHUNK)]);
    const share = high - low < MIN_RANGE ? 0 : (values[3 * row + axis] - low) / (high - low);
    return Math.floor(Math.min(1, Math.max(0, share)) * VECTOR[axis] + 0.5);
  };
  const value = (values: Float32Array, bounds: Float64Array[][]) => (row: number, axis: number): number => {
    const [low, high] = bounds[axis].map((each) => each[Math.floor(row / CHUNK)]);
    const share = level(values, bounds, row, axis) / VECTOR[axis];
    return low * (1 - share) + high * share;
  };
  const [scales, rotations] = [new Float64Array(count), new Float64Array(count)];
  for (let row = 0; row < count; row++) {
    const [x, y, z] = AXES.map((axis) => level(logScales, scaleBounds, row, axis));
    scales[row] = ((x << 21) | (y << 11) | z) >>> 0;
    const [largest, others] = smallestThree(quatOf(model, row));
    const [a, b, c] = others.map((each) => Math.min(1023, Math.max(0, Math.round((each * Math.sqrt(0.5) + 0.5) * 1023))));
    rotations[row] = ((largest << 30) | (a << 20) | (b << 10) | c) >>> 0;
  }
  return {
    codes: { kind: 'compressed-ply', count, scaleBounds, scales, rotations },
    mean: value(means, placeBounds), logScale: value(logScales, scaleBounds),
    quat: (row) => {
      const others = [20, 10, 0].map((shift) => (((rotations[row] >>> shift) & 1023) / 1023 - 0.5) * Math.SQRT2);
      return fromSmallestThree(rotations[row] >>> 30, others);
    },
  };
}
