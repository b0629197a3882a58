/** Shared by quantised formats; counterpart of `keyss.files.formats.common`. */
import { coefficients, emptyGaussians, type Gaussians } from '../core/gaussians.ts';

export const SH_C0 = 0.28209479177387814;
const OPACITY_LOGIT_BOUND = 16;
const [SMALL_COUNT, MIN_BYTES] = [1 << 17, 6]; // bytes per Gaussian in larger files

/** Maximum number of Gaussians in `size` compressed bytes. */
export function mostHeld(size: number): number {
  return Math.max(SMALL_COUNT, Math.floor(size / MIN_BYTES));
}

/** Whether `size` compressed bytes can hold `count` Gaussians, at least one. */
export function holds(size: number, count: number): boolean {
  return Number.isInteger(count) && count >= 1 && count <= mostHeld(size);
}

/** Opacity logit of `byte` 255ths; finite for 0 and 255 too. */
function logit(byte: number): number {
  const value = Math.log(byte / 255) - Math.log1p(-byte / 255);
  return Math.max(-OPACITY_LOGIT_BOUND, Math.min(OPACITY_LOGIT_BOUND, value));
}

/** A unit quaternion from the index of the component left out, and the other three. */
export function fromSmallestThree(largest: number, others: readonly number[]): number[] {
  const squares = others[0] * others[0] + others[1] * others[1] + others[2] * others[2];
  const quat = [...others];
  quat.splice(largest, 0, Math.sqrt(Math.max(0, 1 - squares)));
  return quat;
}

/** One number of a Gaussian per axis, or per component of its rotation. */
export type OfAxis = (row: number, axis: number) => number;

export function byRow(table: ArrayLike<number>, width: number): OfAxis {
  return (row, axis) => table[width * row + axis];
}

/** What the codes of a Gaussian mean. */
interface Decoding {
  readonly mean: OfAxis;
  readonly logScale: OfAxis;
  readonly quat: (row: number) => number[]; // wxyz
  readonly opacity: (row: number) => number; // 255ths
  readonly sh: (row: number, index: number, channel: number) => number; // index 0 to K - 1
}

export function gaussiansOf(count: number, shDegree: number, of: Decoding): Gaussians {
  const model = emptyGaussians(count, shDegree);
  const k = coefficients(shDegree);
  for (let row = 0; row < count; row++) {
    for (let axis = 0; axis < 3; axis++) {
      model.means[3 * row + axis] = of.mean(row, axis);
      model.logScales[3 * row + axis] = of.logScale(row, axis);
      for (let index = 0; index < k; index++) model.sh[3 * (k * row + index) + axis] = of.sh(row, index, axis);
    }
    model.quats.set(of.quat(row), 4 * row);
    model.opacityLogits[row] = logit(of.opacity(row));
  }
  return model;
}
