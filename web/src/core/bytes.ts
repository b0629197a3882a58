/** Bytes put together, compared, read and inflate. */
import { damaged } from './errors.ts';

export function joined(...parts: Uint8Array[]): Uint8Array {
  const whole = new Uint8Array(parts.reduce((size, part) => size + part.length, 0));
  let at = 0;
  for (const part of parts) {
    whole.set(part, at);
    at += part.length;
  }
  return whole;
}

export function ascii(text: string): Uint8Array {
  return new TextEncoder().encode(text);
}

/** A string with a character for each of a few bytes: equal for equal bytes only. */
export function bytesKey(bytes: Uint8Array): string {
  return String.fromCharCode(...bytes);
}

export function viewOf(bytes: Uint8Array): DataView {
  return new DataView(bytes.buffer, bytes.byteOffset, bytes.byteLength);
}

/** The given rows of a table with `width` columns. */
export function rowsOf<T extends Uint8Array | Int16Array | Float32Array | Float64Array>(
  table: T, rows: ArrayLike<number>, width: number,
): T {
  const selection = new (table.constructor as new (size: number) => T)(rows.length * width);
  for (let to = 0; to < rows.length; to++) selection.set(table.subarray(rows[to] * width, (rows[to] + 1) * width), to * width);
  return selection;
}

/** Linearly interpolated quantile; 0 for no values. */
export function quantile(values: ArrayLike<number>, share: number): number {
  if (!values.length) return 0;
  const sorted = Float64Array.from(values).sort();
  const at = share * (sorted.length - 1);
  const [below, above] = [sorted[Math.floor(at)], sorted[Math.ceil(at)]];
  return below + (at - Math.floor(at)) * (above - below);
}

/** [most frequent value, its count], the first in case of ties; undefined for no values. */
export function mostFrequent<T>(values: Iterable<T>): [T, number] | undefined {
  const votes = new Map<T, number>();
  for (const each of values) votes.set(each, (votes.get(each) ?? 0) + 1);
  return [...votes].reduce<[T, number] | undefined>((best, each) => (best && best[1] >= each[1] ? best : each), undefined);
}

/** All bytes of a stream. `received`: called with the number of bytes so far. */
export async function readAll(
  stream: ReadableStream<Uint8Array>, received: (bytes: number) => void = () => undefined,
): Promise<Uint8Array> {
  const [reader, parts] = [stream.getReader(), [] as Uint8Array[]];
  let size = 0;
  for (let { done, value } = await reader.read(); !done; { done, value } = await reader.read()) {
    parts.push(value!);
    received((size += value!.length));
  }
  return joined(...parts);
}

/** Decompresses at most `most` bytes. Raises InputError for more and for damage. */
export async function inflate(
  bytes: Uint8Array, format: 'gzip' | 'deflate' | 'deflate-raw', most: number,
): Promise<Uint8Array> {
  const stream = new Blob([bytes as BlobPart]).stream().pipeThrough(new DecompressionStream(format));
  return readAll(stream, (size) => {
    if (size > most) throw damaged();
  }).catch(() => {
    throw damaged();
  });
}
