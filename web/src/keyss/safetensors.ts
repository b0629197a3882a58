/** Files of tensors (https://github.com/huggingface/safetensors): a JSON header, then numbers. Nothing is executable. */
import { halfFloat, viewOf } from '../core/bytes.ts';
import { damaged } from '../core/errors.ts';

const MAX_HEADER_BYTES = 1 << 17;
const SIZES: Record<string, number> = { U8: 1, F16: 2, F32: 4 };

/** Tensors of bytes, half or single precision, which are taken out one by one. */
export class Tensors {
  private constructor(
    readonly metadata: Record<string, unknown>,
    private readonly left: Map<string, unknown>,
    private readonly data: Uint8Array,
  ) {}

  /** Raises InputError for anything else. */
  static of(data: Uint8Array): Tensors {
    if (data.length < 8) throw damaged();
    const size = Number(viewOf(data).getBigUint64(0, true));
    if (size > Math.min(data.length - 8, MAX_HEADER_BYTES)) throw damaged();
    const { __metadata__, ...described } = objectOf(parsed(data.subarray(8, 8 + size)));
    return new Tensors(objectOf(__metadata__), new Map(Object.entries(described)), data.subarray(8 + size));
  }

  /** Whether all have been taken. */
  get done(): boolean {
    return this.left.size === 0;
  }

  /** Raises InputError for no such tensor. */
  shapeOf(name: string): number[] {
    return numbersOf(objectOf(this.left.get(name)).shape);
  }

  /** Raises InputError for no tensor of this shape, and for numbers that are not finite. */
  take(name: string, ...shape: number[]): Float32Array {
    const { dtype, data_offsets } = objectOf(this.left.get(name));
    const [[start, end], width] = [numbersOf(data_offsets, 2), SIZES[String(dtype)]];
    const count = shape.reduce((product, each) => product * each, 1);
    const fits = width && Number.isInteger(start) && start >= 0 && end <= this.data.length && end - start === width * count;
    if (!fits || this.shapeOf(name).join() !== shape.join()) throw damaged();
    this.left.delete(name);
    const bytes = this.data.subarray(start, end);
    if (width === 1) return Float32Array.from(bytes);
    const view = viewOf(bytes);
    const read = (at: number): number => (width === 4 ? view.getFloat32(4 * at, true) : halfFloat(view.getUint16(2 * at, true)));
    const values = new Float32Array(count).map((_, at) => read(at));
    if (!values.every(Number.isFinite)) throw damaged();
    return values;
  }
}

export function parsed(bytes: Uint8Array): unknown {
  try {
    return JSON.parse(new TextDecoder('utf-8', { fatal: true }).decode(bytes));
  } catch {
    throw damaged();
  }
}

/** With these fields in this order, or any. */
export function objectOf(value: unknown, ...fields: string[]): Record<string, unknown> {
  if (typeof value !== 'object' || value === null || Array.isArray(value)) throw damaged();
  if (fields.length && Object.keys(value).join() !== fields.join()) throw damaged();
  return value as Record<string, unknown>;
}

export function integerOf(value: unknown, least: number, most: number): number {
  if (!Number.isInteger(value) || (value as number) < least || (value as number) > most) throw damaged();
  return value as number;
}

/** [length] finite numbers, or any number of them. */
export function numbersOf(value: unknown, length?: number): number[] {
  const fine = Array.isArray(value) && value.every((each) => Number.isFinite(each));
  if (!fine || (length !== undefined && value.length !== length)) throw damaged();
  return value as number[];
}
