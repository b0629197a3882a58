import { expect, test } from 'vitest';
import type { Content } from '../src/channels/content.ts';
import { preparedFor } from '../src/channels/opening.ts';
import type { ReadModel } from '../src/files/models.ts';
import { secretOf } from '../src/records/reveal.ts';
import { digest, expectRevealed, jsonVector, modelOf, type Shown } from './vectors.ts';

interface Revealed extends Shown {
  file: string;
  key: string;
  method: string;
  payload?: string;
}

// Secrets in the codes of a decoded .ply need `keyss reveal`.
const REVEALED = jsonVector<Revealed[]>('revealed.json').filter(({ file }) => !file.startsWith('decoded-'));

/** In the first channel in which it opens something: to look into all of them would take ten times as long. */
async function opened(stego: ReadModel, key: string): Promise<Content | null> {
  const channels = preparedFor(stego);
  for (const reader of [...channels(false).readers, ...channels(true).readers]) {
    const content = await reader.open(key);
    if (content !== null) return content;
  }
  return null;
}

test.each(REVEALED)('revealing $file with $key matches Python bit for bit', async (expected) => {
  const stego = await modelOf(expected.file);
  const content = await opened(stego, expected.key);
  expect(content?.method).toBe(expected.method);
  if (expected.payload) {
    expect(content!.service === 'payload' && digest(content!.data)).toBe(expected.payload);
    return;
  }
  expectRevealed(secretOf(content!, stego)!, expected);
});
