/**
 * The integers of a quantised model that carry bits, how many bits each, the order in which they are counted, and the messages
 * of blocks of them; counterpart of `keyss.channels.lsb.fields` and `wet_paper`.
 *
 * The arithmetic gives the same result on every machine, in the same order of operations as in Python, without
 * logarithms: a reader must find the same numbers of bits as the writer.
 */
import { sha256 } from '@noble/hashes/sha2.js';
import { ascii, joined } from '../../core/bytes.ts';
import { highProduct, multiplicities, sortingOrder, type Words } from '../../core/words.ts';
import { byRow, type OfAxis } from '../../files/coded.ts';
import {
  CHUNK, type CompressedPlyCodes, rotationPart as pliedPart, VECTOR, vectorPart,
} from '../../files/compressed_ply.ts';
import type { Codes } from '../../files/models.ts';
import { FINEST, LARGEST, type SogCodes } from '../../files/sog.ts';
import { rotationPart, type SpzCodes } from '../../files/spz.ts';
import { streamWords } from '../../keys/keys.ts';

const MAX_BITS = 10;
const SHARE = -3; // log2 of the range of written positions, in sizes of the Gaussian
const LOG_SCALE = -4; // log2 of the range of written log scales
const LOG2_E = 1.4426950408889634;
const MAX_DISTANCE = 64; // powers of 2
const HASH_BYTES = 12;
const AXES = [0, 1, 2];
const [FACTOR_HIGH, FACTOR_LOW] = [0x9e3779b9, 0x7f4a7c15];

/** One coordinate of an attribute: the level (integer) of each Gaussian, and the bits that it carries, 0 to 10. */
interface Field {
  readonly level: (row: number) => number;
  readonly bits: (row: number) => number;
}

/** The integers of a quantised model. */
export interface Levels {
  readonly unwritten: OfAxis; // three constant colours and the opacity, which never change
  readonly fields: Field[];
  readonly rows: ArrayLike<number>; // Gaussians in the order in which bits are counted
}

/** The levels of a file. */
export function levelsOf(codes: Codes): Levels {
  if (codes.kind === 'spz') return spzLevels(codes);
  return codes.kind === 'sog' ? sogLevels(codes) : compressedPlyLevels(codes);
}

function spzLevels(codes: SpzCodes): Levels {
  const { count, fractionalBits, version, positions, scales, rotations, colours, alphas } = codes;
  const bits = Uint8Array.from({ length: count }, (_, row) => {
    const size = (median(row, byRow(scales, 3)) / 16 - 10) * LOG2_E;
    return fitting(size + fractionalBits + SHARE);
  });
  const fields = fieldsOf(byRow(positions, 3), (row) => bits[row]);
  // The rotations of version 2 carry nothing.
  if (version > 2) fields.push(...fieldsOf((row, part) => rotationPart(rotations[3 * row + part]), () => 3));
  return { fields, rows: inOrder(count), unwritten: (row, part) => (part < 3 ? colours[3 * row + part] : alphas[row]) };
}

function sogLevels({ count, mins, maxs, positions, quats, scaleBook, scales, colours, labels }: SogCodes): Levels {
  const extent = AXES.map((axis) => (maxs[axis] > mins[axis] ? maxs[axis] - mins[axis] : 1));
  const [place, turn, scale, colour] = [byRow(positions, 3), byRow(quats, 4), byRow(scales, 4), byRow(colours, 4)];
  /** log2 of the step at a position, relative to the step at 0. */
  const distance = (row: number, axis: number): number => {
    const log = Math.abs(mins[axis] + extent[axis] * (place(row, axis) / FINEST));
    return Math.min(Math.max(Math.floor(log * LOG2_E), 0), MAX_DISTANCE);
  };
  const finest = extent.map((each) => log2(each / FINEST));
  const places = fieldsOf(place, (row, axis) => {
    const step = finest[axis] + distance(row, axis) + 0.5;
    return fitting(median(row, (own, each) => scaleBook[scale(own, each)]) * LOG2_E + SHARE - step);
  });
  const own = hashes(count, (row) => [
    ...AXES.map((axis) => scale(row, axis)), ...[0, 1, 2, 3].map((part) => colour(row, part)),
    labels[row], turn(row, 3) - LARGEST, ...AXES.map((axis) => distance(row, axis)),
  ]);
  return { fields: [...places, ...fieldsOf(turn, () => 2)], rows: unique(own), unwritten: colour };
}

function compressedPlyLevels({ count, scaleBounds, scales, rotations, colours }: CompressedPlyCodes): Levels {
  const bits = scaleBounds.map(([low, high], axis) =>
    Uint8Array.from(low, (least, chunk) => fitting(LOG_SCALE - log2((high[chunk] - least) / VECTOR[axis]))),
  );
  const sizes = fieldsOf((row, axis) => vectorPart(scales[row], axis), (row, axis) => bits[axis][Math.floor(row / CHUNK)]);
  const turns = fieldsOf((row, part) => pliedPart(rotations[row], part), () => 3);
  const unwritten: OfAxis = (row, part) => (colours[row] >>> (24 - 8 * part)) & 255;
  return { fields: [...sizes, ...turns], rows: inOrder(count), unwritten };
}

function fieldsOf(level: OfAxis, bits: OfAxis): Field[] {
  return AXES.map((axis) => ({ level: (row) => level(row, axis), bits: (row) => bits(row, axis) }));
}

