/** A payload as bytes, for channels that carry nothing but these; `keyss.channels.packing` on the other side. */
import { bytesKey } from '../core/bytes.ts';
import { inflated } from '../core/inflate.ts';
import { damaged } from '../keys/encryption.ts';
import type { Payload } from './content.ts';

const METHOD_BYTES = 15;
const MOST_RATIO = 16; // of compression

/** Of whether it is compressed and twice the length of the method's name (1 byte), the name, the data. */
export function unpackPayload(packed: Uint8Array): Payload {
  const first = packed[0] ?? 0;
  const length = first >> 1;
  const [name, data] = [packed.subarray(1, 1 + length), packed.slice(1 + length)];
  if (length < 1 || length > METHOD_BYTES || name.length !== length || name.some((each) => each > 127)) throw damaged();
  const method = bytesKey(name);
  return { service: 'payload', method, data: first & 1 ? inflated(data, MOST_RATIO * data.length) : data };
}
