/** What formats of few bits share; `keyss.files.formats.common` on the other side. */
import { InputError } from '../core/errors.ts';

export const SH_C0 = 0.28209479177387814;
const OPACITY_LOGIT_BOUND = 16;
const LEAST_SCALE = 2 ** -126;
const SMALL_COUNT = 1 << 18; // more Gaussians than this have to take a byte each

/** Raises InputError where a packed file of `size` bytes cannot hold `count` Gaussians, or holds none. */
export function checkCount(count: number, size: number): void {
  if (!Number.isInteger(count) || count < 1 || count > Math.max(SMALL_COUNT, size)) throw damagedFile();
}

/** Of an opacity of `byte` 255ths. */
export function logit(byte: number): number {
  return logitOf(byte / 255);
}

/** Of an opacity from 0 to 1, both of which have finite ones as well. */
export function logitOf(opacity: number): number {
  const found = Math.log(opacity) - Math.log1p(-opacity);
  return Math.max(-OPACITY_LOGIT_BOUND, Math.min(OPACITY_LOGIT_BOUND, found));
}

/** Of a colour of `byte` 255ths. */
export function constantHarmonic(byte: number): number {
  return (byte / 255 - 0.5) / SH_C0;
}

/** Of a scale; that of 0 is that of the smallest normal number, of negative ones NaN. */
export function logScale(scale: number): number {
  return Math.log(scale === 0 ? LEAST_SCALE : scale);
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

export function damagedFile(): InputError {
  return new InputError('This file is damaged, or not whole.');
}

/** The bytes that a stream becomes, at most so many. Raises InputError for more and for damage. */
export async function unpacked(
  bytes: Uint8Array, format: 'gzip' | 'deflate-raw', most: number,
): Promise<Uint8Array> {
  const parts: Uint8Array[] = [];
  let size = 0;
  try {
    const stream = new Blob([bytes as BlobPart]).stream().pipeThrough(new DecompressionStream(format));
    const reader = stream.getReader();
    for (;;) {
      const { done, value } = await reader.read();
      if (done) break;
      size += value.length;
      if (size > most) {
        await reader.cancel();
        throw damagedFile();
      }
      parts.push(value);
    }
  } catch {
    throw damagedFile();
  }
  const whole = new Uint8Array(size);
  let at = 0;
  for (const part of parts) {
    whole.set(part, at);
    at += part.length;
  }
  return whole;
}
