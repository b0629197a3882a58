/** What formats of few bits share; `keyss.files.formats.common` on the other side. */

export const SH_C0 = 0.28209479177387814;
const OPACITY_LOGIT_BOUND = 16;
const MIN_SCALE = 2 ** -126;
const [SMALL_COUNT, LEAST_BYTES] = [1 << 17, 6]; // so many bytes of each Gaussian where there are more

/** Gaussians that `size` packed bytes can hold at most. */
export function mostHeld(size: number): number {
  return Math.max(SMALL_COUNT, Math.floor(size / LEAST_BYTES));
}

/** Whether `size` packed bytes can hold `count` Gaussians, at least one. */
export function holds(size: number, count: number): boolean {
  return Number.isInteger(count) && count >= 1 && count <= mostHeld(size);
}

/** Of an opacity of `byte` 255ths; 0 and 255 have finite ones as well. */
export function logit(byte: number): number {
  const found = Math.log(byte / 255) - Math.log1p(-byte / 255);
  return Math.max(-OPACITY_LOGIT_BOUND, Math.min(OPACITY_LOGIT_BOUND, found));
}

/** Of a scale; that of 0 is that of the smallest normal number, of negative ones NaN. */
export function logScale(scale: number): number {
  return Math.log(scale === 0 ? MIN_SCALE : scale);
}

/** A quaternion of length 1; one of length 0 becomes (1, 0, 0, 0), as renderers take it. */
export function unitQuat(w: number, x: number, y: number, z: number): number[] {
  const length = Math.sqrt(w * w + x * x + y * y + z * z);
  return length > 0 ? [w / length, x / length, y / length, z / length] : [1, 0, 0, 0];
}

/** A unit quaternion of three of its parts, and which one is the fourth. */
export function fromSmallestThree(largest: number, others: readonly number[]): number[] {
  const squares = others[0] * others[0] + others[1] * others[1] + others[2] * others[2];
  const quat = [...others];
  quat.splice(largest, 0, Math.sqrt(Math.max(0, 1 - squares)));
  return quat;
}

