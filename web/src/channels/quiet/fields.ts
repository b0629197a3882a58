/**
 * Which numbers of a file's codes carry bits, how many each, and in which order these are counted;
 * `keyss.channels.quiet.fields` and `order` on the other side. A .sog is sorted by what is written; its bits are counted
 * in an order of what is not.
 *
 * All of it is arithmetic that is the same on every machine, in the same order as there, and no logarithms: a bit more or
 * less anywhere, and nothing could be read.
 */
import { highProduct, runs, sortingOrder, type Words } from '../../core/words.ts';
import { CHUNK, type CompressedPlyCodes, rotationPart as pliedPart, VECTOR, vectorPart } from '../../files/compressed_ply.ts';
import type { Codes } from '../../files/models.ts';
import { FINEST, LARGEST, type SogCodes } from '../../files/sog.ts';
import { positionCode, rotationPart, rotationWord, type SpzCodes } from '../../files/spz.ts';

const MAX_BITS = 10;
const SHARE = -3; // 2 to this: the range of what is written, in sizes of the Gaussian
const LOG_SCALE = -4; // 2 to this: the range of what is written in log scales
const LOG2_E = 1.4426950408889634;
const MAX_DISTANCE = 64; // powers of 2
const AXES = [0, 1, 2];
const [FACTOR_HIGH, FACTOR_LOW] = [0x9e3779b9, 0x7f4a7c15];

/** One coordinate of an attribute of N Gaussians. */
interface Field {
  readonly levels: Int32Array; // [N] integers that grow with what they stand for
  readonly bits: Uint8Array; // [N] that each carries, 0 to 10
}

/** In the order of the file's Gaussians. */
function fieldsOf(codes: Codes): Field[] {
  if (codes.kind === 'spz') return spzFields(codes);
  return codes.kind === 'sog' ? sogFields(codes) : compressedPlyFields(codes);
}

/** By how many powers of 2 a .sog's steps are larger at a position than at 0. */
function sogDistance(codes: SogCodes, row: number, axis: number): number {
  const log = Math.abs(codes.mins[axis] + sogExtent(codes, axis) * (codes.positions[3 * row + axis] / FINEST));
  return Math.min(Math.max(Math.floor(log * LOG2_E), 0), MAX_DISTANCE);
}

function sogExtent({ mins, maxs }: SogCodes, axis: number): number {
  return maxs[axis] > mins[axis] ? maxs[axis] - mins[axis] : 1;
}

function spzFields(codes: SpzCodes): Field[] {
  const { count, version, fractionalBits, scales } = codes;
  const bits = Uint8Array.from({ length: count }, (_, row) => {
    const size = (middle(scales[3 * row], scales[3 * row + 1], scales[3 * row + 2]) / 16 - 10) * LOG2_E;
    return fitting(size + fractionalBits + SHARE);
  });
  const places = AXES.map((axis) => ({ levels: levels(count, (row) => positionCode(codes, row, axis)), bits }));
  if (version === 2) return places;
  return [...places, ...turns(count, 3, (row, index) => rotationPart(rotationWord(codes, row), index))];
}

function sogFields(codes: SogCodes): Field[] {
  const { count, scaleBook, scales, positions, quats } = codes;
  const places = AXES.map((axis) => {
    const finest = log2(sogExtent(codes, axis) / FINEST);
    const bits = Uint8Array.from({ length: count }, (_, row) => {
      const [a, b, c] = AXES.map((each) => scaleBook[scales[4 * row + each]]);
      const step = finest + sogDistance(codes, row, axis) + 0.5;
      return fitting(middle(a, b, c) * LOG2_E + SHARE - step);
    });
    return { levels: levels(count, (row) => positions[3 * row + axis]), bits };
  });
  return [...places, ...turns(count, 2, (row, index) => quats[4 * row + index])];
}

function compressedPlyFields(codes: CompressedPlyCodes): Field[] {
  const { count, scaleBounds, scales, rotations } = codes;
  const sizes = AXES.map((axis) => {
    const [low, high] = scaleBounds[axis];
    const chunks = low.map((least, chunk) => fitting(LOG_SCALE - log2((high[chunk] - least) / VECTOR[axis])));
    const bits = Uint8Array.from({ length: count }, (_, row) => chunks[Math.floor(row / CHUNK)]);
    return { levels: levels(count, (row) => vectorPart(scales[row], axis)), bits };
  });
  return [...sizes, ...turns(count, 3, (row, index) => pliedPart(rotations[row], index))];
}

