import { expect, test } from 'vitest';
import { expand, master } from '../src/keys/keys.ts';
import { hex, jsonVector } from './vectors.ts';

interface Vector {
  key: string;
  salt: string;
  writer?: string;
  verifier?: string;
  'channel/key'?: string;
}

const { valid } = jsonVector<{ valid: Vector[] }>('derivation.json');

test.each(valid)('key derivation matches Python: $key', async (vector) => {
  const secret = await master(vector.key, hex(vector.salt));
  for (const label of ['writer', 'verifier', 'channel/key'] as const) {
    expect(Buffer.from(expand(secret, label)).toString('hex')).toBe(vector[label]);
  }
});

test('surrounding white space of a key is ignored', async () => {
  const [{ key, salt }] = valid as [Vector];
  expect(await master(`\uFEFF ${key}\u3000\n`, hex(salt))).toEqual(await master(key, hex(salt)));
});

test.each(['', ' \n', 'k'.repeat(4097)])('empty and long keys are refused', async (key) => {
  await expect(async () => master(key, new Uint8Array(16))).rejects.toThrow();
});
