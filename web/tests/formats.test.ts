import { expect, test } from 'vitest';
import { readModel } from '../src/files/models.ts';
import { column, plyHeader } from '../src/files/ply.ts';
import { openZip } from '../src/files/packed.ts';
import { columns, jsonVector, modelOf, vector } from './vectors.ts';

const PUBLISHED = jsonVector<Record<string, Record<string, string>>>('published.json');
const HERE = Object.keys(PUBLISHED).filter((name) => !name.endsWith('.sog')); // its images only browsers decode

test.each(HERE)('%s is what Python reads, bit for bit', async (name) => {
  expect(columns(await readModel(vector(name), name))).toEqual(PUBLISHED[name]);
});

test.each(HERE)('%s cut short or garbled ends in one sentence', async (name) => {
  const bytes = vector(name);
  const sentence = /^This [^.]*(\.\w+)?[^.]*\.$/;
  for (const share of [0, 0.01, 0.1, 0.5, 0.9, 0.999]) {
    const odd = Math.floor(share * bytes.length) | 1; // no number of whole rows
    await expect(readModel(bytes.slice(0, odd), name)).rejects.toThrow(sentence);
  }
  for (let seed = 1; seed < 60; seed++) {
    const changed = bytes.slice();
    for (let at = seed; at < Math.min(changed.length, 2000); at += 61) changed[at] ^= (seed * 37) & 255;
    await readModel(changed, name).catch((error: Error) => expect(error.message).toMatch(sentence));
  }
});

test('a .splat is known by its name only', async () => {
  await expect(readModel(vector('published.splat'))).rejects.toThrow(/^This is not a file of a 3D Gaussian Splatting model/);
});

test('a .ply of text is what the binary one is, bit for bit', async () => {
  const bytes = vector('carried.ply');
  const header = plyHeader(bytes);
  const [vertex] = header.elements;
  const values = vertex.properties.map(({ name }) => column(bytes, header, vertex, name)!);
  const rows = Array.from({ length: vertex.count }, (_, row) => values.map((each) => each[row]).join(' ')).join('\r\n');
  const head = new TextDecoder('latin1').decode(bytes.subarray(0, vertex.start)).replace('binary_little_endian', 'ascii');
  const text = (body: string): Uint8Array => new TextEncoder().encode(head + body);
  expect(columns(await readModel(text(rows)))).toEqual(columns(await readModel(bytes)));
  await expect(readModel(text(rows.slice(0, -40)))).rejects.toThrow('This is not a whole .ply file.');
  await expect(readModel(text(rows.replace(/\d/, 'x')))).rejects.toThrow('This file holds numbers that are not finite.');
});

test('the files of an archive', async () => {
  const file = openZip(vector('published.sog'));
  expect(JSON.parse(new TextDecoder().decode(await file('meta.json'))).version).toBe(2);
  await expect(file('nothing')).rejects.toThrow();
});

test('a .sog is what Python reads, bit for bit', async () => {
  expect(columns(await modelOf('published.sog'))).toEqual(PUBLISHED['published.sog']);
});
