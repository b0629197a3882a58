import { expect, test } from 'vitest';
import { lsbReader } from '../src/channels/lsb/reading.ts';
import { selected } from '../src/core/gaussians.ts';
import { openPly, readPly, writePly } from '../src/files/ply.ts';
import { decrypted } from '../src/keys/keys.ts';
import { digest, hex, jsonVector, type Revealed, vector } from './vectors.ts';

const REVEALED = jsonVector<Revealed[]>('revealed.json');
const CARRIED = jsonVector<{ key: string; payload: string }>('carried.json');

test('wrong keys open nothing', async () => {
  const reader = (await lsbReader(readPly(openPly(vector('carried.ply')))))!;
  expect(await reader.open('another key')).toBeNull();
});

test('payloads survive pruning of a quarter and any order', async () => {
  const { key, payload } = REVEALED.find((each) => each.file === 'keyss.ply')!;
  const model = readPly(openPly(vector('keyss.ply')));
  const rows = Array.from({ length: model.count }, (_, row) => (row * 701) % model.count);
  const found = await (await lsbReader(selected(model, rows.filter((row) => row % 4))))!.open(key);
  expect(digest(found!.data)).toBe(payload);
});

test('one changed bit costs nothing', async () => {
  const model = readPly(openPly(vector('carried.ply')));
  new Uint32Array(model.sh.buffer)[5 * 48 + 20] ^= 1 << 6;
  expect((await (await lsbReader(model))!.open(CARRIED.key))!.data).toEqual(hex(CARRIED.payload));
});

test('added Gaussians are counted', async () => {
  const model = readPly(openPly(vector('carried.ply')));
  const rows = Array.from({ length: model.count }, (_, row) => row);
  const more = selected(model, [...rows, ...rows]);
  more.means.subarray(3 * model.count).forEach((_, at, own) => (own[at] += 1));
  expect((await (await lsbReader(more))!.open(CARRIED.key))?.foreign).toBeGreaterThan(model.count / 2);
  expect((await (await lsbReader(model))!.open(CARRIED.key))?.foreign).toBeUndefined();
});

test('encrypted payloads match Python', async () => {
  const encryption = jsonVector<{ valid: Record<string, string>; invalid: { why: string; encrypted: string }[] }>('encryption.json');
  const [dataKey, associated] = [hex(encryption.valid.data_key), hex(encryption.valid.associated)];
  for (const each of [encryption.valid.encrypted, encryption.valid.stored]) {
    expect(await decrypted(dataKey, hex(each), associated)).toEqual(hex(encryption.valid.payload));
  }
  for (const { why, encrypted } of encryption.invalid) {
    if (why === 'bytes after the stream') continue; // browsers refuse them, Node 20 does not
    await expect(decrypted(dataKey, hex(encrypted), associated)).rejects.toThrow();
  }
});

test('.ply round trip', () => {
  const bytes = vector('carried.ply');
  expect(writePly(readPly(openPly(bytes)))).toEqual(bytes);
});

test('damaged files raise InputError', () => {
  const bytes = vector('carried.ply');
  for (const end of [0, 3, 60, 900, 2000, bytes.length - 1]) {
    expect(() => readPly(openPly(bytes.subarray(0, end)))).toThrow(/^This .*\.$/);
  }
});
