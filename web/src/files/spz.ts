/** Reader of SPZ, versions 2 to 4; counterpart of `keyss.files.formats.spz`. */
import { decompress } from 'fzstd';
import { inflate, viewOf } from '../core/bytes.ts';
import { damaged, InputError } from '../core/errors.ts';
import { coefficients, emptyGaussians, type Gaussians } from '../core/gaussians.ts';
import { fromSmallestThree, holds, logit, mostHeld } from './coded.ts';

const [LEGACY_BYTES, HEADER_BYTES] = [16, 32];
const MAX_EXTENSION_BYTES = 1 << 20;
const [MAX_UNPACKED, GAUSSIAN_BYTES] = [2 ** 31, 65];
const MAGNITUDE = 511;
// Signs of the harmonics of degrees 1 to 3 under (x, y, z) -> (x, -y, -z): SPZ has y up, a .ply y down.
const SH_SIGNS = [-1, -1, 1, -1, 1, 1, -1, 1, -1, 1, -1, -1, 1, -1, 1];

interface Header {
  readonly version: number; // 2 to 4
  readonly count: number;
  readonly shDegree: number;
  readonly fractionalBits: number; // of positions
}

/** All integers of a file, as bytes. */
export interface SpzCodes extends Header {
  readonly kind: 'spz';
  readonly positions: Uint8Array; // [N, 3, 3] 24 bits each
  readonly alphas: Uint8Array; // [N]
  readonly colours: Uint8Array; // [N, 3]
  readonly scales: Uint8Array; // [N, 3] 16ths of log scales
  readonly rotations: Uint8Array; // [N, 4] a word of 32 bits; version 2: [N, 3]
  readonly harmonics: Uint8Array; // [N, K - 1, 3]
}

export async function readSpz(bytes: Uint8Array): Promise<Gaussians & { readonly codes: SpzCodes }> {
  const codes = bytes[0] === 0x1f ? await legacy(bytes) : version4(bytes);
  return { ...dequantise(codes), codes };
}

/** The code of a coordinate, in multiples of 2^-fractionalBits. */
export function positionCode({ positions }: SpzCodes, row: number, axis: number): number {
  const at = 9 * row + 3 * axis;
  return ((positions[at] | (positions[at + 1] << 8) | (positions[at + 2] << 16)) << 8) >> 8;
}

/** The 32-bit word of a rotation (versions 3 and 4). */
export function rotationWord({ rotations }: SpzCodes, row: number): number {
  const at = 4 * row;
  return (rotations[at] | (rotations[at + 1] << 8) | (rotations[at + 2] << 16) | (rotations[at + 3] << 24)) >>> 0;
}

/** A component of a rotation word, the last in the lowest bits: -511 to 511. */
export function rotationPart(word: number, part: number): number {
  const bits = (word >>> (20 - 10 * part)) & 1023;
  return (bits & 512 ? -1 : 1) * (bits & MAGNITUDE);
}

function header(bytes: Uint8Array, versions: number[], size: number): Header & { sizes: number[] } {
  const view = viewOf(bytes);
  if (bytes.length < LEGACY_BYTES || view.getUint32(0, true) !== 0x5053474e) throw damaged(); // NGSP
  const [version, count] = [view.getUint32(4, true), view.getUint32(8, true)];
  const [shDegree, fractionalBits] = [bytes[12], bytes[13]];
  if (!versions.includes(version)) throw new InputError('This SPZ is of a version that cannot be read.');
  if (!holds(size, count) || shDegree > 3 || fractionalBits > 24) throw damaged();
  const rotation = version === 2 ? 3 : 4;
  const sizes = [9, 1, 3, 3, rotation, 3 * (coefficients(shDegree) - 1)].map((each) => each * count);
  if (sizes.reduce((sum, each) => sum + each, 0) > MAX_UNPACKED) throw damaged();
  return { version, count, shDegree, fractionalBits, sizes };
}

async function legacy(bytes: Uint8Array): Promise<SpzCodes> {
  const most = Math.min(MAX_UNPACKED, GAUSSIAN_BYTES * mostHeld(bytes.length)) + MAX_EXTENSION_BYTES;
  const data = await inflate(bytes, 'gzip', most);
  const found = header(data, [2, 3], bytes.length);
  let at = LEGACY_BYTES;
  return codesOf(found, (size) => {
    if (at + size > data.length) throw damaged();
    return data.subarray(at, (at += size));
  });
}

function version4(bytes: Uint8Array): SpzCodes {
  const found = header(bytes, [4], bytes.length);
  if (bytes.length < HEADER_BYTES) throw damaged();
  const view = viewOf(bytes);
  const [streams, table] = [bytes[15], view.getUint32(16, true)];
  let at = table + 16 * streams;
  if (streams !== found.sizes.filter(Boolean).length || table < HEADER_BYTES || at > bytes.length) throw damaged();
  let entry = table;
  return codesOf(found, (size) => {
    if (!size) return new Uint8Array(0);
    const [packed, whole] = [Number(view.getBigUint64(entry, true)), Number(view.getBigUint64(entry + 8, true))];
    entry += 16;
    if (whole !== size || at + packed > bytes.length) throw damaged();
    const stream = bytes.subarray(at, (at += packed));
    try {
      const out = decompress(stream, new Uint8Array(size));
      if (out.length !== size) throw damaged();
      return out;
    } catch {
      throw damaged();
    }
  });
}

/** `section` returns the next section, which has `size` bytes. */
function codesOf({ sizes, ...header }: Header & { sizes: number[] }, section: (size: number) => Uint8Array): SpzCodes {
  const [positions, alphas, colours, scales, rotations, harmonics] = sizes.map(section);
  return { kind: 'spz', ...header, positions, alphas, colours, scales, rotations, harmonics };
}

function dequantise(codes: SpzCodes): Gaussians {
  const { count, shDegree, fractionalBits, alphas, colours, scales, harmonics } = codes;
  const model = emptyGaussians(count, shDegree);
  const k = coefficients(shDegree);
  for (let row = 0; row < count; row++) {
    for (let axis = 0; axis < 3; axis++) {
      model.means[3 * row + axis] = positionCode(codes, row, axis) * 2 ** -fractionalBits * (axis ? -1 : 1);
      model.logScales[3 * row + axis] = scales[3 * row + axis] / 16 - 10;
      model.sh[3 * k * row + axis] = (colours[3 * row + axis] / 255 - 0.5) / 0.15;
    }
    model.opacityLogits[row] = logit(alphas[row]);
    const [x, y, z, w] = quaternion(codes, row);
    model.quats.set([w, x, -y, -z], 4 * row);
    for (let each = 0; each < k - 1; each++) {
      for (let colour = 0; colour < 3; colour++) {
        const code = harmonics[3 * ((k - 1) * row + each) + colour];
        model.sh[3 * (k * row + each + 1) + colour] = ((code - 128) / 128) * SH_SIGNS[each];
      }
    }
  }
  return model;
}

function quaternion(codes: SpzCodes, row: number): number[] {
  if (codes.version === 2) {
    return fromSmallestThree(3, [0, 1, 2].map((part) => codes.rotations[3 * row + part] / 127.5 - 1));
  }
  const word = rotationWord(codes, row);
  const others = [0, 1, 2].map((part) => rotationPart(word, part) * (Math.sqrt(0.5) / MAGNITUDE));
  return fromSmallestThree(word >>> 30, others);
}
