/** Models of any format that can be read, told by their first bytes. */
import { InputError } from '../core/errors.ts';
import type { Gaussians } from '../core/gaussians.ts';
import { readPly } from './ply.ts';

/** Raises InputError for a file that is none of them, or damaged. */
export async function readModel(bytes: Uint8Array): Promise<Gaussians> {
  if (bytes[0] === 0x70 && bytes[1] === 0x6c && bytes[2] === 0x79) return readPly(bytes);
  throw new InputError('This is not a file of a 3D Gaussian Splatting model that this page can read.');
}
