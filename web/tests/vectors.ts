/** The frozen vectors that Python's tests use too. */
import { createHash } from 'node:crypto';
import { readFileSync } from 'node:fs';

const FOLDER = new URL('../../tests/vectors/', import.meta.url);

export function vector(name: string): Uint8Array {
  return new Uint8Array(readFileSync(new URL(name, FOLDER)));
}

export function jsonVector<T>(name: string): T {
  return JSON.parse(new TextDecoder().decode(vector(name))) as T;
}

export function digest(values: Float32Array | Uint8Array): string {
  return createHash('sha256').update(new Uint8Array(values.buffer, values.byteOffset, values.byteLength)).digest('hex');
}

export function hex(text: string): Uint8Array {
  return new Uint8Array(Buffer.from(text, 'hex'));
}
