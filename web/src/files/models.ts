/** Reads models of any format, identified by their first bytes, or by name if they have no magic bytes. */
import { bytesKey, viewOf } from '../core/bytes.ts';
import { damaged, InputError } from '../core/errors.ts';
import type { Gaussians } from '../core/gaussians.ts';
import { gaussiansOf, SH_C0, unit } from './coded.ts';
import { type CompressedPlyCodes, dequantiseCompressedPly, isCompressed, readCompressedPly } from './compressed_ply.ts';
import { openPly, readPly, withoutNonFinite } from './ply.ts';
import { type Decode, dequantiseSog, readSog, type SogCodes } from './sog.ts';
import { dequantiseSpz, readSpz, type SpzCodes } from './spz.ts';

/** The quantised values of formats that can carry secrets. */
export type Codes = SpzCodes | SogCodes | CompressedPlyCodes;

/** A file's model. Derived models must not keep its quantised values. */
export interface ReadModel extends Gaussians {
  readonly codes?: Codes;
}

/** `decode`: decoder for the images of a .sog. Raises InputError for unknown formats and damaged files. */
export async function readModel(bytes: Uint8Array, name = '', decode?: Decode): Promise<ReadModel> {
  const start = bytesKey(bytes.subarray(0, 4));
  if (start.startsWith('ply')) {
    const file = openPly(bytes);
    return isCompressed(file) ? readCompressedPly(file) : readPly(file);
  }
  if (start === 'NGSP' || start.startsWith('\x1f\x8b')) return readSpz(bytes);
  if (start === 'PK\x03\x04') return readSog(bytes, decode);
  if (/\.splat$/i.test(name)) return readSplat(bytes);
  throw new InputError('This is not a file of a 3D Gaussian Splatting model that this page can read.');
}

/** The Gaussians of quantised values; of a compressed .ply without harmonics. */
export function dequantised(codes: Codes): Gaussians {
  if (codes.kind === 'spz') return dequantiseSpz(codes);
  return codes.kind === 'sog' ? dequantiseSog(codes) : dequantiseCompressedPly(codes);
}

const MIN_SCALE = 2 ** -126;
const ROW = 32; // bytes: mean and scale as floats; red, green, blue, opacity and quaternion as bytes

/** The finite Gaussians of a file. Raises InputError. */
function readSplat(bytes: Uint8Array): Gaussians {
  if (bytes.length === 0 || bytes.length % ROW) throw damaged();
  const view = viewOf(bytes);
  return withoutNonFinite(gaussiansOf(bytes.length / ROW, 0, {
    mean: (row, axis) => view.getFloat32(ROW * row + 4 * axis, true),
    logScale: (row, axis) => {
      const scale = view.getFloat32(ROW * row + 12 + 4 * axis, true);
      return Math.log(scale === 0 ? MIN_SCALE : scale); // NaN if negative
    },
    sh: (row, _, channel) => (bytes[ROW * row + 24 + channel] / 255 - 0.5) / SH_C0,
    opacity: (row) => bytes[ROW * row + 27],
    quat: (row) => unit(Array.from(bytes.subarray(ROW * row + 28, ROW * (row + 1)), (each) => each / 128 - 1)),
  }));
}
