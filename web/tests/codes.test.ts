import { expect, test } from 'vitest';
import { decodedLevels } from '../src/channels/lsb/decoded.ts';
import { lastBits, levelsOf, log2 } from '../src/channels/lsb/fields.ts';
import { lsbReader } from '../src/channels/lsb/reading.ts';
import { sortingOrder } from '../src/core/words.ts';
import { digest, jsonVector, modelOf } from './vectors.ts';

interface Counted {
  bits: Record<string, { count: number; sha256: string }>;
  log2: Record<string, number>;
}

const COUNTED = jsonVector<Counted>('counted.json');
const FILES = ['coded.spz', 'coded.sog', 'coded.compressed.ply', 'decoded-spz.ply', 'decoded-sog.ply', 'decoded-compressed.ply'];

test.each(Object.entries(COUNTED.bits))('carrying bits of %s match Python', async (name, { count, sha256 }) => {
  const model = await modelOf(name);
  const bits = lastBits(model.codes ? levelsOf(model.codes) : decodedLevels(model)!);
  expect([bits.length, digest(bits)]).toEqual([count, sha256]);
});

test.each(Object.entries(COUNTED.log2))('approximate logarithm of %s', (value, expected) => {
  expect(log2(Number(value))).toBe(expected);
});

test('logarithm of NaN', () => {
  expect([log2(Infinity), log2(NaN)]).toEqual([Infinity, NaN]);
});

test('stable sort, last column most significant', () => {
  const words = Uint32Array.of(5, 1, 2 ** 32 - 1, 0, 0, 2 ** 31, 5, 1, 65536, 1);
  expect([...sortingOrder(words)]).toEqual([1, 0, 3, 4, 2]);
});

test.each(FILES)('wrong keys open nothing in %s with as many derivations', async (name) => {
  const salts: string[] = [];
  const derive = async (_: string, salt: Uint8Array): Promise<Uint8Array> => {
    salts.push(digest(salt));
    return new Uint8Array(32).fill(7);
  };
  expect(await (await lsbReader(await modelOf(name)))!.open('any', derive)).toBeNull();
  expect(salts.length).toBe(1);
});

test.each(['carried.ply', 'appended.ply', 'published.splat'])('%s was not decoded from quantised values', async (name) => {
  expect(decodedLevels(await modelOf(name))).toBeNull();
});

test('codes without capacity have no reader', async () => {
  expect(await lsbReader(await modelOf('published-2.spz'))).toBeNull();
});
