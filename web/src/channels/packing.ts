/** Payloads as bytes, for channels that carry nothing else; `keyss.channels.packing` on the other side. */
import { bytesKey } from '../core/bytes.ts';
import { damaged } from '../core/errors.ts';
import { unpacked } from '../core/unpacking.ts';
import type { Payload } from './content.ts';

export const METHOD_BYTES = 15;
const MOST_RATIO = 16; // of compression

/** 15 bytes with the method's name, the data. */
export function unframedPayload(framed: Uint8Array): Payload {
  if (framed.length < METHOD_BYTES) throw damaged();
  const method = bytesKey(framed.subarray(0, METHOD_BYTES)).replace(/\0+$/, '');
  return { service: 'payload', method, data: framed.slice(METHOD_BYTES) };
}

/** Of whether it is compressed and twice the length of the method's name (1 byte), the name, the data. */
export async function unpackPayload(packed: Uint8Array): Promise<Payload> {
  const first = packed[0] ?? 0;
  const length = first >> 1;
  const [name, data] = [packed.subarray(1, 1 + length), packed.slice(1 + length)];
  if (length < 1 || length > METHOD_BYTES || name.length !== length || name.some((each) => each > 127)) throw damaged();
  const method = bytesKey(name);
  const whole = first & 1 ? await unpacked(data, 'deflate', MOST_RATIO * data.length) : data;
  return { service: 'payload', method, data: whole };
}
