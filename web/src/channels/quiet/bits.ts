/**
 * The low mantissa bits of a model: where they are, and IDs of Gaussians, hashes of all other bits.
 * See docs/byte-layout.md, "Low bits".
 */
import { blake2b } from '@noble/hashes/blake2.js';
import { ascii, quantile } from '../../core/bytes.ts';
import { coefficients, type Gaussians } from '../../core/gaussians.ts';

export const ID_BYTES = 16;
export const GEOMETRY = 8; // fields before the harmonics: three scales, four parts of a quaternion, opacity
export const UNIT_TOLERANCE = 1e-4;
const FIRST_QUAT = 3;
const GEOMETRY_MASK = 0x1fe; // bits 1 to 8
const SH_MASK = 0x1ffe; // bits 1 to 12
const PERSONALISATION = ascii('keyss/identity\0\0');

/** Bit patterns of the fields that may be in use, and which are. */
export interface Fields {
  readonly count: number;
  readonly width: number; // fields of a Gaussian
  readonly words: Uint32Array; // [N, width]
  readonly masks: Uint32Array; // [width] bits in use; 0 for a field that is not
  readonly quatsInUse: boolean;
}

export function fieldsOf(gaussians: Gaussians): Fields {
  const { count } = gaussians;
  const harmonics = 3 * (coefficients(gaussians.shDegree) - 1);
  const width = GEOMETRY + harmonics;
  const words = new Uint32Array(count * width);
  const [scales, quats, opacities, sh] = [
    gaussians.logScales, gaussians.quats, gaussians.opacityLogits, gaussians.sh,
  ].map((each) => new Uint32Array(each.buffer, each.byteOffset, each.length));
  for (let row = 0; row < count; row++) {
    const at = row * width;
    words.set(scales.subarray(3 * row, 3 * row + 3), at);
    words.set(quats.subarray(4 * row, 4 * row + 4), at + FIRST_QUAT);
    words[at + 7] = opacities[row];
    const first = row * (harmonics + 3) + 3;
    words.set(sh.subarray(first, first + harmonics), at + GEOMETRY);
  }
  const lengths = new Float64Array(count);
  for (let row = 0; row < count; row++) lengths[row] = Math.abs(coarseLength(words, row * width) - 1);
  const quatsInUse = count === 0 || quantile(lengths, 0.5) > UNIT_TOLERANCE;
  const masks = new Uint32Array(width).fill(GEOMETRY_MASK, 0, GEOMETRY).fill(SH_MASK, GEOMETRY);
  if (!quatsInUse) masks.fill(0, FIRST_QUAT, FIRST_QUAT + 4);
  return { count, width, words, masks, quatsInUse };
}

const scratchWords = new Uint32Array(4);
const scratchFloats = new Float32Array(scratchWords.buffer);

/** Length of the quaternion of the Gaussian whose fields begin at `at`, with the middle of all low bits. */
export function coarseLength(words: Uint32Array, at: number): number {
  for (let part = 0; part < 4; part++) {
    scratchWords[part] = (words[at + FIRST_QUAT + part] & ~0x1ff) | 0x100;
  }
  let sum = 0;
  for (const each of scratchFloats) sum += each * each;
  return Math.sqrt(sum);
}

/** [N, 16] a public hash of all of a Gaussian that embedding leaves as it is. */
export function gaussianIds(gaussians: Gaussians, fields: Fields): Uint8Array {
  const { count, width, words, masks } = fields;
  const found = new Uint8Array(count * ID_BYTES);
  const means = new Uint32Array(gaussians.means.buffer, gaussians.means.byteOffset, 3 * count);
  const row = new Uint32Array(3 + width);
  const bytes = new Uint8Array(row.buffer);
  for (let index = 0; index < count; index++) {
    for (let axis = 0; axis < 3; axis++) row[axis] = means[3 * index + axis];
    for (let field = 0; field < width; field++) {
      row[3 + field] = words[index * width + field] & ~masks[field];
    }
    const hash = blake2b(bytes, { dkLen: ID_BYTES, personalization: PERSONALISATION });
    found.set(hash, index * ID_BYTES);
  }
  return found;
}

/** Bytes in the low bits of one Gaussian, with all harmonics or only `harmonics` of them. */
export function lowWidth(fields: Fields, harmonics = Infinity): number {
  const used = Math.min(harmonics, fields.width - GEOMETRY);
  return (fields.quatsInUse ? GEOMETRY : GEOMETRY - 4) + Math.floor((3 * used) / 2);
}

/** [N, B] the low bits as bytes. */
export function lowBits(fields: Fields): Uint8Array {
  const { count, width, words, masks } = fields;
  const size = lowWidth(fields);
  const found = new Uint8Array(count * size);
  const bits = (at: number, field: number): number =>
    field < width ? (words[at + field] & masks[field]) >>> 1 : 0;
  for (let row = 0; row < count; row++) {
    const at = row * width;
    const end = (row + 1) * size;
    let to = row * size;
    for (let field = 0; field < GEOMETRY; field++) {
      if (masks[field]) found[to++] = bits(at, field);
    }
    for (let field = GEOMETRY; field < width; field += 2) {
      const [a, b] = [bits(at, field), bits(at, field + 1)]; // two times 12 bits are three bytes
      for (const byte of [a >> 4, ((a & 15) << 4) | (b >> 8), b & 255]) {
        if (to < end) found[to++] = byte;
      }
    }
  }
  return found;
}
