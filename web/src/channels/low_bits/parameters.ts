/** How what a key decrypts is to be read; see docs/format.md, "Parameters". */
import { bytesKey, joined, mostFrequent, viewOf } from '../../core/bytes.ts';
import { damaged, otherVersion, tooMuchLost } from '../../core/errors.ts';

const VERSION = 2;
const PREFIX_BYTES = 40;
const NUMBERS = 29; // where the numbers of the service begin
const MOST_CELLS = 4;
const MAX_HEADER_BYTES = 4096;
const MAX_CHUNKS = 255;
const MAX_BLOCKS = Math.floor((1 << 24) / MAX_CHUNKS);

export interface RecordParameters {
  readonly service: 'records';
  readonly method: string;
  readonly cells: number; // of a carrier
  readonly recordBytes: number;
  readonly header: Uint8Array;
}

export interface PayloadParameters {
  readonly service: 'payload';
  readonly method: string;
  readonly size: number; // bytes of the encrypted payload
  readonly codewords: number;
  readonly n: number; // chunks of a codeword
  readonly k: number; // of these data
}

export type Parameters = RecordParameters | PayloadParameters;

/** From decrypted parts in any order; of parts with one number the most frequent counts. Raises InputError. */
export function unpackParameters(parts: Uint8Array[], chunkBytes: number): Parameters {
  const best = new Map<number, Uint8Array>();
  for (const number of new Set(parts.map((part) => part[0]))) {
    best.set(number, mostFrequentOf(parts.filter((part) => part[0] === number))!.subarray(1));
  }
  const prefix = firstBytes(best, PREFIX_BYTES);
  const view = viewOf(prefix);
  if (prefix[0] !== VERSION) throw otherVersion();
  const method = bytesKey(prefix.subarray(2, 17)).replace(/\0+$/, '');
  if (prefix[1] === 1) {
    const [size, codewords] = [view.getUint32(NUMBERS, true), view.getUint32(NUMBERS + 4, true)];
    const [n, k] = [prefix[NUMBERS + 8], prefix[NUMBERS + 9]];
    const possible = codewords >= 1 && codewords <= MAX_BLOCKS && k >= 1 && k <= n && n <= MAX_CHUNKS;
    if (!possible || size < 1 || size > codewords * k * chunkBytes) throw damaged();
    return { service: 'payload', method, size, codewords, n, k };
  }
  const [cells, recordBytes] = [prefix[NUMBERS], view.getUint16(NUMBERS + 1, true)];
  const length = view.getUint16(NUMBERS + 3, true);
  if (prefix[1] !== 2 || cells < 1 || cells > MOST_CELLS || length > MAX_HEADER_BYTES) throw damaged();
  const header = firstBytes(best, PREFIX_BYTES + length).subarray(PREFIX_BYTES);
  return { service: 'records', method, cells, recordBytes, header };
}

/** Of equal byte strings those that occur most; the first of several. */
export function mostFrequentOf(all: Uint8Array[]): Uint8Array | undefined {
  const best = mostFrequent(all.map(bytesKey));
  return best && all.find((each) => bytesKey(each) === best[0]);
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
