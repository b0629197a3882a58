/** Payloads as bytes; `keyss.channels.payloads` on the other side. */
import { bytesKey } from '../core/bytes.ts';
import { damaged } from '../core/errors.ts';
import type { Payload } from './content.ts';

const METHOD_BYTES = 15;

/** Of the method's name, a zero, the data. */
export function unpackPayload(packed: Uint8Array): Payload {
  const length = packed.indexOf(0);
  const name = packed.subarray(0, length);
  if (length < 1 || length > METHOD_BYTES || name.some((each) => each > 127)) throw damaged();
  return { service: 'payload', method: bytesKey(name), data: packed.slice(length + 1) };
}
