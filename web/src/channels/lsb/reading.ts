/**
 * Reads the low bits of a model, or the quantised values of a file, with a key; counterpart of `keyss.channels.lsb.low_bits` and
 * `quantised` (docs/byte-layout.md).
 *
 * A wrong key makes the same passes over all Gaussians as a right one, and all salts are always tried, so the time taken
 * reveals next to nothing.
 */
import { bytesKey, rowsOf } from '../../core/bytes.ts';
import { damaged } from '../../core/errors.ts';
import { type Gaussians, selected } from '../../core/gaussians.ts';
import { multiplicities, wordsOf } from '../../core/words.ts';
import type { ReadModel } from '../../files/models.ts';
import { type Derive, here } from '../../keys/keys.ts';
import {
  checkOf, keySecret, PARAMETER_BYTES, type Parameters, type Payload, type Reader, unpackedParameters, unsealed, unsealedShards,
} from '../container.ts';
import { EXACT_BYTES, exactForeign, ID_BYTES } from '../foreign.ts';
import type { Codewords, Shards } from '../reed_solomon.ts';
import { atDepth, DEEPEST, DEPTHS, fieldsOf, gaussianIds, LEAST, lowBits, lowWidth, saltOf, salts } from './bits.ts';
import { BLOCK_BYTES, lastBits, type Levels, levelsOf, modelHash, readBlocks } from './fields.ts';
import { isTagged, isWhole, message, parameterPads, shardBytes, shardsOf, type Table } from './shards.ts';

const DATA_KEY_BYTES = 16;
const [LEAST_BYTES, MIN_BLOCKS] = [48, 3]; // minimum bytes of a block; minimum blocks of a file
const MAX_BITS = 2 ** 30; // bits in quantised values; more would exceed the memory of a tab
const [KEY_COPIES, PARAMETER_COPIES] = [12, 32]; // places of a part
const [MAX_LENGTH, MAX_CODEWORDS] = [1 << 10, 1 << 14]; // shards of one codeword

/** The carriers of a model, prepared for any number of keys. */
export abstract class LsbReader implements Reader {
  protected constructor(private readonly salts: readonly Uint8Array[]) {}

  /** The reader of the quantised values of a file, else of low bits; null without capacity. */
  static async of(model: ReadModel): Promise<LsbReader | null> {
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
    private readonly fields: number, // in use
    private readonly low: Uint8Array, // [N, fields] at the greatest depth
    private readonly table: Table, // at the least depth
  ) {
    super(salts);
  }

  static async ofModel(model: Gaussians): Promise<LowBitsReader> {
    let fields = fieldsOf(model);
    let [ids, low] = [await gaussianIds(model, fields), lowBits(fields)];
    const rows = uniqueRows(ids, low, fields.inUse.length);
    if (rows.length < model.count) {
      fields = fieldsOf(selected(model, rows));
      [ids, low] = [rowsOf(ids, rows, ID_BYTES), lowBits(fields)];
    }
    const used = fields.inUse.length;
    const table = { ids, low: atDepth(low, used, LEAST), width: lowWidth(used, LEAST) };
    return new LowBitsReader(salts(fields, ids, table.low, table.width), used, low, table);
  }

  protected async extract(master: Uint8Array): Promise<Payload | null> {
    const { width: least, ids } = this.table;
    const secret = keySecret(master);
    const dataKey = message(secret, 'key', DATA_KEY_BYTES, Math.min(least, DATA_KEY_BYTES), KEY_COPIES, this.table);
    const packed = message(dataKey, 'parameters', PARAMETER_BYTES, least, PARAMETER_COPIES, this.table);
    const found = unpackedParameters(packed, dataKey);
    if (found === null) {
      this.shards(dataKey, { count: 1, n: 1, k: 1, width: shardBytes(lowWidth(this.fields, DEEPEST)) }, DEEPEST);
      return null;
    }
    const codewords = this.codewords(found);
    const shards = this.shards(dataKey, codewords, found.depth);
    const [record, payload] = await unsealedShards(dataKey, codewords, shards, EXACT_BYTES);
    return { ...payload, foreign: exactForeign(record, dataKey, ids) || undefined };
  }

  /** The codewords that parameters describe. Raises InputError for impossible ones. */
  private codewords({ depth, count, n, k }: Parameters): Codewords {
    const rowBytes = DEPTHS.includes(depth) ? lowWidth(this.fields, depth) : 0;
    const width = shardBytes(rowBytes);
    if (width < 1 || count < 1 || count > MAX_CODEWORDS || !isWhole(count, isTagged(rowBytes))) throw damaged();
    if (k < 1 || k > n || n > MAX_LENGTH) throw damaged();
    return { count, n, k, width };
  }

  /** All shards that seem to be there. */
  private shards(dataKey: Uint8Array, codewords: Codewords, depth: number): Shards {
    const width = lowWidth(this.fields, depth);
    const table = { ids: this.table.ids, low: atDepth(this.low, this.fields, depth), width };
    return shardsOf(dataKey, codewords, isTagged(width), table);
  }
}

/** Reads blocks of quantised values. */
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
    const [dataKey, blocks] = [keySecret(master), this.low.length / BLOCK_BYTES];
    const [pads, check] = [parameterPads(dataKey, this.ids), checkOf(dataKey)];
    let row = -1;
    for (let block = blocks - 1; block >= 0; block--) {
      if (check.every((each, at) => (this.low[block * BLOCK_BYTES + at] ^ pads[block * PARAMETER_BYTES + at]) === each)) row = block;
    }
    if (row < 0) return null;
    const packed = pads.slice(row * PARAMETER_BYTES, (row + 1) * PARAMETER_BYTES).map((each, at) => each ^ this.low[row * BLOCK_BYTES + at]);
    const { depth: width, count } = unpackedParameters(packed, dataKey)!;
    if (width < 1 || width > BLOCK_BYTES || count < 1 || count >= blocks) throw damaged();
    const sealed = new Uint8Array(count * width);
    for (let index = 0; index < count; index++) {
      const start = ((row + 1 + index) % blocks) * BLOCK_BYTES;
      sealed.set(this.low.subarray(start, start + width), index * width);
    }
    return (await unsealed(dataKey, sealed))[1];
  }
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
