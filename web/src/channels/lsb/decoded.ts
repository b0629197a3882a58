/**
 * Models that were decoded from a .spz, .sog or compressed .ply: secrets are in the quantised values of that file, which are
 * computed from the floats; counterpart of `keyss.channels.lsb.decoded`.
 */
import { coefficients, type Gaussians } from '../../core/gaussians.ts';
import { byRow, unit } from '../../files/coded.ts';
import { type Bounds, CHUNK, type CompressedPlyCodes, VECTOR } from '../../files/compressed_ply.ts';
import { dequantised } from '../../files/models.ts';
import { FINEST, LARGEST, type SogCodes } from '../../files/sog.ts';
import { MAGNITUDE, MAX_FRACTIONAL_BITS, NEGATIVE, type SpzCodes } from '../../files/spz.ts';
import { type Levels, levelsOf } from './fields.ts';

const AXES = [0, 1, 2];
const CODES = 256; // different opacities, and numbers in a codebook
const CLOSE = Math.fround(1e-5); // maximum relative difference between decoders
const MIN_EXACT = 0.9; // share of exact Gaussians
const MAX_POSITION = 2 ** 23 - 1; // of a .spz
const [SCALE_LIMIT, MIN_RANGE] = [20, 1e-5]; // of a compressed .ply: maximum log scale, least range of a chunk

/** The levels of the file from which a model was decoded, in which Gaussians that are not exact carry nothing; null if none. */
export function decodedLevels(model: Gaussians): Levels | null {
  if (different(model.opacityLogits) === null) return null;
  for (const quantise of [spzCodes, sogCodes, compressedPlyCodes]) {
    const codes = quantise(model);
    if (codes === null) continue;
    const exact = exactRows(model, dequantised(codes));
    if (exact.reduce((sum, each) => sum + each, 0) / model.count < MIN_EXACT) continue;
    const { fields, rows } = levelsOf(codes);
    const colour = byRow(bitPatterns(model.sh), 3 * coefficients(model.shDegree));
    const opacity = bitPatterns(model.opacityLogits);
    return {
      rows,
      fields: fields.map(({ level, bits }) => ({ level, bits: (row) => (exact[row] ? bits(row) : 0) })),
      unwritten: (row, part) => (part < 3 ? colour(row, part) : opacity[row]),
    };
  }
  return null;
}

function bitPatterns(numbers: Float32Array): Uint32Array {
  return new Uint32Array(numbers.buffer, numbers.byteOffset, numbers.length);
}

/** Ascending different numbers; null if there are more than CODES. */
function different(values: Float32Array): Float32Array | null {
  const found = new Set<number>();
  return values.every((each) => found.add(each).size <= CODES) ? Float32Array.from(found).sort() : null;
}

/** [N] 1 for Gaussians with the same attributes in both, up to differences between decoders; in single precision. */
function exactRows(model: Gaussians, decoded: Gaussians): Uint8Array {
  const [quat, other] = [byRow(model.quats, 4), byRow(decoded.quats, 4)];
  const pairs = (['means', 'logScales'] as const).map((name) => [byRow(model[name], 3), byRow(decoded[name], 3)]);
  return Uint8Array.from({ length: model.count }, (_, row) => {
    const product = [0, 1, 2, 3].reduce((sum, part) => sum + quat(row, part) * other(row, part), 0);
    const sign = product < 0 ? -1 : 1; // both signs of a quaternion mean one rotation
    const turned = [0, 1, 2, 3].every((part) => Math.abs(Math.fround(quat(row, part) - sign * other(row, part))) < CLOSE);
    return Number(turned && pairs.every(([value, own]) => AXES.every((axis) => {
      const number = value(row, axis);
      return Math.abs(Math.fround(number - own(row, axis))) <= Math.fround(CLOSE * Math.abs(number));
    })));
  });
}

/** Version 3, with colours and opacities of 0; null if numbers are not between its steps. */
function spzCodes({ count, means, logScales, quats }: Gaussians): SpzCodes | null {
  if (!logScales.every((each) => Number.isInteger(16 * each))) return null;
  const fractionalBits = fractionalBitsOf(means);
  if (fractionalBits === null) return null;
  const [largest, rotations] = [new Uint8Array(count), new Uint16Array(3 * count)];
  for (let row = 0; row < count; row++) {
    const [w, x, y, z] = unitQuat(quats, row);
    const [index, others] = smallestThree([x, -y, -z, w]);
    largest[row] = index;
    rotations.set(others.map((each) => {
      return rounded(Math.abs(each) * (MAGNITUDE / Math.sqrt(0.5)), MAGNITUDE) | (each < 0 ? NEGATIVE : 0);
    }), 3 * row);
  }
  return {
    kind: 'spz', version: 3, count, shDegree: 0, fractionalBits, largest, rotations,
    positions: Int32Array.from(means, (each, at) => each * 2 ** fractionalBits * (at % 3 ? -1 : 1)),
    scales: Uint8Array.from(logScales, (each) => rounded((each + 10) * 16, 255)),
    alphas: new Uint8Array(count), colours: new Uint8Array(3 * count), harmonics: new Uint8Array(0),
  };
}

