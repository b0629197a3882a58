import { expect, test } from 'vitest';
import type { Content } from '../src/channels/content.ts';
import { preparedFor } from '../src/channels/opening.ts';
import type { ReadModel } from '../src/files/models.ts';
import { secretOf } from '../src/records/secret.ts';
import { columns, digest, jsonVector, modelOf } from './vectors.ts';

interface Revealed {
  file: string;
  key: string;
  method: string;
  count?: number;
  hidden?: number;
  opacity_logits?: number[];
  sha256?: Record<string, string>;
  payload?: string;
}

const REVEALED = jsonVector<Revealed[]>('revealed.json');

/** In the first channel in which it opens something: to look into all of them would take ten times as long. */
async function opened(stego: ReadModel, key: string): Promise<Content | null> {
  for (const reader of preparedFor(stego)(true).readers) {
    const content = await reader.open(key);
    if (content !== null) return content;
  }
  return null;
}

test.each(REVEALED)('$file gives $key what Python reveals, bit for bit', async (expected) => {
  const stego = await modelOf(expected.file);
  const content = await opened(stego, expected.key);
  expect(content?.method).toBe(expected.method);
  if (expected.payload) {
    expect(content!.service === 'payload' && digest(content!.data)).toBe(expected.payload);
    return;
  }
  const secret = secretOf(content!, stego)!;
  expect([secret.gaussians.count, secret.hidden]).toEqual([expected.count, expected.hidden]);
  const found = columns(secret.gaussians);
  if (expected.opacity_logits) {
    // Of Gaussians that make up for lost ones: by single precision, in which processors differ.
    delete found.opacity_logits;
    secret.gaussians.opacityLogits.forEach((value, row) => {
      expect(value).toBeCloseTo(expected.opacity_logits![row], 4);
    });
  }
  expect(found).toEqual(expected.sha256);
});
