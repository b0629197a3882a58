/** Bytes that come out whole or not at all: from chunks to what was encrypted; see docs/format.md, "A payload". */
import { ascii } from '../../core/bytes.ts';
import { expand } from '../../keys/derivation.ts';
import { decrypted } from '../../keys/encryption.ts';
import { type PayloadParameters, tooMuchRemoved } from './parameters.ts';
import { decodeCodeword } from '../reed_solomon.ts';

const ASSOCIATED = ascii('keyss/v1/low-bits');

/** What lies in numbered chunks in any order. Raises InputError. */
export function decodePayload(
  dataKey: Uint8Array, parameters: PayloadParameters, chunks: Uint8Array[], chunkBytes: number,
): Uint8Array {
  const { codewords, n, k, size } = parameters;
  if (codewords * k > chunks.length) throw tooMuchRemoved();
  const rows = Array.from({ length: codewords }, () => new Map<number, Uint8Array>());
  for (const chunk of chunks) {
    const number = chunk[0] | (chunk[1] << 8) | (chunk[2] << 16);
    if (number < codewords * n) rows[Math.floor(number / n)].set(number % n, chunk.subarray(3));
  }
  const encrypted = new Uint8Array(codewords * k * chunkBytes);
  rows.forEach((each, codeword) => {
    const data = decodeCodeword(each, k, n);
    if (data === null) throw tooMuchRemoved();
    data.forEach((row, index) => encrypted.set(row, (codeword * k + index) * chunkBytes));
  });
  return decrypted(expand(dataKey, 'payload-key', 32), encrypted.subarray(0, size), ASSOCIATED);
}
