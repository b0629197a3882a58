/** The frozen vectors that Python's tests use too. */
import { createHash } from 'node:crypto';
import { readFileSync } from 'node:fs';
import { WebPCodec } from '@playcanvas/splat-transform';
import type { Gaussians } from '../src/core/gaussians.ts';
import { mixed } from '../src/core/words.ts';
import { readModel, type ReadModel } from '../src/files/models.ts';

const FOLDER = new URL('../../tests/vectors/', import.meta.url);

export function vector(name: string): Uint8Array {
  return new Uint8Array(readFileSync(new URL(name, FOLDER)));
}

export function jsonVector<T>(name: string): T {
  return JSON.parse(new TextDecoder().decode(vector(name))) as T;
}

/** Lossless WebP by another program's decoder: those of browsers are not here. */
export async function decodeWebP(webp: Uint8Array): Promise<Uint8Array> {
  return (await WebPCodec.create()).decodeRGBA(webp).rgba;
}

export function modelOf(name: string): Promise<ReadModel> {
  return readModel(vector(name), name, decodeWebP);
}

export function digest(values: Float32Array | Uint8Array): string {
  return createHash('sha256').update(new Uint8Array(values.buffer, values.byteOffset, values.byteLength)).digest('hex');
}

/** SHA-256 of the float32 columns, by the names that they have in Python. */
export function columns({ means, quats, logScales, opacityLogits, sh }: Gaussians): Record<string, string> {
  const found = { means, quats, log_scales: logScales, opacity_logits: opacityLogits, sh };
  return Object.fromEntries(Object.entries(found).map(([name, values]) => [name, digest(values)]));
}

/** What Python reveals: a number of Gaussians with the SHA-256 of columns, or the SHA-256 of a payload. */
export interface Revealed {
  readonly file: string;
  readonly key: string;
  readonly method: string;
  readonly count?: number;
  readonly sha256?: Record<string, string>;
  readonly payload?: string;
}

export function hex(text: string): Uint8Array {
  return new Uint8Array(Buffer.from(text, 'hex'));
}

/** Numbers in [0, 1) that are the same every time. */
export function random(seed: number): () => number {
  const state = new Uint32Array(2);
  return () => {
    [state[0], state[1]] = [++seed, 99];
    return mixed(state)[1] / 2 ** 32;
  };
}
