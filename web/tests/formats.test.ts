import { expect, test } from 'vitest';
import { readModel } from '../src/files/models.ts';
import { openZip } from '../src/files/zip.ts';
import { columns, jsonVector, modelOf, vector } from './vectors.ts';

const PUBLISHED = jsonVector<Record<string, Record<string, string>>>('published.json');
const HERE = Object.keys(PUBLISHED).filter((name) => !name.endsWith('.sog')); // whose images only browsers decode

test.each(HERE)('%s is what Python reads, bit for bit', async (name) => {
  expect(columns(await readModel(vector(name)))).toEqual(PUBLISHED[name]);
});

test.each(HERE)('%s cut short or garbled ends in one sentence', async (name) => {
  const bytes = vector(name);
  const sentence = /^This [^.]*(\.ply)?[^.]*\.$/;
  for (const share of [0, 0.01, 0.1, 0.5, 0.9, 0.999]) {
    await expect(readModel(bytes.slice(0, Math.floor(share * bytes.length)))).rejects.toThrow(sentence);
  }
  for (let seed = 1; seed < 60; seed++) {
    const changed = bytes.slice();
    for (let at = seed; at < Math.min(changed.length, 2000); at += 61) changed[at] ^= (seed * 37) & 255;
    await readModel(changed).catch((error: Error) => expect(error.message).toMatch(sentence));
  }
});

test('the files of an archive', async () => {
  const file = openZip(vector('published.sog'));
  expect(JSON.parse(new TextDecoder().decode(await file('meta.json'))).version).toBe(2);
  await expect(file('nothing')).rejects.toThrow();
});

test('a .sog is what Python reads, bit for bit', async () => {
  expect(columns(await modelOf('published.sog'))).toEqual(PUBLISHED['published.sog']);
});
