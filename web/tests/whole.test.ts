import { expect, test } from 'vitest';
import { unpackedZstd } from '../src/core/bytes.ts';
import { decodeWhole } from '../src/records/whole.ts';
import { columns, digest, hex, jsonVector } from './vectors.ts';

interface Vectors {
  models: { data: string; sha256: Record<string, string> }[];
  streams: { data: string; size: number; sha256: string }[];
}

const { models, streams } = jsonVector<Vectors>('whole.json');
const DAMAGED = /^[^.]* damaged\.$/;

test.each(models)('a whole model is what Python reads, bit for bit', ({ data, sha256 }) => {
  expect(columns(decodeWhole(hex(data), 0))).toEqual(sha256);
});

test.each(streams)('a zstd stream of $size bytes', ({ data, size, sha256 }) => {
  expect(digest(unpackedZstd(hex(data), size))).toBe(sha256);
  for (const other of [size - 1, size + 1]) expect(() => unpackedZstd(hex(data), other)).toThrow(DAMAGED);
});

test.each(streams)('a damaged stream of $size bytes ends in one sentence or has this size', ({ data, size }) => {
  const bytes = hex(data);
  const step = size < 1 << 20 ? 7 : 41;
  for (let at = 0; at < bytes.length; at += at < bytes.length - 9 ? step : 1) {
    const changed = bytes.slice();
    changed[at] ^= 1 << at % 8;
    try {
      expect(unpackedZstd(changed, size).length).toBe(size);
    } catch (error) {
      expect((error as Error).message).toMatch(DAMAGED);
    }
    expect(() => unpackedZstd(bytes.slice(0, at), size)).toThrow(DAMAGED);
  }
});

test('a few bytes that become many, and a second frame, take no memory', () => {
  const block = [0b011 | 0xf8, 0xff, 0xff, 7]; // 2 MiB of one byte, and more blocks after it
  const many = Uint8Array.from(Array.from({ length: 10_000 }, () => block).flat());
  const second = [1, 0, 0, 0x28, 0xb5, 0x2f, 0xfd, 0, 0xa8, 1, 0, 0]; // with a window of 2 GiB
  const before = process.memoryUsage().arrayBuffers;
  for (const stream of [many, Uint8Array.from(second)]) {
    expect(() => unpackedZstd(stream, 0)).toThrow(DAMAGED);
    expect(process.memoryUsage().arrayBuffers - before).toBeLessThan(16 << 20);
  }
});

test.each(models)('a damaged model ends in one sentence or is one', ({ data }) => {
  const bytes = hex(data);
  for (let end = 0; end < bytes.length; end += end < 130 ? 1 : 37) {
    expect(() => decodeWhole(bytes.slice(0, end), 0)).toThrow(DAMAGED);
  }
  expect(() => decodeWhole(Uint8Array.of(...bytes, 0), 0)).toThrow(DAMAGED);
  for (let at = 0; at < bytes.length; at++) {
    const changed = bytes.slice();
    changed[at] ^= 1 << at % 8;
    expectModelOrSentence(() => decodeWhole(changed, 0));
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

test.each([[1 << 22, 0], [1 << 22, 1 << 20], [(1 << 16) + 1, 1 << 16], [0xffffffff, 0xffffffff]])(
  'a model of %i Gaussians in one of %i takes no memory', (count, carriers) => {
    const empty = Array.from({ length: 1 << 20 }, () => [0, 0, 0]).flat(); // blocks that hold nothing
    const data = Uint8Array.of(...hex(models[0].data).subarray(0, 101));
    const bytes = new Uint8Array(data.length + empty.length);
    bytes.set(data);
    new DataView(bytes.buffer).setUint32(0, count, true);
    const before = process.memoryUsage().arrayBuffers;
    expect(() => decodeWhole(bytes, carriers)).toThrow(DAMAGED);
    expect(process.memoryUsage().arrayBuffers - before).toBeLessThan(1 << 20);
  },
);