/** The least number of fractional bits of positions; null if a .spz has no room for as many. */
function fractionalBitsOf(means: Float32Array): number | null {
  const farthest = means.reduce((most, each) => Math.max(most, Math.abs(each)), 0);
  for (let bits = 0; bits <= MAX_FRACTIONAL_BITS && farthest * 2 ** bits <= MAX_POSITION; bits++) {
    if (means.every((each) => Number.isInteger(each * 2 ** bits))) return bits;
  }
  return null;
}

/** Without harmonics, which carry nothing; null if numbers are too many for a codebook. */
function sogCodes({ count, shDegree, means, logScales, quats, opacityLogits, sh }: Gaussians): SogCodes | null {
  const scaleBook = different(logScales);
  if (scaleBook === null) return null;
  const constant = byRow(sh, 3 * coefficients(shDegree));
  const colourBook = different(Float32Array.from({ length: 3 * count }, (_, at) => constant(Math.floor(at / 3), at % 3)));
  if (colourBook === null) return null;
  const [scaleCodes, colourCodes] = [scaleBook, colourBook].map((book) => new Map([...book].map((each, code) => [each, code])));
  const logs = Float64Array.from(means, (each) => Math.sign(each) * Math.log1p(Math.abs(each)));
  const [mins, maxs] = [Math.min, Math.max].map((end) => AXES.map((axis) => {
    let bound = logs[axis];
    for (let at = axis; at < logs.length; at += 3) bound = end(bound, logs[at]);
    return bound;
  }));
  const positions = Uint16Array.from(logs, (each, at) => {
    const [low, high] = [mins[at % 3], maxs[at % 3]];
    return rounded(((each - low) / (high > low ? high - low : 1)) * FINEST, FINEST);
  });
  const [turns, scales, colours] = [0, 0, 0].map(() => new Uint8Array(4 * count));
  for (let row = 0; row < count; row++) {
    const [index, others] = smallestThree(unitQuat(quats, row));
    turns.set([...others.map((each) => rounded(((each * Math.SQRT2 + 1) / 2) * 255, 255)), LARGEST + index], 4 * row);
    scales.set(AXES.map((axis) => scaleCodes.get(logScales[3 * row + axis])!), 4 * row);
    colours.set(AXES.map((part) => colourCodes.get(constant(row, part))!), 4 * row);
    colours[4 * row + 3] = rounded((1 / (1 + Math.exp(-opacityLogits[row]))) * 255, 255);
  }
  return {
    kind: 'sog', count, mins, maxs, positions, quats: turns, scaleBook, scales, colourBook, colours, shDegree: 0,
    labels: new Uint16Array(count), harmonicBook: new Float32Array(0), palette: new Uint8Array(0),
  };
}

/** With colours and opacities of 0. */
function compressedPlyCodes({ count, means, logScales, quats }: Gaussians): CompressedPlyCodes {
  const [placeBounds, scaleBounds] = [boundsOf(means, Infinity), boundsOf(logScales, SCALE_LIMIT)];
  const packed = (values: Float32Array, bounds: Bounds): Float64Array => Float64Array.from({ length: count }, (_, row) => {
    const [x, y, z] = AXES.map((axis) => {
      const [low, high] = bounds[axis].map((each) => each[Math.floor(row / CHUNK)]);
      const share = high - low < MIN_RANGE ? 0 : (values[3 * row + axis] - low) / (high - low);
      return rounded(share * VECTOR[axis], VECTOR[axis]);
    });
    return ((x << 21) | (y << 11) | z) >>> 0;
  });
  const rotations = Float64Array.from({ length: count }, (_, row) => {
    const [index, others] = smallestThree(unitQuat(quats, row));
    const [a, b, c] = others.map((each) => rounded((each * Math.sqrt(0.5) + 0.5) * 1023, 1023));
    return ((index << 30) | (a << 20) | (b << 10) | c) >>> 0;
  });
  return {
    kind: 'compressed-ply', count, shDegree: 0, placeBounds, scaleBounds, colourBounds: scaleBounds, rotations,
    positions: packed(means, placeBounds), scales: packed(logScales, scaleBounds), colours: new Float64Array(count),
  };
}

/** Least and largest numbers of each chunk, at most `limit` in magnitude. */
function boundsOf(values: Float32Array, limit: number): Bounds {
  const chunks = Math.ceil(values.length / 3 / CHUNK);
  return AXES.map((axis) => [Math.min, Math.max].map((end) => Float64Array.from({ length: chunks }, (_, chunk) => {
    const last = Math.min(values.length, 3 * CHUNK * (chunk + 1));
    let bound = values[3 * CHUNK * chunk + axis];
    for (let at = 3 * CHUNK * chunk + axis; at < last; at += 3) bound = end(bound, values[at]);
    return Math.min(Math.max(bound, -limit), limit);
  })));
}

function unitQuat(quats: Float32Array, row: number): number[] {
  return unit(Array.from(quats.subarray(4 * row, 4 * row + 4)));
}

/** Index of the largest component of a unit quaternion, and the others, with signs by which the largest is positive. */
function smallestThree(quat: readonly number[]): [index: number, others: number[]] {
  const sizes = quat.map(Math.abs);
  const index = sizes.indexOf(Math.max(...sizes));
  const sign = quat[index] < 0 ? -1 : 1;
  return [index, quat.filter((_, at) => at !== index).map((each) => sign * each)];
}

/** The integer nearest to `value`, 0 to `most`. */
function rounded(value: number, most: number): number {
  return Math.max(0, Math.min(most, Math.floor(value + 0.5)));
}
