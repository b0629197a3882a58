/** Reader of .splat, 32 bytes per Gaussian; counterpart of `keyss.files.formats.splat`. */
import { viewOf } from '../core/bytes.ts';
import { damaged } from '../core/errors.ts';
import { emptyGaussians } from '../core/gaussians.ts';
import { logit, logScale, SH_C0, unitQuat } from './coded.ts';
import { withoutNonFinite, type FiniteGaussians } from './ply.ts';

const ROW = 32; // bytes: mean and scale as floats; red, green, blue, opacity and quaternion as bytes

/** The finite Gaussians of a file. Raises InputError. */
export function readSplat(bytes: Uint8Array): FiniteGaussians {
  if (bytes.length === 0 || bytes.length % ROW) throw damaged();
  const view = viewOf(bytes);
  const model = emptyGaussians(bytes.length / ROW, 0);
  for (let row = 0, at = 0; row < model.count; row++, at += ROW) {
    for (let axis = 0; axis < 3; axis++) {
      model.means[3 * row + axis] = view.getFloat32(at + 4 * axis, true);
      model.logScales[3 * row + axis] = logScale(view.getFloat32(at + 12 + 4 * axis, true));
      model.sh[3 * row + axis] = (bytes[at + 24 + axis] / 255 - 0.5) / SH_C0;
    }
    model.opacityLogits[row] = logit(bytes[at + 27]);
    const [w, x, y, z] = bytes.subarray(at + 28, at + ROW);
    model.quats.set(unitQuat(w / 128 - 1, x / 128 - 1, y / 128 - 1, z / 128 - 1), 4 * row);
  }
  return withoutNonFinite(model);
}
