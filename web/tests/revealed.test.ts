import { expect, test } from 'vitest';
import type { Payload } from '../src/channels/container.ts';
import { channelsOf } from '../src/channels/opening.ts';
import type { ReadModel } from '../src/files/models.ts';
import { secretOf } from '../src/hidden.ts';
import { columns, digest, jsonVector, modelOf, type Revealed } from './vectors.ts';

const REVEALED = jsonVector<Revealed[]>('revealed.json');

/** By the quick search if it opens something: the thorough one takes four times as long. */
async function opened(stego: ReadModel, key: string): Promise<Payload | null> {
  return (await (await channelsOf(stego, false)).open(key)) ?? (await channelsOf(stego, true)).open(key);
}

test.each(REVEALED)('revealing $file with $key matches Python bit for bit', async (expected) => {
  const stego = await modelOf(expected.file);
  const found = (await opened(stego, expected.key))!;
  expect(found.method).toBe(expected.method);
  if (expected.payload) return expect(digest(found.data)).toBe(expected.payload);
  const secret = secretOf(found, stego)!;
  expect([secret.count, columns(secret)]).toEqual([expected.count, expected.sha256]);
});
