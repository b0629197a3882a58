/**
 * Reads the low bits of a model, or the codes of a file, with a key; counterpart of `keyss.channels.quiet.contents` and
 * `layout` (docs/byte-layout.md, "Parameters").
 *
 * A wrong key makes the same passes over all cells as a right one, and all salts are always tried, so the time taken
 * reveals next to nothing.
 */
import { ascii, bytesKey, joined, mostFrequent, rowsOf, viewOf } from '../../core/bytes.ts';
import { damaged, otherVersion, tooMuchLost } from '../../core/errors.ts';
import { type Gaussians, selected } from '../../core/gaussians.ts';
import type { ReadModel } from '../../files/models.ts';
import { decrypted, type Derive, expand, here } from '../../keys/keys.ts';
import { type Content, foreign, type Reader } from '../content.ts';
import { type Codewords, decoded } from '../reed_solomon.ts';
import { fieldsOf, gaussianIds, ID_BYTES, lowBits, lowWidth, saltOf, salts } from './bits.ts';
import { type Cell, CellCipher, TAG_BYTES } from './cells.ts';
import { BLOCK_BYTES, lastBits, type Levels, levelsOf, modelHash, readBlocks } from './fields.ts';

const ASSOCIATED = ascii('keyss/v1/quiet');
const DATA_KEY_BYTES = 16;
const LEAST_WIDTH = TAG_BYTES + DATA_KEY_BYTES;
const DUMMY_CELLS = 2; // cells per carrier that a wrong key decrypts
const NARROW_HARMONICS = 9; // of degree 1: some secrets do not write the others
const [LEAST_BYTES, MIN_BLOCKS] = [48, 4]; // minimum bytes of a block; minimum blocks of a file
const MAX_BITS = 2 ** 30; // bits in codes; more would exceed the memory of a tab

/** The carriers of a model, prepared for any number of keys. */
export class QuietReader implements Reader {
  private constructor(
    private readonly ids: Uint8Array, // [C, 16]
    private readonly low: Uint8Array, // [C, width]
    private readonly width: number,
    private readonly widths: readonly number[], // of parameters
    private readonly salts: readonly Uint8Array[],
    private readonly blocks = false, // the carriers are blocks of codes
  ) {}

  /** The reader of the codes of a coded model, else of low bits; null without capacity. */
  static of(model: ReadModel): QuietReader | null {
    return model.codes ? QuietReader.ofCodes(levelsOf(model.codes)) : QuietReader.ofLowBits(model);
  }

  private static ofLowBits(model: Gaussians): QuietReader | null {
    let fields = fieldsOf(model);
    let [ids, low] = [gaussianIds(model, fields), lowBits(fields)];
    const width = lowWidth(fields);
    if (width < LEAST_WIDTH) return null;
    const rows = uniqueRows(ids, low, width);
    if (rows.length < model.count) {
      fields = fieldsOf(selected(model, rows));
      [ids, low] = [rowsOf(ids, rows, ID_BYTES), rowsOf(low, rows, width)];
    }
    const widths = [...new Set([width, lowWidth(fields, NARROW_HARMONICS)])].filter((each) => each >= LEAST_WIDTH);
    return new QuietReader(ids, low, width, widths, salts(fields, ids, low, width));
  }

  private static ofCodes(levels: Levels): QuietReader | null {
    const bits = lastBits(levels);
    if (bits.length < MIN_BLOCKS * 8 * BLOCK_BYTES || bits.length > MAX_BITS) return null;
    const low = readBlocks(bits);
    const numbers = new Uint32Array((ID_BYTES / 4) * (low.length / BLOCK_BYTES));
    const [ids, hash] = [new Uint8Array(numbers.buffer), modelHash(levels)];
    for (let block = 0; 4 * block < numbers.length; block++) {
      numbers[4 * block] = block;
      ids.set(hash, ID_BYTES * block + 4);
    }
    const salt = saltOf(ids.subarray(0, ID_BYTES), low.subarray(0, LEAST_BYTES));
    const [others, rest] = [ids.subarray(ID_BYTES), low.subarray(BLOCK_BYTES)];
    return new QuietReader(others, rest, BLOCK_BYTES, [LEAST_BYTES], [salt], true);
  }

  get derivations(): number {
    return this.salts.length;
  }

  /** The content that `key` opens, or null. Raises InputError for damage. */
  async open(key: string, derive: Derive = here): Promise<Content | null> {
    const dataKeys: Uint8Array[] = [];
    let secret: Uint8Array = new Uint8Array(32);
    // Other workers derive the next keys while this one reads cells.
    const masters = this.salts.map((salt) => derive(key, salt));
    for (const each of masters) {
      secret = expand(await each, 'quiet/key');
      const cells = this.cells(new CellCipher(secret, 'key', DATA_KEY_BYTES));
      const best = mostFrequent(cells.map(({ data }) => bytesKey(data)));
      if (best) dataKeys.push(cells.find(({ data }) => bytesKey(data) === best[0])!.data);
    }
    for (const dataKey of dataKeys) {
      for (const width of this.widths) {
        const parts = this.parts(dataKey, width);
        if (!parts.length) continue;
        const parameters = unpackParameters(parts.map(({ data }) => data), this.blocks ? 0 : SKETCH_BYTES);
        if (!this.blocks) return this.content(dataKey, parameters, width);
        return this.payload(dataKey, parameters, this.inBlocks(parameters, parts[parts.length - 1].row));
      }
    }
    if (dataKeys.length === 0) {
      const none = expand(secret, 'quiet/none').slice(0, DATA_KEY_BYTES);
      for (const width of this.widths) this.parts(none, width);
      this.dummyPasses(none, this.width);
    }
    return null;
  }

