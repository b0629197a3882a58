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
import {
  checkOf, PARAMETER_BYTES, type Parameters, type Reader, saltedReader, unpackedParameters, unsealed, unsealedShards,
} from '../container.ts';
import { EXACT_BYTES, exactForeign, ID_BYTES } from '../foreign.ts';
import type { Codewords, Shards } from '../reed_solomon.ts';
import { atDepth, DEEPEST, DEPTHS, fieldsOf, gaussianIds, LEAST, lowBits, lowWidth, saltOf, salts } from './bits.ts';
import { decodedLevels } from './decoded.ts';
import { BLOCK_BYTES, lastBits, type Levels, levelsOf, modelHash, readBlocks } from './fields.ts';
import { isTagged, isWhole, message, parameterPads, shardBytes, shardsOf, type Table } from './shards.ts';

const DATA_KEY_BYTES = 16;
const [LEAST_BYTES, MIN_BLOCKS] = [48, 3]; // minimum bytes of a block; minimum blocks of a file
const MAX_BITS = 2 ** 30; // bits in quantised values; more would exceed the memory of a tab
const [KEY_COPIES, PARAMETER_COPIES] = [12, 32]; // places of a part
const [MAX_LENGTH, MAX_CODEWORDS] = [1 << 10, 1 << 14]; // shards of one codeword

/** Of quantised values of the model's file or the one it was decoded from, else of low bits; null without capacity. */
export async function lsbReader(model: ReadModel): Promise<Reader | null> {
  const levels = model.codes ? levelsOf(model.codes) : decodedLevels(model);
  return levels ? blockReader(levels) : lowBitsReader(model);
}

async function lowBitsReader(model: Gaussians): Promise<Reader> {
  let fields = fieldsOf(model);
  let [ids, low] = [await gaussianIds(model, fields), lowBits(fields)];
  const used = fields.inUse.length;
  const rows = uniqueRows(ids, low, used);
  if (rows.length < model.count) {
    fields = fieldsOf(selected(model, rows));
    [ids, low] = [rowsOf(ids, rows, ID_BYTES), lowBits(fields)];
  }
  const tableAt = (depth: number): Table => ({ ids, low: atDepth(low, used, depth), width: lowWidth(used, depth) });
  /** All shards that seem to be there. */
  const shardsAt = (depth: number, dataKey: Uint8Array, codewords: Codewords): Shards =>
    shardsOf(dataKey, codewords, isTagged(lowWidth(used, depth)), tableAt(depth));
  const table = tableAt(LEAST);
  return saltedReader(salts(fields, ids, table.low, table.width), async (secret) => {
    const dataKey = message(secret, 'key', DATA_KEY_BYTES, Math.min(table.width, DATA_KEY_BYTES), KEY_COPIES, table);
    const packed = message(dataKey, 'parameters', PARAMETER_BYTES, table.width, PARAMETER_COPIES, table);
    const found = unpackedParameters(packed, dataKey);
    if (found === null) {
      shardsAt(DEEPEST, dataKey, { count: 1, n: 1, k: 1, width: shardBytes(lowWidth(used, DEEPEST)) });
      return null;
    }
    const codewords = codewordsOf(found, used);
    const shards = shardsAt(found.depth, dataKey, codewords);
    const [record, payload] = await unsealedShards(dataKey, codewords, shards, EXACT_BYTES);
    return { ...payload, foreign: exactForeign(record, dataKey, ids) || undefined };
  });
}

/** The codewords that parameters describe, for Gaussians with `fields` in use. Raises InputError for impossible ones. */
function codewordsOf({ depth, count, n, k }: Parameters, fields: number): Codewords {
  const rowBytes = DEPTHS.includes(depth) ? lowWidth(fields, depth) : 0;
  const width = shardBytes(rowBytes);
  if (width < 1 || count < 1 || count > MAX_CODEWORDS || !isWhole(count, isTagged(rowBytes))) throw damaged();
  if (k < 1 || k > n || n > MAX_LENGTH) throw damaged();
  return { count, n, k, width };
}

/** Of blocks of quantised values; the first gives the salt. */
function blockReader(levels: Levels): Reader | null {
  const bits = lastBits(levels);
  if (bits.length < MIN_BLOCKS * 8 * BLOCK_BYTES || bits.length > MAX_BITS) return null;
  const table = readBlocks(bits);
  const numbers = new Uint32Array((ID_BYTES / 4) * (table.length / BLOCK_BYTES));
  const [every, hash] = [new Uint8Array(numbers.buffer), modelHash(levels)];
  for (let block = 0; 4 * block < numbers.length; block++) {
    numbers[4 * block] = block;
    every.set(hash, ID_BYTES * block + 4);
  }
  const [ids, low] = [every.subarray(ID_BYTES), table.subarray(BLOCK_BYTES)];
  const blocks = low.length / BLOCK_BYTES;
  return saltedReader([saltOf(every.subarray(0, ID_BYTES), table.subarray(0, LEAST_BYTES))], async (dataKey) => {
    const [pads, check] = [parameterPads(dataKey, ids), checkOf(dataKey)];
    let row = -1;
    for (let block = blocks - 1; block >= 0; block--) {
      if (check.every((each, at) => (low[block * BLOCK_BYTES + at] ^ pads[block * PARAMETER_BYTES + at]) === each)) row = block;
    }
    if (row < 0) return null;
    const packed = pads.slice(row * PARAMETER_BYTES, (row + 1) * PARAMETER_BYTES).map((each, at) => each ^ low[row * BLOCK_BYTES + at]);
    const { depth: width, count } = unpackedParameters(packed, dataKey)!;
    if (width < 1 || width > BLOCK_BYTES || count < 1 || count >= blocks) throw damaged();
    const sealed = new Uint8Array(count * width);
    for (let index = 0; index < count; index++) {
      const start = ((row + 1 + index) % blocks) * BLOCK_BYTES;
      sealed.set(low.subarray(start, start + width), index * width);
    }
    return (await unsealed(dataKey, sealed))[1];
  });
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
