/**
 * Reads the low bits of a model, or the codes of a file, with a key; counterpart of `keyss.channels.lsb.payloads`,
 * `lsb_header` and `blocks` (docs/byte-layout.md).
 *
 * A wrong key makes the same passes over all Gaussians as a right one, and all salts are always tried, so the time taken
 * reveals next to nothing.
 */
import { ascii, bytesKey, rowsOf, viewOf } from '../../core/bytes.ts';
import { damaged, otherVersion } from '../../core/errors.ts';
import { type Gaussians, selected } from '../../core/gaussians.ts';
import { multiplicities, wordsOf } from '../../core/words.ts';
import type { ReadModel } from '../../files/models.ts';
import { decrypted, type Derive, expand, here } from '../../keys/keys.ts';
import { foreignShare, type Payload, type Reader } from '../base.ts';
import { type Codewords, decoded } from '../reed_solomon.ts';
import { DEEPEST, DEPTHS, fieldsOf, gaussianIds, ID_BYTES, LEAST, lowBits, lowWidth, saltOf, salts } from './bits.ts';
import { CellCipher, TAG_BYTES } from './cells.ts';
import { BLOCK_BYTES, lastBits, type Levels, levelsOf, modelHash, readBlocks } from './fields.ts';
import { shardBytes, shardsOf, isTagged, isWhole, message, type Table } from './spread.ts';

const ASSOCIATED = ascii('keyss/v1/lsb');
const DATA_KEY_BYTES = 16;
const [LEAST_BYTES, MIN_BLOCKS] = [48, 4]; // minimum bytes of a block; minimum blocks of a file
const MAX_BITS = 2 ** 30; // bits in codes; more would exceed the memory of a tab
const VERSION = 7;
const [CHECK_BYTES, BLOOM_BYTES, PARAMETER_BYTES] = [8, 32, 73];
const [KEY_COPIES, PARAMETER_COPIES] = [12, 32]; // places of a part
const METHOD_BYTES = 15;
const [MAX_LENGTH, MAX_CODEWORDS] = [1 << 10, 1 << 14]; // shards of one codeword

/** The carriers of a model, prepared for any number of keys. */
export abstract class LsbReader implements Reader {
  protected constructor(private readonly salts: readonly Uint8Array[]) {}

  /** The reader of the codes of a coded model, else of low bits; null without capacity. */
  static of(model: ReadModel): LsbReader | null {
    return model.codes ? BlockReader.ofCodes(levelsOf(model.codes)) : LowBitsReader.ofModel(model);
  }

  get derivations(): number {
    return this.salts.length;
  }

  /** The payload that `key` opens, or null. Raises InputError for damage. */
  async open(key: string, derive: Derive = here): Promise<Payload | null> {
    // Other workers derive the next keys while this one reads.
    const masters = this.salts.map((salt) => derive(key, salt));
    let found: Payload | null = null;
    for (const each of masters) {
      const master = await each;
      found ??= await this.extract(master);
    }
    return found;
  }

  /** The payload that a key under one salt opens, or null. */
  protected abstract extract(master: Uint8Array): Promise<Payload | null>;
}

/** Reads the low bits of Gaussians. */
class LowBitsReader extends LsbReader {
  private constructor(
    salts: readonly Uint8Array[],
    private readonly fields: ReturnType<typeof fieldsOf>,
    private readonly table: Table, // at the least depth
  ) {
    super(salts);
  }

  static ofModel(model: Gaussians): LowBitsReader {
    let fields = fieldsOf(model);
    let [ids, low, width] = [gaussianIds(model, fields), lowBits(fields, LEAST), lowWidth(fields, LEAST)];
    const rows = uniqueRows(ids, lowBits(fields, DEEPEST), lowWidth(fields, DEEPEST));
    if (rows.length < model.count) {
      fields = fieldsOf(selected(model, rows));
      [ids, low] = [rowsOf(ids, rows, ID_BYTES), rowsOf(low, rows, width)];
    }
    return new LowBitsReader(salts(fields, ids, low, width), fields, { ids, low, width });
  }

  protected async extract(master: Uint8Array): Promise<Payload | null> {
    const { width: least } = this.table;
    const secret = expand(master, 'lsb/key');
    const dataKey = message(secret, 'key', DATA_KEY_BYTES, Math.min(least, DATA_KEY_BYTES), KEY_COPIES, this.table);
    const packed = message(dataKey, 'parameters', PARAMETER_BYTES, least, PARAMETER_COPIES, this.table);
    const check = expand(dataKey, 'lsb/check');
    if (packed.subarray(0, CHECK_BYTES).every((each, at) => each === check[at])) return this.payload(dataKey, packed);
    const width = lowWidth(this.fields, DEEPEST);
    this.shards(dataKey, { count: 1, n: 1, k: 1, width: shardBytes(width) }, DEEPEST, isTagged(width));
    return null;
  }

