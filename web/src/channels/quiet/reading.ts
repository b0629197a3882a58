/**
 * Reads the low bits of a model, or the codes of a file, with a key; counterpart of `keyss.channels.quiet.payloads` and
 * `quiet_header` (docs/byte-layout.md, "Parameters").
 *
 * A wrong key makes the same passes over all cells as a right one, and all salts are always tried, so the time taken
 * reveals next to nothing.
 */
import { ascii, bytesKey, joined, mostFrequent, rowsOf, viewOf } from '../../core/bytes.ts';
import { damaged, otherVersion, tooMuchLost } from '../../core/errors.ts';
import { type Gaussians, selected } from '../../core/gaussians.ts';
import { multiplicities, wordsOf } from '../../core/words.ts';
import type { ReadModel } from '../../files/models.ts';
import { decrypted, type Derive, expand, here } from '../../keys/keys.ts';
import { foreignShare, type Payload, type Reader } from '../base.ts';
import { type Codewords, decoded } from '../reed_solomon.ts';
import { fieldsOf, gaussianIds, ID_BYTES, lowBits, lowWidth, saltOf, salts } from './bits.ts';
import { type Cell, CellCipher, TAG_BYTES } from './cells.ts';
import { BLOCK_BYTES, lastBits, type Levels, levelsOf, modelHash, readBlocks } from './fields.ts';

const ASSOCIATED = ascii('keyss/v1/quiet');
const DATA_KEY_BYTES = 16;
const LEAST_WIDTH = TAG_BYTES + DATA_KEY_BYTES;
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

  /** The payload that `key` opens, or null. Raises InputError for damage. */
  async open(key: string, derive: Derive = here): Promise<Payload | null> {
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
    const none = expand(secret, 'quiet/none').slice(0, DATA_KEY_BYTES); // opens nothing
    for (const dataKey of dataKeys.length ? dataKeys : [none]) {
      const found = this.widths.map((width) => {
        return { width, parts: this.cells(new CellCipher(dataKey, 'parameters', width - TAG_BYTES)) };
      });
      const own = found.find(({ parts }) => parts.length);
      if (own) return this.blocks ? this.inBlocks(dataKey, own.parts) : this.inChunks(dataKey, own.parts, own.width);
    }
    if (!this.blocks) this.cells(chunkCipher(none, this.width));
    return null;
  }

  /** The payload in the chunks of all carriers, `width` bytes each. */
  private async inChunks(dataKey: Uint8Array, parts: Cell[], width: number): Promise<Payload> {
    const { method, size, further } = unpackParameters(parts, CODEWORDS_BYTES + SKETCH_BYTES);
    const [gaussians, codewords] = unpackCodewords(further, chunkBytes(width));
    if (size < 1 || size > codewords.count * codewords.k * codewords.width) throw damaged();
    const chunks = this.cells(chunkCipher(dataKey, width)).map(({ data }): [number, Uint8Array] => [
      data[0] | (data[1] << 8) | (data[2] << 16), data.subarray(NUMBER_BYTES),
    ]);
    const data = await decryptedPayload(dataKey, decoded(codewords, chunks).subarray(0, size));
    const share = foreignShare(dataKey, this.ids, further.subarray(CODEWORDS_BYTES), gaussians);
    return { method, data, foreign: Math.ceil((share * this.ids.length) / ID_BYTES) || undefined };
  }

  /** The payload in the blocks after its parameters. */
  private async inBlocks(dataKey: Uint8Array, parts: Cell[]): Promise<Payload> {
    const { method, size, further } = unpackParameters(parts, BLOCK_SIZE_BYTES);
    const [bytes, blocks] = [viewOf(further).getUint16(0, true), this.low.length / BLOCK_BYTES];
    const count = Math.ceil(size / bytes);
    if (bytes < 1 || bytes > BLOCK_BYTES || count > blocks) throw damaged();
    const [first, encrypted] = [parts[parts.length - 1].row + 1, new Uint8Array(count * bytes)];
    for (let index = 0; index < count; index++) {
      const start = ((first + index) % blocks) * BLOCK_BYTES;
      encrypted.set(this.low.subarray(start, start + bytes), index * bytes);
    }
    return { method, data: await decryptedPayload(dataKey, encrypted.subarray(0, size)) };
  }

  /** The cells with a valid tag, in the order of carriers. */
  private cells(cipher: CellCipher): Cell[] {
    return cipher.decrypt(this.ids, this.low, this.width);
  }
}

