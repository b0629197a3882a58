/**
 * The levels of a .ply that was decoded from a .spz, .sog or compressed .ply; counterpart of
 * `keyss.channels.quiet.decoded`.
 */
import { type Gaussians, opacity, withDegree } from '../../core/gaussians.ts';
import type { OfAxis } from '../../files/coded.ts';
import { CHUNK, type CompressedPlyCodes, dequantiseCompressedPly, VECTOR } from '../../files/compressed_ply.ts';
import { dequantiseSog, FINEST, LARGEST, type SogCodes } from '../../files/sog.ts';
import { dequantiseSpz, type SpzCodes } from '../../files/spz.ts';
import { type Levels, levelsOf } from './fields.ts';

const [SIZE, SAMPLE, MOST, CLOSE] = [256, 1024, 0.9, 1e-5];
const [MAX_FRACTIONAL_BITS, MAX_POSITION] = [24, 2 ** 23 - 1];
const [SCALE_LIMIT, MIN_RANGE] = [20, 1e-5];
const AXES = [0, 1, 2];

/** Gaussians that are not exact decodings are silent. Null if the model was decoded from none of the formats. */
export function decodedLevels(model: Gaussians): Levels | null {
  const { count, opacityLogits } = model;
  if (!count || !distinct(opacityLogits.subarray(0, SAMPLE)) || !distinct(opacityLogits)) return null;
  for (const attempt of [spz, sog, compressedPly]) {
    const found = attempt(model);
    if (!found) continue;
    const silent = Uint8Array.from({ length: count }, (_, row) => (follows(model, row, found.decoded) ? 0 : 1));
    if (silent.reduce((sum, each) => sum + 1 - each, 0) >= MOST * count) {
      return { ...levelsOf(found.codes), unwritten: unwritten(model), silent };
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

/** Whether a Gaussian has the numbers of its decoded codes, up to differences between decoders. */
function follows(model: Gaussians, row: number, decoded: Gaussians): boolean {
  for (const column of ['means', 'logScales'] as const) {
    for (let at = 3 * row; at < 3 * row + 3; at++) {
      const [own, other] = [model[column][at], decoded[column][at]];
      if (!(Math.abs(own - other) <= CLOSE * Math.abs(own))) return false;
    }
  }
  const [own, other] = [model, decoded].map(({ quats }) => quats.subarray(4 * row, 4 * row + 4));
  const sign = other.reduce((sum, each, part) => sum + each * own[part], 0) < 0 ? -1 : 1;
  return other.every((each, part) => Math.abs(own[part] - sign * each) < CLOSE);
}

/** Of quaternions [N, 4] of any length: the index of the largest component, and the codes of the others if it is positive. */
function quantised(quats: Float32Array, code: (part: number) => number): { largest: Uint8Array; others: Uint16Array } {
  const [largest, others] = [new Uint8Array(quats.length / 4), new Uint16Array((3 * quats.length) / 4)];
  for (let row = 0; row < largest.length; row++) {
    const own = [...quats.subarray(4 * row, 4 * row + 4)];
    const length = Math.sqrt(own.reduce((sum, each) => sum + each * each, 0)) || 1;
    largest[row] = own.reduce((best, each, at) => (Math.abs(each) > Math.abs(own[best]) ? at : best), 0);
    const by = (own[largest[row]] < 0 ? -1 : 1) / length;
    others.set(own.filter((_, at) => at !== largest[row]).map((each) => code(each * by)), 3 * row);
  }
  return { largest, others };
}

function spz({ count, means, logScales, quats }: Gaussians): { codes: SpzCodes; decoded: Gaussians } | null {
  if (!logScales.every((each) => Number.isInteger(16 * each))) return null;
  let bits = 0;
  while (!means.every((each) => Number.isInteger(each * 2 ** bits))) if (++bits > MAX_FRACTIONAL_BITS) return null;
  if (means.some((each) => Math.abs(each * 2 ** bits) > MAX_POSITION)) return null;
  const upright = quats.map((_, at) => (at % 4 === 3 ? quats[at - 3] : quats[at + 1] * (at % 4 ? -1 : 1))); // xyzw, y up
  const { largest, others } = quantised(upright, (part) => {
    return (part < 0 ? 512 : 0) + Math.min(511, Math.floor(Math.abs(part) * (511 / Math.sqrt(0.5)) + 0.5));
  });
  const codes: SpzCodes = {
    kind: 'spz', version: 4, count, shDegree: 0, fractionalBits: bits, largest, rotations: others,
    positions: Int32Array.from(means, (each, at) => each * 2 ** bits * (at % 3 ? -1 : 1)),
    scales: Uint8Array.from(logScales, (each) => Math.min(255, Math.max(0, 16 * each + 160))),
    alphas: new Uint8Array(count), colours: new Uint8Array(3 * count), harmonics: new Uint8Array(0),
  };
  return { codes, decoded: dequantiseSpz(codes) };
}

function sog(model: Gaussians): { codes: SogCodes; decoded: Gaussians } | null {
  const { count, means, logScales, opacityLogits } = model;
  const constant = withDegree(model, 0).sh;
  const [scaleBook, colourBook] = [logScales, constant].map(distinct);
  if (!scaleBook || !colourBook) return null;
  const logs = Float64Array.from(means, (each) => Math.sign(each) * Math.log1p(Math.abs(each)));
  const [mins, maxs] = [Math.min, Math.max].map((pick) => AXES.map((axis) => {
    return logs.reduce((found, each, at) => (at % 3 === axis ? pick(found, each) : found), logs[axis]);
  }));
  const extent = AXES.map((axis) => (maxs[axis] > mins[axis] ? maxs[axis] - mins[axis] : 1));
  const { largest, others } = quantised(model.quats, (part) => Math.round(((part * Math.SQRT2 + 1) / 2) * 255));
  const [quats, scales, colours] = [new Uint8Array(4 * count), new Uint8Array(4 * count), new Uint8Array(4 * count)];
  const [scaleAt, colourAt] = [scaleBook, colourBook].map((book) => new Map([...book].map((each, at) => [each, at])));
  for (let row = 0; row < count; row++) {
    quats.set([...others.subarray(3 * row, 3 * row + 3), LARGEST + largest[row]], 4 * row);
    scales.set(Array.from(logScales.subarray(3 * row, 3 * row + 3), (each) => scaleAt.get(each)!), 4 * row);
    colours.set(Array.from(constant.subarray(3 * row, 3 * row + 3), (each) => colourAt.get(each)!), 4 * row);
    colours[4 * row + 3] = Math.round(255 * opacity(opacityLogits[row]));
  }
  const codes: SogCodes = {
    kind: 'sog', count, shDegree: 0, mins, maxs, quats, scaleBook, scales, colourBook, colours,
    positions: Uint16Array.from(logs, (each, at) => Math.round(((each - mins[at % 3]) / extent[at % 3]) * FINEST)),
    labels: new Uint16Array(count), harmonicBook: new Float32Array(0), palette: new Uint8Array(0),
  };
  return { codes, decoded: dequantiseSog(codes) };
}

function compressedPly({ count, means, logScales, quats }: Gaussians): { codes: CompressedPlyCodes; decoded: Gaussians } {
  const [placeBounds, scaleBounds] = [boundsOf(means, Infinity), boundsOf(logScales, SCALE_LIMIT)];
  const packed = (row: number, values: Float32Array, bounds: Float64Array[][]): number => {
    const [x, y, z] = AXES.map((axis) => {
      const [low, high] = bounds[axis].map((each) => each[Math.floor(row / CHUNK)]);
      const share = high - low < MIN_RANGE ? 0 : (values[3 * row + axis] - low) / (high - low);
      return Math.floor(Math.min(1, Math.max(0, share)) * VECTOR[axis] + 0.5);
    });
    return ((x << 21) | (y << 11) | z) >>> 0;
  };
  const { largest, others } = quantised(quats, (part) => {
    return Math.min(1023, Math.max(0, Math.round((part * Math.sqrt(0.5) + 0.5) * 1023)));
  });
  const codes: CompressedPlyCodes = {
    kind: 'compressed-ply', count, shDegree: 0, placeBounds, scaleBounds, colourBounds: placeBounds,
    positions: Float64Array.from({ length: count }, (_, row) => packed(row, means, placeBounds)),
    scales: Float64Array.from({ length: count }, (_, row) => packed(row, logScales, scaleBounds)),
    colours: new Float64Array(count),
    rotations: Float64Array.from(largest, (index, row) => {
      const [a, b, c] = others.subarray(3 * row, 3 * row + 3);
      return ((index << 30) | (a << 20) | (b << 10) | c) >>> 0;
    }),
  };
  return { codes, decoded: dequantiseCompressedPly(codes) };
}

/** The bounds of each chunk of `values` [N, 3], at most `limit`. */
function boundsOf(values: Float32Array, limit: number): Float64Array[][] {
  return AXES.map((axis) => [Math.min, Math.max].map((pick) => {
    const own = values.filter((_, at) => at % 3 === axis);
    return Float64Array.from({ length: Math.ceil(own.length / CHUNK) }, (_, chunk) => {
      const found = own.subarray(CHUNK * chunk, CHUNK * (chunk + 1)).reduce((a, b) => pick(a, b));
      return Math.min(limit, Math.max(-limit, found));
    });
  }));
}
