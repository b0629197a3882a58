import { expect, test } from 'vitest';
import { expand, master } from '../src/keys/derivation.ts';
import { hex, jsonVector } from './vectors.ts';

interface Vector {
  why?: string;
  key: string;
  salt: string;
  time_cost?: number;
  memory_kib?: number;
  parallelism?: number;
  writer?: string;
  verifier?: string;
  'low-bits/key'?: string;
}

const { valid, invalid } = jsonVector<{ valid: Vector[]; invalid: Vector[] }>('derivation.json');

function derived(vector: Vector): Promise<Uint8Array> {
  const { time_cost = 3, memory_kib = 65536, parallelism = 4 } = vector;
  return master(vector.key, hex(vector.salt), { passes: time_cost, memoryKib: memory_kib, lanes: parallelism });
}

test.each(valid)('a key becomes what it becomes in Python: $key', async (vector) => {
  const secret = await derived(vector);
  for (const label of ['writer', 'verifier', 'low-bits/key'] as const) {
    expect(Buffer.from(expand(secret, label, 32)).toString('hex')).toBe(vector[label]);
  }
});

test.each(invalid)('refused: $why', async (vector) => {
  await expect(derived(vector)).rejects.toThrow();
});