/** The cipher of numbered chunks, in carriers of `width` bytes. */
function chunkCipher(dataKey: Uint8Array, width: number): CellCipher {
  return new CellCipher(dataKey, 'chunk', NUMBER_BYTES + chunkBytes(width));
}

/** Bytes of a chunk, a whole number of symbols. */
function chunkBytes(width: number): number {
  return 2 * Math.floor((width - TAG_BYTES - NUMBER_BYTES) / 2);
}

function decryptedPayload(dataKey: Uint8Array, encrypted: Uint8Array): Promise<Uint8Array> {
  return decrypted(expand(dataKey, 'payload-key'), encrypted, ASSOCIATED);
}

/** Rows that differ in ID or low bits. */
function uniqueRows(ids: Uint8Array, low: Uint8Array, width: number): number[] {
  const [count, words] = [ids.length / ID_BYTES, wordsOf(ids)];
  const starts = new Uint32Array(2 * count);
  for (let row = 0; row < count; row++) starts.set(words.subarray(4 * row, 4 * row + 2), 2 * row);
  const repeats = multiplicities(starts);
  const [rows, seen] = [[] as number[], new Set<string>()];
  for (let row = 0; row < count; row++) {
    if (repeats[row] > 1) {
      const id = ids.subarray(row * ID_BYTES, (row + 1) * ID_BYTES);
      const all = bytesKey(id) + bytesKey(low.subarray(row * width, (row + 1) * width));
      if (seen.has(all)) continue;
      seen.add(all);
    }
    rows.push(row);
  }
  return rows;
}

const VERSION = 6;
const [METHOD, SIZE, PREFIX_BYTES] = [1, 16, 20]; // offsets of the method and of the payload's size; of all else
const [CODEWORDS_BYTES, SKETCH_BYTES, BLOCK_SIZE_BYTES] = [12, 32, 2];
const NUMBER_BYTES = 3; // size of a chunk's number
const [MAX_LENGTH, MAX_CODEWORDS] = [1 << 10, 1 << 14]; // chunks of one codeword

/** Parameters of a secret. */
interface Parameters {
  readonly method: string;
  readonly size: number; // bytes of the encrypted payload
  readonly further: Uint8Array; // how it is divided
}

/** Parameters from decrypted parts in any order, with `length` bytes of further ones. Raises InputError. */
function unpackParameters(parts: Cell[], length: number): Parameters {
  const numbered = new Map(parts.map(({ data }) => [data[0], data.subarray(1)]));
  const inOrder: Uint8Array[] = [];
  for (let part = numbered.get(0); part; part = numbered.get(inOrder.length)) inOrder.push(part);
  const packed = joined(...inOrder);
  if (packed.length < PREFIX_BYTES + length) throw tooMuchLost();
  if (packed[0] !== VERSION) throw otherVersion();
  const method = bytesKey(packed.subarray(METHOD, SIZE)).replace(/\0+$/, '');
  const further = packed.subarray(PREFIX_BYTES, PREFIX_BYTES + length);
  return { method, size: viewOf(packed).getUint32(SIZE, true), further };
}

/** Gaussians of the published model, and its codewords of chunks of `width` bytes. Raises InputError. */
function unpackCodewords(packed: Uint8Array, width: number): [number, Codewords] {
  const view = viewOf(packed);
  const [gaussians, count] = [view.getUint32(0, true), view.getUint32(4, true)];
  const [n, k] = [view.getUint16(8, true), view.getUint16(10, true)];
  if (count < 1 || count > MAX_CODEWORDS || k < 1 || k > n || n > MAX_LENGTH) throw damaged();
  return [gaussians, { count, n, k, width }];
}