function levels(count: number, level: (row: number) => number): Int32Array {
  const found = new Int32Array(count);
  for (let row = 0; row < count; row++) found[row] = level(row);
  return found;
}

function turns(count: number, each: number, part: (row: number, index: number) => number): Field[] {
  const bits = new Uint8Array(count).fill(each);
  return AXES.map((index) => ({ levels: levels(count, (row) => part(row, index)), bits }));
}

/** The second of three numbers by size. */
function middle(a: number, b: number, c: number): number {
  return Math.max(Math.min(a, b), Math.min(Math.max(a, b), c));
}

/** The number of bits of levels that span at most 2 ** `log`; NaN, which becomes 0 as a byte, for NaN. */
function fitting(log: number): number {
  return Math.min(Math.max(Math.floor(log), 0), MAX_BITS);
}

const NUMBER = new Float64Array(1);
const HALVES = new Uint32Array(NUMBER.buffer); // the lower one first, as on all machines that have browsers

/** About the logarithm to base 2, too small by up to 0.09: straight lines between the powers of 2. */
export function log2(value: number): number {
  if (value === 0 || !Number.isFinite(value)) return 2 * (value - 1);
  const small = Math.abs(value) < 2 ** -1022; // without an exponent of its own
  NUMBER[0] = small ? value * 2 ** 54 : value;
  const exponent = ((HALVES[1] >>> 20) & 2047) - 1022 - (small ? 54 : 0);
  HALVES[1] = (HALVES[1] & 0x800fffff) | (1022 << 20);
  return exponent + 2 * (NUMBER[0] - 1); // of a mantissa of 0.5 to 1
}

/** The last bits of all levels, each 0 or 1, in the order in which they are counted; `silent` [N] rows have none. */
export function lastBits(codes: Codes, silent?: Uint8Array): Uint8Array {
  const rows = codes.kind === 'sog' ? sogOrder(codes) : null;
  const fields = fieldsOf(codes);
  for (const { bits } of fields) silent?.forEach((each, row) => each && (bits[row] = 0));
  const count = rows?.length ?? codes.count;
  const rowAt = (index: number): number => (rows === null ? index : rows[index]);
  let size = 0;
  for (const { bits } of fields) for (let index = 0; index < count; index++) size += bits[rowAt(index)];
  const found = new Uint8Array(size);
  let at = 0;
  for (const { levels, bits } of fields) {
    for (let index = 0; index < count; index++) {
      const row = rowAt(index);
      for (let bit = 0; bit < bits[row]; bit++) found[at++] = (levels[row] >> bit) & 1;
    }
  }
  return found;
}

/** Gaussians by hashes of what is not written, without those that share one: these carry nothing. */
function sogOrder(codes: SogCodes): Uint32Array {
  const words = hashes(codes.count, [
    ...AXES.map((axis) => (row: number) => codes.scales[4 * row + axis]),
    ...[0, 1, 2, 3].map((part) => (row: number) => codes.colours[4 * row + part]),
    (row) => codes.labels[row],
    (row) => codes.quats[4 * row + 3] - LARGEST,
    ...AXES.map((axis) => (row: number) => sogDistance(codes, row, axis)),
  ]);
  const order = sortingOrder(words);
  const starts = runs(words, order);
  return starts.filter((start, run) => starts[run + 1] === start + 1).map((start) => order[start]);
}

/** [N] of each Gaussian a hash of all columns: times a constant, and the upper bits added to the lower ones. */
function hashes(count: number, columns: ((row: number) => number)[]): Words {
  const words = new Uint32Array(2 * count);
  for (const column of columns) {
    for (let row = 0; row < count; row++) {
      const low = (words[2 * row] ^ column(row)) >>> 0;
      const lower = Math.imul(low, FACTOR_LOW) >>> 0;
      const product = highProduct(low, FACTOR_LOW) + Math.imul(low, FACTOR_HIGH);
      const upper = (product + Math.imul(words[2 * row + 1], FACTOR_LOW)) >>> 0;
      words[2 * row] = lower ^ ((lower >>> 29) | (upper << 3));
      words[2 * row + 1] = upper ^ (upper >>> 29);
    }
  }
  return words;
}
