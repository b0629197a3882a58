/**
 * The low mantissa bits of a model: where they are, IDs of Gaussians, hashes of all other bits, and the Gaussians that serve as
 * the salt of Argon2id. See docs/byte-layout.md, "Low bits" and "From a key to a data key".
 */
import { sha256 } from '@noble/hashes/sha2.js';
import { createBLAKE2b } from 'hash-wasm';
import { ascii, joined, quantile } from '../../core/bytes.ts';
import { coefficients, type Gaussians } from '../../core/gaussians.ts';
import { ID_BYTES } from '../foreign.ts';

export const DEPTHS: readonly number[] = [4, 6, 8]; // bits of a field that are read
export const [LEAST, DEEPEST] = [4, 8];
const GEOMETRY = 8; // fields before the harmonics: three scales, four parts of a quaternion, opacity
const UNIT_TOLERANCE = 1e-4;
const FIRST_QUAT = 3;
const LOW = 0x1ff; // bits that some depth replaces, and bit 0
const PERSONALISATION = ascii('keyss/identity\0\0');
const STATE = 4; // bytes before the state of BLAKE2b in what hash-wasm saves

/** Bit patterns of the fields that may be in use, and which are. */
interface Fields {
  readonly count: number;
  readonly width: number; // fields of a Gaussian
  readonly words: Uint32Array; // [N, width]
  readonly inUse: readonly number[]; // columns of `words`
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
  const isQuat = (field: number): boolean => field >= FIRST_QUAT && field < FIRST_QUAT + 4;
  const inUse = Array.from({ length: width }, (_, field) => field).filter((field) => quatsInUse || !isQuat(field));
  return { count, width, words, inUse, quatsInUse };
}

const scratchWords = new Uint32Array(4);
const scratchFloats = new Float32Array(scratchWords.buffer);

/** Length of the quaternion of the Gaussian whose fields begin at `at`, with the middle of all low bits. */
function coarseLength(words: Uint32Array, at: number): number {
  for (let part = 0; part < 4; part++) {
    scratchWords[part] = (words[at + FIRST_QUAT + part] & ~LOW) | ((LOW + 1) >> 1);
  }
  let sum = 0;
  for (const each of scratchFloats) sum += each * each;
  return Math.sqrt(sum);
}

/** [N, 16] a public hash of all of a Gaussian that embedding leaves as it is. */
export async function gaussianIds(gaussians: Gaussians, fields: Fields): Promise<Uint8Array> {
  const hasher = await createBLAKE2b(8 * ID_BYTES);
  const start = hasher.init().save();
  // hash-wasm has no option for it: the last of the parameters with which the state begins, as of RFC 7693.
  PERSONALISATION.forEach((byte, at) => (start[STATE + 48 + at] ^= byte));
  const { count, width, words, inUse } = fields;
  const ids = new Uint8Array(count * ID_BYTES);
  const means = new Uint32Array(gaussians.means.buffer, gaussians.means.byteOffset, 3 * count);
  const row = new Uint32Array(3 + width);
  const bytes = new Uint8Array(row.buffer);
  for (let index = 0; index < count; index++) {
    row.set(means.subarray(3 * index, 3 * index + 3));
    row.set(words.subarray(index * width, (index + 1) * width), 3);
    for (const field of inUse) row[3 + field] &= ~LOW | 1;
    ids.set(hasher.load(start).update(bytes).digest('binary'), index * ID_BYTES);
  }
  return ids;
}

/** [N, F] the low bits at the greatest depth: a byte for each field in use. */
export function lowBits({ count, width, words, inUse }: Fields): Uint8Array {
  const bits = new Uint8Array(count * inUse.length);
  for (let row = 0, to = 0; row < count; row++) {
    for (let field = 0; field < inUse.length; field++) bits[to++] = words[row * width + inUse[field]] >>> 1;
  }
  return bits;
}

/** Whole bytes in the low bits of one Gaussian with `fields` in use. */
export function lowWidth(fields: number, depth: number): number {
  return Math.floor((fields * depth) / 8);
}

/** [N, B] the low bits [N, fields] at a depth, field after field, the highest bit first. */
export function atDepth(low: Uint8Array, fields: number, depth: number): Uint8Array {
  if (depth === DEEPEST) return low;
  const size = lowWidth(fields, depth);
  const rows = new Uint8Array((low.length / fields) * size);
  const mask = (1 << depth) - 1;
  for (let from = 0, end = 0, to = 0; from < low.length; ) {
    let [bits, held] = [0, 0];
    end += size;
    for (let field = 0; field < fields; field++) {
      bits = (bits << depth) | (low[from++] & mask);
      held += depth;
      if (held >= 8 && to < end) rows[to++] = bits >>> (held -= 8);
      bits &= (1 << held) - 1;
    }
  }
  return rows;
}

const SALTS = 4; // tried
const LABEL = ascii('keyss/v1/salt');
const EQUAL = 3; // numbers that moved by equal amounts
const LARGE_ENOUGH = 118; // biased exponent of 2^-9
const LAST = 255;

/** Up to 4 salts of 16 bytes, the likeliest first; `low`: the low bits at the least depth, rows of `size` bytes. */
export function salts(fields: Fields, ids: Uint8Array, low: Uint8Array, size: number): Uint8Array[] {
  const late = new Map<number, number>();
  const first: number[] = [];
  for (let row = 0; row < fields.count; row++) {
    const last = first[SALTS - 1];
    if (late.get(last) === 0 && compared(ids, row, last, ID_BYTES) > 0) continue; // comes after it, late or not
    late.set(row, movedFromZero(fields, row) ? LAST : smallness(fields, row));
    first.push(row);
    first.sort((a, b) => late.get(a)! - late.get(b)! || compared(ids, a, b, ID_BYTES) || compared(low, a, b, size));
    first.length = Math.min(first.length, SALTS);
  }
  return first.map((row) =>
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

/** Octaves by which the smallest even number lies below `LARGE_ENOUGH`; 0 for larger ones. */
function smallness({ width, words, inUse }: Fields, row: number): number {
  let most = 0;
  for (const field of inUse) {
    const word = words[row * width + field];
    if (!(word & 1)) most = Math.max(most, LARGE_ENOUGH - ((word >>> 23) & 255));
  }
  return most;
}

const ownWords = new Uint32Array(2);
const ownFloats = new Float32Array(ownWords.buffer);

/** True if three numbers of a group are equal in magnitude, as far as the bits tell that stay at the least depth. */
function movedFromZero({ width, words, quatsInUse }: Fields, row: number): boolean {
  const groups = [[0, 1, 2, 7], ...(quatsInUse ? [[3, 4, 5, 6]] : [])];
  for (let colour = 0; colour < 3; colour++) {
    const group: number[] = [];
    for (let field = GEOMETRY + colour; field < width; field += 3) group.push(field);
    groups.push(group);
  }
  return groups.some((group) => {
    const [sizes, spans] = [[] as number[], [] as number[]];
    for (const field of group) {
      const word = words[row * width + field];
      ownWords[0] = (word & ~((2 << LEAST) - 1)) | (1 << LEAST);
      ownWords[1] = word & 0x7f800000;
      sizes.push(Math.abs(ownFloats[0]));
      spans.push(ownFloats[1] * 2 ** (LEAST + 1 - 23));
    }
    return sizes.some((own, one) => {
      let equal = 0;
      for (let other = 0; other < sizes.length; other++) {
        if (Math.abs(own - sizes[other]) <= Math.max(spans[one], spans[other])) equal++;
      }
      return equal >= EQUAL;
    });
  });
}
