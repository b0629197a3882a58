import { expect, test } from 'vitest';
import { unpackedLzma2 } from '../src/core/lzma.ts';
import { decodeWhole } from '../src/records/whole.ts';
import { columns, digest, hex, jsonVector } from './vectors.ts';

interface Vectors {
  models: { data: string; sha256: Record<string, string> }[];
  streams: { data: string; size: number; sha256: string; flipped: Record<string, string | null> }[];
}

const { models, streams } = jsonVector<Vectors>('whole.json');
const DAMAGED = /^[^.]* damaged\.$/;

test.each(models)('a whole model is what Python reads, bit for bit', ({ data, sha256 }) => {
  expect(columns(decodeWhole(hex(data)))).toEqual(sha256);
});

test.each(streams)('a raw LZMA2 stream of $size bytes', ({ data, size, sha256 }) => {
  expect(digest(unpackedLzma2(hex(data), size))).toBe(sha256);
  for (const other of [size - 1, size + 1]) expect(() => unpackedLzma2(hex(data), other)).toThrow(DAMAGED);
});

test.each(streams)('a stream of $size bytes with one bit flipped', ({ data, size, flipped }) => {
  for (const [bit, expected] of Object.entries(flipped)) {
    const bytes = hex(data);
    bytes[Number(bit) >> 3] ^= 1 << (Number(bit) & 7);
    let found: string | null = null;
    try {
      found = digest(unpackedLzma2(bytes, size));
    } catch (error) {
      expect((error as Error).message).toMatch(DAMAGED);
    }
    expect([bit, found]).toEqual([bit, expected]);
  }
});

test.each(models)('a damaged model ends in one sentence or is one', ({ data }) => {
  const bytes = hex(data);
  for (let end = 0; end < bytes.length; end += end < 130 ? 1 : 37) {
    expect(() => decodeWhole(bytes.slice(0, end))).toThrow(DAMAGED);
  }
  expect(() => decodeWhole(Uint8Array.of(...bytes, 0))).toThrow(DAMAGED);
  for (let at = 0; at < bytes.length; at++) {
    const changed = bytes.slice();
    changed[at] ^= 1 << at % 8;
    expectModelOrSentence(() => decodeWhole(changed));
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

test('a model that announces more than its data hold takes no memory', () => {
  const bytes = hex(models[0].data);
  new DataView(bytes.buffer).setUint32(0, 1 << 22, true);
  const before = process.memoryUsage().arrayBuffers;
  expect(() => decodeWhole(bytes)).toThrow(DAMAGED);
  expect(process.memoryUsage().arrayBuffers - before).toBeLessThan(1 << 20);
});
