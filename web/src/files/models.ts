/** Reads models of any format, identified by their first bytes, or by name if they have no magic bytes. */
import { InputError } from '../core/errors.ts';
import type { Gaussians } from '../core/gaussians.ts';
import { type CompressedPlyCodes, isCompressed, readCompressedPly } from './compressed_ply.ts';
import type { Decode } from './packed.ts';
import { binaryPly, plyHeader, readPly } from './ply.ts';
import { readSog, type SogCodes } from './sog.ts';
import { readSplat } from './splat.ts';
import { readSpz, type SpzCodes } from './spz.ts';

/** The codes of formats whose low bits can carry secrets. */
export type Codes = SpzCodes | SogCodes | CompressedPlyCodes;

/** A file's model. Derived models must not keep the codes. */
export interface ReadModel extends Gaussians {
  readonly codes?: Codes;
  readonly leftOut?: number; // Gaussians dropped because they are not finite
}

/** `decode`: decoder for the images of a .sog. Raises InputError for unknown formats and damaged files. */
export async function readModel(bytes: Uint8Array, name = '', decode?: Decode): Promise<ReadModel> {
  const start = [...bytes.subarray(0, 4)].map((byte) => String.fromCharCode(byte)).join('');
  if (start.startsWith('ply')) {
    const file = binaryPly(bytes);
    const header = plyHeader(file);
    return isCompressed(header) ? readCompressedPly(file, header) : readPly(file);
  }
  if (start === 'NGSP' || start.startsWith('\x1f\x8b')) return readSpz(bytes);
  if (start === 'PK\x03\x04') return readSog(bytes, decode);
  if (/\.splat$/i.test(name)) return readSplat(bytes);
  throw new InputError('This is not a file of a 3D Gaussian Splatting model that this page can read.');
}
