/** Bytes put together, compared, read and unpacked. */
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

/** A string that is equal for equal bytes only: a key for maps. */
export function bytesKey(bytes: Uint8Array): string {
  let text = '';
  for (const byte of bytes) text += String.fromCharCode(byte);
  return text;
}

export function viewOf(bytes: Uint8Array): DataView {
  return new DataView(bytes.buffer, bytes.byteOffset, bytes.byteLength);
}

/** What an IEEE 754 half-precision number of these 16 bits is. */
export function halfFloat(bits: number): number {
  const sign = bits & 0x8000 ? -1 : 1;
  const exponent = (bits >> 10) & 31;
  const fraction = bits & 1023;
  if (exponent === 31) return fraction ? NaN : sign * Infinity;
  return sign * (exponent ? 2 ** (exponent - 15) * (1 + fraction / 1024) : (2 ** -14 * fraction) / 1024);
}

/** Rows of a table with `width` numbers in each, in this order. */
export function rowsOf<T extends Uint8Array | Int16Array | Float32Array | Float64Array>(
  table: T, rows: ArrayLike<number>, width: number,
): T {
  const found = new (table.constructor as new (size: number) => T)(rows.length * width);
  for (let to = 0; to < rows.length; to++) found.set(table.subarray(rows[to] * width, (rows[to] + 1) * width), to * width);
  return found;
}

/** 0 of no values. */
export function median(values: Float64Array): number {
  if (!values.length) return 0;
  const sorted = Float64Array.from(values).sort();
  const middle = sorted.length >> 1;
  return sorted.length % 2 ? sorted[middle] : (sorted[middle - 1] + sorted[middle]) / 2;
}

/** The value that occurs most, the first of several, and how often; undefined of none. */
export function mostFrequent<T>(values: Iterable<T>): [T, number] | undefined {
  const votes = new Map<T, number>();
  for (const each of values) votes.set(each, (votes.get(each) ?? 0) + 1);
  return [...votes].reduce<[T, number] | undefined>((best, each) => (best && best[1] >= each[1] ? best : each), undefined);
}

/** What a stream becomes, at most `most` bytes. Raises InputError for more and for damage. */
export async function unpacked(
  bytes: Uint8Array, format: 'gzip' | 'deflate' | 'deflate-raw', most: number,
): Promise<Uint8Array> {
  const found = new Parts(most);
  try {
    const reader = new Blob([bytes as BlobPart]).stream().pipeThrough(new DecompressionStream(format)).getReader();
    for (let { done, value } = await reader.read(); !done; { done, value } = await reader.read()) found.add(value!);
  } catch {
    throw damaged();
  }
  return found.whole();
}

/** Parts of a whole that may have at most `most` bytes. */
class Parts {
  size = 0;
  private readonly parts: Uint8Array[] = [];

  constructor(private readonly most: number) {}

  add(part: Uint8Array): void {
    this.size += part.length;
    if (this.size > this.most) throw damaged();
    this.parts.push(part);
  }

  whole(): Uint8Array {
    return joined(...this.parts);
  }
}