  private dummyPasses(dataKey: Uint8Array, width: number): void {
    const size = Math.floor(width / DUMMY_CELLS) - TAG_BYTES;
    for (const label of ['record', 'copy']) this.cells(new CellCipher(dataKey, label, size), width, DUMMY_CELLS);
  }

  private async content(dataKey: Uint8Array, parameters: Parameters, width: number): Promise<Content> {
    const { isPayload, cells, recordBytes, method, header } = parameters;
    if (recordBytes < 1 || recordBytes > Math.floor(width / cells) - TAG_BYTES) throw damaged();
    const [records, copies] = ['record', 'copy'].map((label) =>
      this.cells(new CellCipher(dataKey, label, recordBytes), width, cells).map(({ data }) => data),
    );
    if (width < this.width) this.dummyPasses(dataKey, this.width - width);
    const foreignCount = foreign(dataKey, this.ids, parameters.sketch, parameters.gaussians) || undefined;
    if (isPayload) {
      const [size, codewords] = unpackCodewords(parameters);
      const chunks = records.map((each): [number, Uint8Array] => [
        each[0] | (each[1] << 8) | (each[2] << 16), each.subarray(NUMBER_BYTES),
      ]);
      const payload = await this.payload(dataKey, parameters, decoded(codewords, chunks).subarray(0, size));
      return { ...payload, foreign: foreignCount };
    }
    const known = new Set(records.map(bytesKey));
    const all = [...records, ...copies.filter((each) => !known.has(bytesKey(each)))];
    if (!all.length) throw tooMuchLost();
    return { service: 'records', method, header, records: all, foreign: foreignCount };
  }

  private async payload(dataKey: Uint8Array, { method }: Parameters, encrypted: Uint8Array): Promise<Content> {
    const data = await decrypted(expand(dataKey, 'payload-key'), encrypted, ASSOCIATED);
    return { service: 'payload', method, data };
  }

  /** The bytes of the blocks after block `row`, which holds the parameters. */
  private inBlocks({ count, recordBytes }: Parameters, row: number): Uint8Array {
    const blocks = this.low.length / BLOCK_BYTES;
    if (count > blocks || recordBytes < 1 || recordBytes > BLOCK_BYTES) throw damaged();
    const rows = Array.from({ length: count }, (_, index) => (row + 1 + index) % blocks);
    const found = new Uint8Array(count * recordBytes);
    rows.forEach((each, at) => found.set(this.low.subarray(each * BLOCK_BYTES, each * BLOCK_BYTES + recordBytes), at * recordBytes));
    return found;
  }

  private parts(dataKey: Uint8Array, width: number): Cell[] {
    return this.cells(new CellCipher(dataKey, 'parameters', width - TAG_BYTES));
  }

  /** The cells with a valid tag, in the order of carriers. */
  private cells(cipher: CellCipher, width = this.width, cells = 1): Cell[] {
    const size = Math.floor(width / cells);
    const slots = Array.from({ length: cells }, (_, slot) => cipher.decrypt(this.ids, this.low, this.width, slot * size, slot));
    return slots.flat().sort((a, b) => a.row - b.row);
  }
}

/** Rows that differ in ID or low bits. */
function uniqueRows(ids: Uint8Array, low: Uint8Array, width: number): number[] {
  const seen = new Set<string>();
  const rows: number[] = [];
  for (let row = 0; row < ids.length / ID_BYTES; row++) {
    const id = ids.subarray(row * ID_BYTES, (row + 1) * ID_BYTES);
    const all = bytesKey(id) + bytesKey(low.subarray(row * width, (row + 1) * width));
    if (!seen.has(all)) rows.push(row);
    seen.add(all);
  }
  return rows;
}

const VERSION = 5;
const PREFIX_BYTES = 30;
const SKETCH_BYTES = 32;
const NUMBERS = 17; // offset of cells, bytes of a record and of the header, Gaussians, records
const MAX_CELLS = 4;
const MAX_HEADER_BYTES = 4096;
const [MAX_LENGTH, MAX_CHUNKS] = [1 << 13, 1 << 24]; // chunks of one codeword, of all
const NUMBER_BYTES = 3; // size of a chunk's number

/** Parameters of a secret: `count` records and copies, `cells` per carrier. */
interface Parameters {
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
function unpackParameters(parts: Uint8Array[], sketched: number): Parameters {
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
function unpackCodewords({ header, recordBytes }: Parameters): [number, Codewords] {
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
