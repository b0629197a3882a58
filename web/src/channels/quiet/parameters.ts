/** Parameters for reading a secret; see docs/byte-layout.md, "Parameters". */
import { bytesKey, joined, viewOf } from '../../core/bytes.ts';
import { damaged, otherVersion, tooMuchLost } from '../../core/errors.ts';
import type { Codewords } from '../reed_solomon.ts';

const VERSION = 5;
const PREFIX_BYTES = 30;
export const SKETCH_BYTES = 32;
const NUMBERS = 17; // offset of cells, bytes of a record and of the header, Gaussians, records
const MAX_CELLS = 4;
const MAX_HEADER_BYTES = 4096;
const [MAX_LENGTH, MAX_CHUNKS] = [1 << 13, 1 << 24]; // chunks of one codeword, of all
export const NUMBER_BYTES = 3; // size of a chunk's number

/** Parameters of a secret: `count` records and copies, `cells` per carrier. */
export interface Parameters {
  readonly isPayload: boolean; // records are numbered chunks of a payload
  readonly method: string;
  readonly cells: number;
  readonly recordBytes: number;
  readonly gaussians: number; // size of the published model
  readonly count: number;
  readonly header: Uint8Array;
  readonly sketch: Uint8Array; // empty in blocks
}

/** Parameters from decrypted parts in any order; `sketched`: bytes of the sketch. Raises InputError. */
export function unpackParameters(parts: Uint8Array[], sketched: number): Parameters {
  const numbered = new Map(parts.map((part) => [part[0], part.subarray(1)]));
  const prefix = firstBytes(numbered, PREFIX_BYTES);
  const [version, service] = prefix;
  if (version !== VERSION) throw otherVersion();
  const [cells, view] = [prefix[NUMBERS], viewOf(prefix)];
  const [recordBytes, length] = [view.getUint16(NUMBERS + 1, true), view.getUint16(NUMBERS + 3, true)];
  const [gaussians, count] = [view.getUint32(NUMBERS + 5, true), view.getUint32(NUMBERS + 9, true)];
  if (service < 1 || service > 2 || cells < 1 || cells > MAX_CELLS || length > MAX_HEADER_BYTES) throw damaged();
  const method = bytesKey(prefix.subarray(2, NUMBERS)).replace(/\0+$/, '');
  const rest = firstBytes(numbered, PREFIX_BYTES + sketched + length).subarray(PREFIX_BYTES);
  const [sketch, header] = [rest.subarray(0, sketched), rest.subarray(sketched)];
  return { isPayload: service === 1, method, cells, recordBytes, gaussians, count, header, sketch };
}

/** Bytes of the encrypted payload, and its codewords, from the header of a payload. Raises InputError. */
export function unpackCodewords({ header, recordBytes }: Parameters): [number, Codewords] {
  if (header.length !== 12) throw damaged();
  const view = viewOf(header);
  const [size, count] = [view.getUint32(0, true), view.getUint32(4, true)];
  const [n, k, width] = [view.getUint16(8, true), view.getUint16(10, true), recordBytes - NUMBER_BYTES];
  const possible = count >= 1 && count * n <= MAX_CHUNKS && k >= 1 && k <= n && n <= MAX_LENGTH && width % 2 === 0;
  if (!possible || size < 1 || size > count * k * width) throw damaged();
  return [size, { count, n, k, width }];
}

function firstBytes(parts: Map<number, Uint8Array>, length: number): Uint8Array {
  let data = new Uint8Array(0);
  for (let number = 0; data.length < length; number++) {
    const part = parts.get(number);
    if (part === undefined) throw tooMuchLost();
    data = joined(data, part) as Uint8Array<ArrayBuffer>;
  }
  return data.slice(0, length);
}
