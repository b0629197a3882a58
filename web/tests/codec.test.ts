import { expect, test } from 'vitest';
import { decodeModel } from '../src/codec/model_bytes.ts';
import { columns, hex, jsonVector } from './vectors.ts';

const models = jsonVector<{ data: string; sha256: Record<string, string> }[]>('encoded.json');
const DAMAGED = /^[^.]* damaged: download or copy it again\.$/;

test.each(models)('models match Python bit for bit', ({ data, sha256 }) => {
  expect(columns(decodeModel(hex(data), 0))).toEqual(sha256);
});

test.each(models.slice(0, -1))('damaged models raise InputError or decode', ({ data }) => {
  const bytes = hex(data);
  for (let end = 0; end < bytes.length; end += end < 130 ? 1 : 37) {
    expect(() => decodeModel(bytes.slice(0, end), 0)).toThrow(DAMAGED);
  }
  expect(() => decodeModel(Uint8Array.of(...bytes, 0), 0)).toThrow(DAMAGED);
  for (let at = 0; at < bytes.length; at++) {
    const changed = bytes.slice();
    changed[at] ^= 1 << at % 8;
    expectModelOrSentence(() => decodeModel(changed, 0));
  }
});

function expectModelOrSentence(decode: () => { means: Float32Array }): void {
  let means: Float32Array;
  try {
    ({ means } = decode());
  } catch (error) {
    expect((error as Error).message).toMatch(DAMAGED);
    return;
  }
  expect(means.every(Number.isFinite)).toBe(true);
}

test.each([[1 << 22, 0], [1 << 22, 1 << 20], [(1 << 19) + 1, 1 << 16], [0xffffffff, 0xffffffff]])(
  'false counts of %i Gaussians in a model of %i allocate nothing', (count, carriers) => {
    const bytes = new Uint8Array(3 << 20);
    bytes.set(hex(models[0].data).subarray(0, 53));
    new DataView(bytes.buffer).setUint32(0, count, true);
    const before = process.memoryUsage().arrayBuffers;
    expect(() => decodeModel(bytes, carriers)).toThrow(DAMAGED);
    expect(process.memoryUsage().arrayBuffers - before).toBeLessThan(1 << 20);
  },
);
