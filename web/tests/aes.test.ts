import { createCipheriv } from 'node:crypto';
import { expect, test } from 'vitest';
import { encryptBlocks } from '../src/keys/aes.ts';
import { random } from './vectors.ts';

test('AES-256 of blocks agrees with OpenSSL', () => {
  const draw = random(256);
  for (const blocks of [0, 1, 700]) {
    const [key, plain] = [32, 16 * blocks].map((size) => Uint8Array.from({ length: size }, () => 256 * draw()));
    const cipher = createCipheriv('aes-256-ecb', key, null).setAutoPadding(false);
    const before = plain.slice();
    expect(Buffer.from(encryptBlocks(key, plain))).toEqual(Buffer.concat([cipher.update(plain), cipher.final()]));
    expect(plain).toEqual(before);
  }
});