function inOrder(count: number): Uint32Array {
  return Uint32Array.from({ length: count }, (_, row) => row);
}

/** The median of the numbers of three axes. */
function median(row: number, of: OfAxis): number {
  const [a, b, c] = [of(row, 0), of(row, 1), of(row, 2)];
  return Math.max(Math.min(a, b), Math.min(Math.max(a, b), c));
}

/** The number of bits of levels that span at most 2 ** `log`; 0 for NaN. */
function fitting(log: number): number {
  return Math.min(Math.max(Math.floor(log), 0), MAX_BITS) || 0;
}

const NUMBER = new Float64Array(1);
const HALVES = new Uint32Array(NUMBER.buffer); // the lower one first, as on all machines that have browsers

/** Approximate log2, too small by up to 0.09: linear between powers of 2. */
export function log2(value: number): number {
  if (value === 0 || !Number.isFinite(value)) return 2 * (value - 1);
  const small = Math.abs(value) < 2 ** -1022; // without an exponent of its own
  NUMBER[0] = small ? value * 2 ** 54 : value;
  const exponent = ((HALVES[1] >>> 20) & 2047) - 1022 - (small ? 54 : 0);
  HALVES[1] = (HALVES[1] & 0x800fffff) | (1022 << 20);
  return exponent + 2 * (NUMBER[0] - 1); // of a mantissa of 0.5 to 1
}

/** The last bits of all levels, each 0 or 1, in the order in which they are counted. */
export function lastBits({ fields, rows }: Levels): Uint8Array {
  let size = 0;
  for (const field of fields) for (let index = 0; index < rows.length; index++) size += field.bits(rows[index]);
  const bits = new Uint8Array(size);
  let at = 0;
  for (const field of fields) {
    for (let index = 0; index < rows.length; index++) {
      const [own, level] = [field.bits(rows[index]), field.level(rows[index])];
      for (let bit = 0; bit < own; bit++) bits[at++] = (level >> bit) & 1;
    }
  }
  return bits;
}

/** 12 bytes of a hash of colours and opacities, which never change: it binds blocks to their model. */
export function modelHash({ unwritten, rows }: Levels): Uint8Array {
  const words = Uint32Array.from({ length: 4 * rows.length }, (_, at) => unwritten(rows[at >>> 2], at & 3));
  return sha256(joined(ascii('keyss/v1/host'), new Uint8Array(words.buffer))).subarray(0, HASH_BYTES);
}

/** Rows in the order of their hashes, without rows that share one: they carry nothing. */
function unique(words: Words): Uint32Array {
  const order = sortingOrder(words);
  const counts = multiplicities(words, order);
  return order.filter((row) => counts[row] === 1);
}

/** [N] hashes of the numbers of each row; counterpart of `row_hashes`. */
function hashes(count: number, numbers: (row: number) => number[]): Words {
  const words = new Uint32Array(2 * count);
  for (let row = 0; row < count; row++) {
    for (const number of numbers(row)) {
      const low = (words[2 * row] ^ number) >>> 0;
      const lower = Math.imul(low, FACTOR_LOW) >>> 0;
      const product = highProduct(low, FACTOR_LOW) + Math.imul(low, FACTOR_HIGH);
      const upper = (product + Math.imul(words[2 * row + 1], FACTOR_LOW)) >>> 0;
      words[2 * row] = lower ^ ((lower >>> 29) | (upper << 3));
      words[2 * row + 1] = upper ^ (upper >>> 29);
    }
  }
  return words;
}

const BLOCK = 1024;
export const BLOCK_BYTES = BLOCK / 8;
const WORDS = BLOCK / 32;
const PUBLIC = new Uint8Array(32); // the seed of order and matrix

/**
 * [B, BLOCK_BYTES] the messages of all blocks of `bits` (0 or 1), each padded with noise, by wet paper codes (Fridrich et al.
 * 2005): a message is the product of its block with a public random matrix, modulo 2.
 */
export function readBlocks(bits: Uint8Array): Uint8Array {
  const high = new Uint32Array(bits.length);
  streamWords(PUBLIC, 'codes/order', 2 * bits.length, (word, at) => {
    if (at & 1) high[at >>> 1] = word;
  });
  const [places, blocks] = [sortingOrder(high, 1), Math.floor(bits.length / BLOCK)];
  const rows = new Uint32Array(BLOCK * WORDS);
  streamWords(PUBLIC, 'codes/matrix', rows.length, (word, at) => (rows[at] = word));
  const found = new Uint32Array(blocks * WORDS);
  const own = new Uint32Array(WORDS);
  for (let block = 0; block < blocks; block++) {
    own.fill(0);
    for (let at = 0; at < BLOCK; at++) own[at >> 5] |= bits[places[block * BLOCK + at]] << (at & 31);
    for (let row = 0; row < BLOCK; row++) {
      let sum = 0;
      for (let word = 0, at = row * WORDS; word < WORDS; word++, at++) sum ^= own[word] & rows[at];
      sum ^= sum >>> 16;
      sum ^= sum >>> 8;
      sum ^= sum >>> 4;
      found[block * WORDS + (row >> 5)] |= ((0x6996 >>> (sum & 15)) & 1) << (row & 31);
    }
  }
  return new Uint8Array(found.buffer);
}