  /** The payload that its unpacked parameters describe. Raises InputError for damage. */
  private async payload(dataKey: Uint8Array, packed: Uint8Array): Promise<Payload> {
    const { version, method, size, view, at } = prefix(packed.subarray(CHECK_BYTES));
    if (version !== VERSION) throw otherVersion();
    const [depth, gaussians, count] = [view.getUint8(at), view.getUint32(at + 1, true), view.getUint32(at + 5, true)];
    const [n, k] = [view.getUint16(at + 9, true), view.getUint16(at + 11, true)];
    const rowBytes = lowWidth(this.fields, depth);
    const [width, tagged] = [shardBytes(rowBytes), isTagged(rowBytes)];
    if (!DEPTHS.includes(depth) || count < 1 || count > MAX_CODEWORDS || !isWhole(count, tagged)) throw damaged();
    if (k < 1 || k > n || n > MAX_LENGTH || size < 1 || size > count * k * width) throw damaged();
    const codewords = { count, n, k, width };
    const shards = this.shards(dataKey, codewords, depth, tagged);
    const data = await this.opened(dataKey, codewords, shards, size, false).catch(() =>
      this.opened(dataKey, codewords, shards, size, true), // some shards are false
    );
    const bloom = packed.subarray(packed.length - BLOOM_BYTES);
    const share = foreignShare(dataKey, this.table.ids, bloom, gaussians);
    return { method, data, foreign: Math.ceil((share * this.table.ids.length) / ID_BYTES) || undefined };
  }

  private async opened(
    dataKey: Uint8Array, codewords: Codewords, shards: [number, Uint8Array][], size: number, errors: boolean,
  ): Promise<Uint8Array> {
    return decryptedPayload(dataKey, decoded(codewords, shards, errors).subarray(0, size));
  }

  private shards(dataKey: Uint8Array, codewords: Codewords, depth: number, tagged: boolean): [number, Uint8Array][] {
    const [low, width] = [lowBits(this.fields, depth), lowWidth(this.fields, depth)];
    return shardsOf(dataKey, codewords, tagged, { ids: this.table.ids, low, width });
  }
}

/** Reads blocks of codes. */
class BlockReader extends LsbReader {
  private constructor(
    salts: readonly Uint8Array[],
    private readonly ids: Uint8Array, // [C, 16]
    private readonly low: Uint8Array, // [C, BLOCK_BYTES]
  ) {
    super(salts);
  }

  static ofCodes(levels: Levels): BlockReader | null {
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
    return new BlockReader([salt], ids.subarray(ID_BYTES), low.subarray(BLOCK_BYTES));
  }

  protected async extract(master: Uint8Array): Promise<Payload | null> {
    const decrypt = (secret: Uint8Array, label: string, size: number) => {
      return new CellCipher(secret, label, size).decrypt(this.ids, this.low, BLOCK_BYTES);
    };
    const keys = decrypt(expand(master, 'lsb/key'), 'key', DATA_KEY_BYTES);
    const dataKey = keys.length ? keys[0].data : expand(master, 'lsb/none').slice(0, DATA_KEY_BYTES);
    const [found] = decrypt(dataKey, 'parameters', LEAST_BYTES - TAG_BYTES);
    if (!found) return null;
    const { version, method, size, view, at } = prefix(found.data);
    if (version !== VERSION) throw otherVersion();
    const [bytes, blocks] = [view.getUint16(at, true), this.low.length / BLOCK_BYTES];
    const count = Math.ceil(size / bytes);
    if (bytes < 1 || bytes > BLOCK_BYTES || count > blocks) throw damaged();
    const encrypted = new Uint8Array(count * bytes);
    for (let index = 0; index < count; index++) {
      const start = ((found.row + 1 + index) % blocks) * BLOCK_BYTES;
      encrypted.set(this.low.subarray(start, start + bytes), index * bytes);
    }
    return { method, data: await decryptedPayload(dataKey, encrypted.subarray(0, size)) };
  }
}

/** What all parameters begin with; further ones follow in `view` from `at` on. */
function prefix(packed: Uint8Array) {
  const [view, end] = [viewOf(packed), 1 + METHOD_BYTES];
  const method = bytesKey(packed.subarray(1, end)).replace(/\0+$/, '');
  return { version: packed[0], method, size: view.getUint32(end, true), view, at: end + 4 };
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
