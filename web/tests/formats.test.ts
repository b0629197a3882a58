import { expect, test } from 'vitest';
import { selected } from '../src/core/gaussians.ts';
import { readModel } from '../src/files/models.ts';
import { joined } from '../src/core/bytes.ts';
import { openPly } from '../src/files/ply.ts';
import { unzipped } from '../src/files/sog.ts';
import { columns, jsonVector, modelOf, vector } from './vectors.ts';

const PUBLISHED = jsonVector<Record<string, Record<string, string>>>('published.json');
const HERE = Object.keys(PUBLISHED).filter((name) => !name.endsWith('.sog')); // its images only browsers decode

test.each(HERE)('%s matches Python bit for bit', async (name) => {
  expect(columns(await readModel(vector(name), name))).toEqual(PUBLISHED[name]);
});

test.each(HERE)('damaged %s raises InputError', async (name) => {
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

test('.splat is identified by its suffix', async () => {
  await expect(readModel(vector('published.splat'))).rejects.toThrow(/^This is not a file of a 3D Gaussian Splatting model/);
});

test('a .ply in text is refused with advice', async () => {
  const text = new TextDecoder('latin1').decode(vector('carried.ply')).replace('binary_little_endian', 'ascii');
  await expect(readModel(new TextEncoder().encode(text))).rejects.toThrow(/^This .ply file is text: keyss view converts it\.$/);
});

/** `file` with one number of one row of each of these properties replaced. */
function withNumbers(file: Uint8Array, row: number, numbers: Record<string, number>): Uint8Array {
  const [bytes, [vertex]] = [file.slice(), openPly(file).elements];
  for (const [name, value] of Object.entries(numbers)) {
    const { offset } = vertex.properties.find((each) => each.name === name)!;
    new DataView(bytes.buffer).setFloat32(vertex.start + row * vertex.stride + offset, value, true);
  }
  return bytes;
}

test('non-finite Gaussians of a .ply are dropped', async () => {
  const whole = await readModel(vector('carried.ply'));
  let bytes = vector('carried.ply');
  for (const [row, name] of ['x', 'f_dc_1', 'f_rest_44', 'opacity', 'scale_2', 'rot_3'].entries()) {
    bytes = withNumbers(bytes, 3 * row, { [name]: name === 'rot_3' ? -Infinity : NaN });
  }
  const found = await readModel(bytes);
  expect(found.count).toBe(whole.count - 6);
  const rows = [...Array(whole.count).keys()].filter((row) => row > 15 || row % 3);
  expect(columns(found)).toEqual(columns(selected(whole, rows)));
});

test('infinite log scales and opacity logits are clamped', async () => {
  const flat = withNumbers(vector('carried.ply'), 1, { scale_0: -Infinity, opacity: Infinity });
  const found = await readModel(withNumbers(flat, 2, { opacity: -Infinity }));
  expect(Math.exp(found.logScales[3])).toBeCloseTo(2 ** -126, 42);
  expect([...found.opacityLogits.subarray(1, 3)]).toEqual([16, -16]);
});

test('files without drawable Gaussians are refused with advice', async () => {
  const bytes = vector('carried.ply');
  const [vertex] = openPly(bytes).elements;
  const header = new TextDecoder('latin1').decode(bytes.subarray(0, vertex.start));
  const empty = new TextEncoder().encode(header.replace(/element vertex \d+/, 'element vertex 0'));
  await expect(readModel(empty)).rejects.toThrow(/^This file holds no Gaussians: export it again/);
  const nan = { x: NaN };
  const none = Array.from({ length: vertex.count }).reduce<Uint8Array>((file, _, row) => withNumbers(file, row, nan), bytes);
  await expect(readModel(none)).rejects.toThrow(/^This file holds numbers that are not finite: export it again/);
});

test('archives with too many members or false sizes are refused', async () => {
  const bytes = vector('published.sog');
  const view = new DataView(bytes.buffer.slice(bytes.byteOffset, bytes.byteOffset + bytes.length));
  const [end, size] = [bytes.length - 22, view.getUint32(bytes.length - 10, true)];
  const directory = view.getUint32(end + 16, true);
  const entry = bytes.slice(directory, directory + 46 + view.getUint16(directory + 28, true));
  expect(size).toBe(end - directory);
  const changed = (...entries: Uint8Array[]): Uint8Array => {
    const tail = bytes.slice(end);
    for (const at of [8, 10]) new DataView(tail.buffer).setUint16(at, view.getUint16(end + at, true) + entries.length, true);
    return joined(bytes.slice(0, end), ...entries, tail);
  };
  const named = (letter: string, claimed: number, at: number): Uint8Array => {
    const again = entry.slice();
    again[46] = letter.charCodeAt(0);
    new DataView(again.buffer).setUint32(24, claimed, true);
    new DataView(again.buffer).setUint32(42, at, true);
    return again;
  };
  const member = named('x', 100, directory);
  expect(unzipped(changed(member)).size).toBe(unzipped(bytes).size + 1);
  expect(() => unzipped(changed(...new Array<Uint8Array>(64).fill(member)))).toThrow('This file is damaged');
  expect(() => unzipped(changed(named('x', 0xfffffffe, directory)))).toThrow('This file is damaged');
  expect(() => unzipped(changed(named('x', 2 * bytes.length + (1 << 20), directory)))).toThrow('This file is damaged');
});

test('rows without properties allocate nothing', async () => {
  const header = 'ply\nformat binary_little_endian 1.0\nelement vertex 999999999\nend_header\n';
  await expect(readModel(new TextEncoder().encode(header))).rejects.toThrow('is not a 3D Gaussian Splatting model');
});

test('.sog matches Python bit for bit', async () => {
  expect(columns(await modelOf('published.sog'))).toEqual(PUBLISHED['published.sog']);
});
