import { expect, test } from 'vitest';
import { readModel } from '../src/files/models.ts';
import { openZip } from '../src/files/zip.ts';
import { columns, jsonVector, modelOf, vector } from './vectors.ts';

const PUBLISHED = jsonVector<Record<string, Record<string, string>>>('published.json');
const HERE = Object.keys(PUBLISHED).filter((name) => !name.endsWith('.sog')); // whose images only browsers decode

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

test.each(['published.splat', 'published-1.ksplat'])('%s is known by its name only', async (name) => {
  await expect(readModel(vector(name))).rejects.toThrow(/^This is not a file of a 3D Gaussian Splatting model/);
});

type Entry = Record<string, unknown>;

interface Gltf {
  nodes: Entry[];
  meshes: { primitives: { extensions?: Record<string, Entry> }[] }[];
  accessors: Entry[];
  bufferViews: Entry[];
  buffers: Entry[];
  scenes: Entry[];
}

/** A .glb of these Gaussians with other JSON. */
function withJson(change: (document: Gltf) => void): Uint8Array {
  const bytes = vector('published.glb');
  const size = new DataView(bytes.buffer).getUint32(12, true);
  const document = JSON.parse(new TextDecoder().decode(bytes.subarray(20, 20 + size))) as Gltf;
  change(document);
  const text = new TextEncoder().encode(JSON.stringify(document));
  const found = new Uint8Array(bytes.length - size + text.length);
  found.set(bytes.subarray(0, 20));
  found.set(text, 20);
  found.set(bytes.subarray(20 + size), 20 + text.length);
  new DataView(found.buffer).setUint32(8, found.length, true);
  new DataView(found.buffer).setUint32(12, text.length, true);
  return found;
}

test.each<[string, (document: Gltf) => void]>([
  ['nodes in a circle', ({ nodes }) => (nodes[0].children = [0])],
  ['a node that is not there', ({ nodes }) => (nodes[0].children = [7])],
  ['a mesh that is not there', ({ nodes }) => (nodes[0].mesh = 3)],
  ['uneven scales', ({ nodes }) => (nodes[0].scale = [1, 2, 1])],
  ['a mirror', ({ nodes }) => (nodes[0].scale = [-1, -1, -1])],
  ['no rotation', ({ nodes }) => (nodes[0].rotation = [0, 0, 0, 0])],
  ['no Gaussians', ({ meshes }) => delete meshes[0].primitives[0].extensions],
  ['a buffer view that is not there', ({ accessors }) => (accessors[2].bufferView = 99)],
  ['an accessor before its data', ({ accessors }) => (accessors[0].byteOffset = -4)],
  ['an accessor beyond its data', ({ bufferViews }) => (bufferViews[0].byteOffset = 1e9)],
  ['three numbers for four', ({ accessors }) => (accessors[2].type = 'VEC3')],
  ['different lengths', ({ accessors }) => (accessors[3].count = 3)],
  ['data elsewhere', ({ buffers }) => (buffers[0].uri = 'https://example.org/a.bin')],
  ['the same over and over', (document) => {
    document.nodes = Array.from({ length: 20000 }, () => ({ mesh: 0 }));
    document.scenes[0].nodes = [...document.nodes.keys()];
  }],
  ['no list of nodes', (document) => Object.assign(document, { nodes: 'none' })],
  ['another compression', ({ meshes }) => {
    Object.values(meshes[0].primitives[0].extensions!)[0].extensions = {};
  }],
])('a .glb with %s ends in one sentence', async (_, change) => {
  await expect(readModel(withJson(change))).rejects.toThrow(/^This [^.]*(\.\w+)?[^.]*\.$/);
});

test('the files of an archive', async () => {
  const file = openZip(vector('published.sog'));
  expect(JSON.parse(new TextDecoder().decode(await file('meta.json'))).version).toBe(2);
  await expect(file('nothing')).rejects.toThrow();
});

test('a .sog is what Python reads, bit for bit', async () => {
  expect(columns(await modelOf('published.sog'))).toEqual(PUBLISHED['published.sog']);
});
