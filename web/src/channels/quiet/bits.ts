/**
 * The low mantissa bits of a model: where they are, IDs of Gaussians, hashes of all other bits, and the Gaussians that serve as
 * the salt of Argon2id. See docs/byte-layout.md, "Low bits" and "From a key to a data key".
 */
import { blake2b } from '@noble/hashes/blake2.js';
import { sha256 } from '@noble/hashes/sha2.js';
import { ascii, joined, quantile } from '../../core/bytes.ts';
import { coefficients, type Gaussians } from '../../core/gaussians.ts';

export const ID_BYTES = 16;
const GEOMETRY = 8; // fields before the harmonics: three scales, four parts of a quaternion, opacity
const UNIT_TOLERANCE = 1e-4;
const FIRST_QUAT = 3;
const GEOMETRY_MASK = 0x1fe; // bits 1 to 8
const SH_MASK = 0x1ffe; // bits 1 to 12
const PERSONALISATION = ascii('keyss/identity\0\0');

/** Bit patterns of the fields that may be in use, and which are. */
interface Fields {
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
function coarseLength(words: Uint32Array, at: number): number {
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

const SALTS = 4; // tried
const LABEL = ascii('keyss/v2/salt');
const EQUAL_HARMONICS = 2; // pairs of one colour that make a Gaussian doubtful

/** Up to 4 salts of 16 bytes, the likeliest first; `low` has rows of `size` bytes. */
export function salts(fields: Fields, ids: Uint8Array, low: Uint8Array, size: number): Uint8Array[] {
  const ranks = new Uint16Array(fields.count);
  for (let row = 0; row < fields.count; row++) ranks[row] = rank(fields, row);
  const order = Array.from(ranks.keys()).sort((a, b) => {
    return ranks[a] - ranks[b] || compared(ids, a, b, ID_BYTES) || compared(low, a, b, size);
  });
  return order.slice(0, SALTS).map((row) =>
    saltOf(ids.subarray(row * ID_BYTES, (row + 1) * ID_BYTES), low.subarray(row * size, (row + 1) * size)),
  );
}

/** The salt of one carrier. */
export function saltOf(id: Uint8Array, low: Uint8Array): Uint8Array {
  return sha256(joined(LABEL, id, low)).slice(0, 16);
}

function compared(rows: Uint8Array, a: number, b: number, width: number): number {
  for (let at = 0; at < width; at++) {
    const difference = rows[a * width + at] - rows[b * width + at];
    if (difference) return difference;
  }
  return 0;
}

/** 0 to 511: 256 for a doubtful Gaussian, and less the larger its least harmonic is. */
function rank(fields: Fields, row: number): number {
  const { width, words, masks } = fields;
  const at = row * width;
  let least = 255;
  for (let field = width > GEOMETRY ? GEOMETRY : 0; field < width; field++) {
    if (width > GEOMETRY || masks[field]) least = Math.min(least, (words[at + field] >>> 23) & 255);
  }
  return (isDoubtful(fields, at) ? 256 : 0) | (255 - least);
}

function isDoubtful(fields: Fields, at: number): boolean {
  const { width, words, masks, quatsInUse } = fields;
  for (let field = 0; field < width; field++) {
    const word = words[at + field];
    if (!masks[field]) continue;
    if (((word >>> 23) & 255) === 0 || (word & 0x7ffffe & ~masks[field]) === 0) return true;
  }
  if (quatsInUse && Math.abs(coarseLength(words, at) - 1) < UNIT_TOLERANCE) return true;
  const high = (field: number): number =>
    (words[at + field] & 0x7fffffff) >>> (field < GEOMETRY ? 9 : 13);
  const near = (first: number, count: number): boolean => {
    for (let a = first; a < first + count; a++) {
      for (let b = a + 1; b < first + count; b++) {
        if (Math.abs(high(a) - high(b)) <= 1) return true;
      }
    }
    return false;
  };
  if (near(0, 3) || (quatsInUse && near(3, 4))) return true;
  for (let field = GEOMETRY; field < width; field += 3) if (near(field, 3)) return true;
  let equal = 0;
  for (let colour = 0; colour < 3; colour++) {
    const values: number[] = [];
    for (let field = GEOMETRY + colour; field < width; field += 3) values.push(high(field));
    equal += values.length - new Set(values).size;
  }
  return equal >= EQUAL_HARMONICS;
}
