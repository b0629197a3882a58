/** Files of tensors (https://github.com/huggingface/safetensors): a JSON header, then numbers. Nothing is executable. */
import { halfFloat, viewOf } from '../core/bytes.ts';
import { damaged } from '../core/errors.ts';

export interface Tensor {
  readonly shape: readonly number[];
  readonly values: Float32Array;
}

export interface Tensors {
  readonly metadata: Record<string, unknown>;
  readonly tensors: ReadonlyMap<string, Tensor>;
}

const SIZES: Record<string, number> = { U8: 1, F16: 2, F32: 4 };

/** Tensors of bytes, half or single precision. Raises InputError for anything else, and for numbers that are not finite. */
export function readTensors(data: Uint8Array): Tensors {
  if (data.length < 8) throw damaged();
  const size = Number(viewOf(data).getBigUint64(0, true));
  if (size > data.length - 8) throw damaged();
  const header = objectOf(parsed(data.subarray(8, 8 + size)));
  const tensors = new Map<string, Tensor>();
  for (const [name, each] of Object.entries(header)) {
    if (name !== '__metadata__') tensors.set(name, tensorOf(objectOf(each), data.subarray(8 + size)));
  }
  return { metadata: objectOf(header.__metadata__), tensors };
}

export function parsed(bytes: Uint8Array): unknown {
  try {
    return JSON.parse(new TextDecoder('utf-8', { fatal: true }).decode(bytes));
  } catch {
    throw damaged();
  }
}

export function objectOf(value: unknown): Record<string, unknown> {
  if (typeof value !== 'object' || value === null || Array.isArray(value)) throw damaged();
  return value as Record<string, unknown>;
}

/** [length] finite numbers, or any number of them. */
export function numbersOf(value: unknown, length?: number): number[] {
  const fine = Array.isArray(value) && value.every((each) => Number.isFinite(each));
  if (!fine || (length !== undefined && value.length !== length)) throw damaged();
  return value as number[];
}

function tensorOf(described: Record<string, unknown>, data: Uint8Array): Tensor {
  const shape = numbersOf(described.shape);
  const [start, end] = numbersOf(described.data_offsets, 2);
  const width = SIZES[String(described.dtype)];
  const count = shape.reduce((product, each) => product * each, 1);
  const fits = width && Number.isInteger(start) && start >= 0 && end <= data.length && end - start === width * count;
  if (!fits || !shape.every((each) => Number.isInteger(each) && each >= 0)) throw damaged();
  const view = viewOf(data.subarray(start, end));
  const read = (at: number): number => (width === 4 ? view.getFloat32(4 * at, true) : halfFloat(view.getUint16(2 * at, true)));
  const values = width === 1 ? Float32Array.from(data.subarray(start, end)) : new Float32Array(count).map((_, at) => read(at));
  if (!values.every(Number.isFinite)) throw damaged();
  return { shape, values };
}
