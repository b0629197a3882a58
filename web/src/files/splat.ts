/** Reader of .splat, 32 bytes per Gaussian; counterpart of `keyss.files.formats.splat`. */
import { viewOf } from '../core/bytes.ts';
import { damaged } from '../core/errors.ts';
import { gaussiansOf, logScale, SH_C0, unitQuat } from './coded.ts';
import { withoutNonFinite, type FiniteGaussians } from './ply.ts';

const ROW = 32; // bytes: mean and scale as floats; red, green, blue, opacity and quaternion as bytes

/** The finite Gaussians of a file. Raises InputError. */
export function readSplat(bytes: Uint8Array): FiniteGaussians {
  if (bytes.length === 0 || bytes.length % ROW) throw damaged();
  const view = viewOf(bytes);
  return withoutNonFinite(gaussiansOf(bytes.length / ROW, 0, {
    mean: (row, axis) => view.getFloat32(ROW * row + 4 * axis, true),
    logScale: (row, axis) => logScale(view.getFloat32(ROW * row + 12 + 4 * axis, true)),
    sh: (row, _, channel) => (bytes[ROW * row + 24 + channel] / 255 - 0.5) / SH_C0,
    opacity: (row) => bytes[ROW * row + 27],
    quat: (row) => {
      const [w, x, y, z] = bytes.subarray(ROW * row + 28, ROW * (row + 1));
      return unitQuat(w / 128 - 1, x / 128 - 1, y / 128 - 1, z / 128 - 1);
    },
  }));
}
