/** Reader of SPZ, versions 2 to 4; counterpart of `keyss.files.formats.spz`. */
import { decompress } from 'fzstd';
import { inflate, viewOf } from '../core/bytes.ts';
import { damaged, InputError } from '../core/errors.ts';
import { coefficients, type Gaussians } from '../core/gaussians.ts';
import { fromSmallestThree, gaussiansOf, holds, mostHeld } from './coded.ts';

const [LEGACY_BYTES, HEADER_BYTES] = [16, 32];
const MAX_EXTENSION_BYTES = 1 << 20;
const [MAX_UNPACKED, GAUSSIAN_BYTES] = [2 ** 31, 65];
export const [NEGATIVE, MAGNITUDE] = [512, 511]; // masks of a rotation's component
export const MAX_FRACTIONAL_BITS = 24;
// Signs of the harmonics of degrees 1 to 3 under (x, y, z) -> (x, -y, -z): SPZ has y up, a .ply y down.
const SH_SIGNS = [-1, -1, 1, -1, 1, 1, -1, 1, -1, 1, -1, -1, 1, -1, 1];

interface Header {
  readonly version: number; // 2 to 4
  readonly count: number;
  readonly shDegree: number;
  readonly fractionalBits: number; // fractional bits of positions
}

/** All integers of a file. */
export interface SpzCodes extends Header {
  readonly kind: 'spz';
  readonly positions: Int32Array; // [N, 3] multiples of 2^-fractionalBits
  readonly alphas: Uint8Array; // [N]
  readonly colours: Uint8Array; // [N, 3]
  readonly scales: Uint8Array; // [N, 3] 16ths of log scales
  readonly largest: Uint8Array; // [N] index (xyzw) of the component left out
  readonly rotations: Uint16Array; // [N, 3] components that are stored: 512 (if negative) + magnitude; version 2: 8 bits
  readonly harmonics: Uint8Array; // [N, K - 1, 3]
}

export async function readSpz(bytes: Uint8Array): Promise<Gaussians & { readonly codes: SpzCodes }> {
  const codes = bytes[0] === 0x1f ? await legacy(bytes) : version4(bytes);
  return { ...dequantiseSpz(codes), codes };
}

/** A component of a rotation: -511 to 511. */
export function rotationPart(code: number): number {
  return (code & NEGATIVE ? -1 : 1) * (code & MAGNITUDE);
}

function header(bytes: Uint8Array, versions: number[], size: number): Header & { sizes: number[] } {
  const view = viewOf(bytes);
  if (bytes.length < LEGACY_BYTES || view.getUint32(0, true) !== 0x5053474e) throw damaged(); // NGSP
  const [version, count] = [view.getUint32(4, true), view.getUint32(8, true)];
  const [shDegree, fractionalBits] = [bytes[12], bytes[13]];
  if (!versions.includes(version)) throw new InputError('This SPZ is of a version that cannot be read.');
  if (!holds(size, count) || shDegree > 3 || fractionalBits > MAX_FRACTIONAL_BITS) throw damaged();
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
  const [places, alphas, colours, scales, words, harmonics] = sizes.map(section);
  const { count, version } = header;
  const positions = Int32Array.from({ length: 3 * count }, (_, at) => {
    return ((places[3 * at] | (places[3 * at + 1] << 8) | (places[3 * at + 2] << 16)) << 8) >> 8;
  });
  const [largest, rotations] = [new Uint8Array(count).fill(3), new Uint16Array(3 * count)];
  if (version === 2) rotations.set(words);
  for (let row = 0; row < count && version > 2; row++) {
    const word = viewOf(words).getUint32(4 * row, true);
    largest[row] = word >>> 30;
    rotations.set([20, 10, 0].map((shift) => (word >>> shift) & 1023), 3 * row);
  }
  return { kind: 'spz', ...header, positions, alphas, colours, scales, largest, rotations, harmonics };
}

export function dequantiseSpz(codes: SpzCodes): Gaussians {
  const { count, version, shDegree, fractionalBits, positions, alphas, colours, scales, largest, rotations, harmonics } = codes;
  const rest = coefficients(shDegree) - 1;
  const part = (code: number): number =>
    version === 2 ? code / 127.5 - 1 : rotationPart(code) * (Math.sqrt(0.5) / MAGNITUDE);
  return gaussiansOf(count, shDegree, {
    mean: (row, axis) => positions[3 * row + axis] * 2 ** -fractionalBits * (axis ? -1 : 1),
    logScale: (row, axis) => scales[3 * row + axis] / 16 - 10,
    quat: (row) => {
      const [x, y, z, w] = fromSmallestThree(largest[row], Array.from(rotations.subarray(3 * row, 3 * row + 3), part));
      return [w, x, -y, -z];
    },
    opacity: (row) => alphas[row],
    sh: (row, index, channel) => {
      if (index === 0) return (colours[3 * row + channel] / 255 - 0.5) / 0.15;
      return ((harmonics[3 * (rest * row + index - 1) + channel] - 128) / 128) * SH_SIGNS[index - 1];
    },
  });
}
