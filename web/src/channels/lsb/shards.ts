/**
 * Shards and messages in slots with IDs, the low bits of Gaussians; counterpart of `keyss.channels.lsb.shards`
 * (docs/byte-layout.md, "Messages" and "Shards").
 */
import { bytesKey, mostFrequent, rowsOf, viewOf } from '../../core/bytes.ts';
import { encryptBlocks } from '../../keys/aes.ts';
import { expand } from '../../keys/keys.ts';
import { PARAMETER_BYTES } from '../container.ts';
import { ID_BYTES } from '../foreign.ts';
import type { Codewords, Shards } from '../reed_solomon.ts';

const BLOCK = 16; // bytes of a block of AES
const CANDIDATES = 8; // Gaussians that are looked at for each place
const NUMBER_BYTES = 2;
const LEAST_TAGGED = 5; // minimum bytes of a row with a tag
const PER_GROUP = 32; // codewords of a group whose rows have tags

/** [N, size] a pseudo-random function of `ids` [N, 16]. */
function functionOf(secret: Uint8Array, label: string, ids: Uint8Array, size = BLOCK): Uint8Array {
  const [key, count, blocks] = [expand(secret, `lsb/${label}`), ids.length / ID_BYTES, Math.ceil(size / BLOCK)];
  if (size === BLOCK) return encryptBlocks(key, ids);
  const found = new Uint8Array(count * size);
  for (let block = 0; block < blocks; block++) {
    const counted = ids.slice();
    for (let last = BLOCK - 1; last < counted.length; last += BLOCK) counted[last] ^= block;
    const [values, first, end] = [encryptBlocks(key, counted), block * BLOCK, Math.min(BLOCK, size - block * BLOCK)];
    for (let row = 0; row < count; row++) {
      for (let byte = 0; byte < end; byte++) found[row * size + first + byte] = values[row * BLOCK + byte];
    }
  }
  return found;
}

/** [N, PARAMETER_BYTES] what encrypts parameters that slots with `ids` [N, 16] hold as a whole. */
export function parameterPads(dataKey: Uint8Array, ids: Uint8Array): Uint8Array {
  return functionOf(dataKey, 'parameters/pad', ids, PARAMETER_BYTES);
}

/** Low bits of Gaussians: rows of `width` bytes. */
export interface Table {
  readonly ids: Uint8Array; // [N, 16]
  readonly low: Uint8Array; // [N, width]
  readonly width: number;
}

/** The message of `size` bytes under a secret, in fragments of `width` bytes in `copies` places: the most frequent contents. */
export function message(
  secret: Uint8Array, label: string, size: number, width: number, copies: number, table: Table,
): Uint8Array {
  const found = new Uint8Array(Math.ceil(size / width) * width);
  const candidates = candidatesOf(functionOf(secret, `${label}/place`, table.ids), found.length / width, copies);
  candidates.forEach((rows, fragment) => {
    const pads = functionOf(secret, `${label}/pad`, rowsOf(table.ids, rows, ID_BYTES), width);
    const contents = rows.map((row, at) => {
      return bytesKey(pads.subarray(at * width, (at + 1) * width).map((each, byte) => each ^ table.low[row * table.width + byte]));
    });
    // Of equally frequent ones the smallest.
    const [best] = mostFrequent(contents.sort()) ?? [''];
    for (let byte = 0; byte < best.length; byte++) found[fragment * width + byte] = best.charCodeAt(byte);
  });
  return found.subarray(0, size);
}

/** The rows that are looked at for each fragment: those with the smallest function `values` [N, 16]. */
function candidatesOf(values: Uint8Array, fragments: number, copies: number): number[][] {
  const [view, count] = [viewOf(values), values.length / BLOCK];
  const among = Math.min(count, CANDIDATES * copies * fragments);
  let near: number[] = [];
  // Values are uniform: twice as many as needed, or more, are below this share of the largest.
  for (let share = (2 * among) / count; near.length < among; share *= 2) {
    near = [];
    for (let row = 0; row < count; row++) if (view.getUint32(row * BLOCK) < share * 2 ** 32) near.push(row);
  }
  const [upper, lower] = [0, 4].map((at) => (row: number): number => view.getUint32(row * BLOCK + at));
  near.sort((a, b) => upper(a) - upper(b) || lower(a) - lower(b));
  const candidates = Array.from({ length: fragments }, () => [] as number[]);
  for (const row of near.slice(0, among)) {
    candidates[view.getUint32(row * BLOCK + 8, true) % fragments].push(row);
  }
  return candidates;
}

/** All shards of a payload that are left in `table`, and false ones. */
export function shardsOf(dataKey: Uint8Array, codewords: Codewords, tagged: boolean, table: Table): Shards {
  const { ids, low, width } = table;
  const values = functionOf(dataKey, 'shard/place', ids);
  const [view, groups] = [viewOf(values), Math.max(1, Math.floor(codewords.count / (tagged ? PER_GROUP : 1)))];
  const [ofGroup, start] = [codewords.count / groups, (tagged ? 1 : 0) + NUMBER_BYTES];
  const [rows, numbers] = [[] as number[], [] as number[]];
  for (let row = 0; row < ids.length / ID_BYTES; row++) {
    const [at, cell] = [row * BLOCK, row * width];
    if (tagged && low[cell] !== values[at]) continue;
    const local = (low[cell + start - 2] | (low[cell + start - 1] << 8)) ^ view.getUint16(at + 2, true);
    if (local >= codewords.n * ofGroup) continue;
    const group = view.getUint32(at + 4, true) % groups;
    rows.push(row);
    numbers.push(Math.floor(local / ofGroup) * codewords.count + group * ofGroup + (local % ofGroup));
  }
  const size = codewords.width;
  const data = functionOf(dataKey, 'shard/pad', rowsOf(ids, rows, ID_BYTES), size);
  rows.forEach((row, at) => {
    for (let byte = 0; byte < size; byte++) data[at * size + byte] ^= low[row * width + start + byte];
  });
  return { numbers, data };
}

/** True if rows of `width` bytes have a tag. */
export function isTagged(width: number): boolean {
  return width >= LEAST_TAGGED;
}

/** Bytes of a shard in a row of `width` bytes. */
export function shardBytes(width: number): number {
  return Math.max(0, 2 * Math.floor((width - NUMBER_BYTES - (isTagged(width) ? 1 : 0)) / 2));
}

/** True if so many codewords can be divided into equal groups. */
export function isWhole(codewords: number, tagged: boolean): boolean {
  return !tagged || codewords <= PER_GROUP || codewords % PER_GROUP === 0;
}
