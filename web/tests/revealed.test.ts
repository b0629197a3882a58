import { expect, test } from 'vitest';
import type { Payload } from '../src/channels/container.ts';
import { channelsOf } from '../src/channels/opening.ts';
import type { ReadModel } from '../src/files/models.ts';
import { secretOf } from '../src/hidden.ts';
import { columns, digest, jsonVector, modelOf, type Revealed } from './vectors.ts';

const REVEALED = jsonVector<Revealed[]>('revealed.json');

/** In the first channel in which it opens something: to look into all of them would take ten times as long. */
async function opened(stego: ReadModel, key: string): Promise<Payload | null> {
  for (const thorough of [false, true]) {
    for (const reader of (await channelsOf(stego, thorough)).readers) {
      const payload = await reader.open(key);
      if (payload !== null) return payload;
    }
  }
  return null;
}

test.each(REVEALED)('revealing $file with $key matches Python bit for bit', async (expected) => {
  const stego = await modelOf(expected.file);
  const found = (await opened(stego, expected.key))!;
  expect(found.method).toBe(expected.method);
  if (expected.payload) return expect(digest(found.data)).toBe(expected.payload);
  const secret = secretOf(found, stego)!;
  expect([secret.count, columns(secret)]).toEqual([expected.count, expected.sha256]);
});
