/** Foreign Gaussians: added to a model, or changed, after secrets were hidden; counterpart of `keyss.channels.foreign`. */
import { viewOf } from '../core/bytes.ts';
import { coefficients, type Gaussians, opacity } from '../core/gaussians.ts';
import { movedPoint, type Similarity } from '../core/similarity.ts';
import { vectorAt } from '../core/vectors.ts';
import { sortingOrder } from '../core/words.ts';
import { encryptBlocks } from '../keys/aes.ts';
import { expand } from '../keys/keys.ts';

export const ID_BYTES = 16;

/**
 * The share, 0 to 1, of foreign Gaussians among those with `ids` [N, 16], by the first `bits` of a Bloom filter; equal IDs
 * count once. `places`: how many a Gaussian may hash to. 1 if less than a share `gone` of the filter's sample, rounded down,
 * is there.
 */
function foreignShare(
  secret: Uint8Array, ids: Uint8Array, filter: Uint8Array, bits: number, places: (row: number) => number, gone = 0,
): number {
  const isUnset = (place: number): boolean => ((filter[place >>> 3] >>> (place & 7)) & 1) === 0;
  const unset = [...Array(bits).keys()].filter(isUnset).length;
  const hashed = viewOf(encryptBlocks(expand(secret, 'bloom'), ids));
  const sampled = new Map<number, number>(); // the place of each different ID
  for (let row = 0; row < ids.length / ID_BYTES; row++) {
    const [low, high] = [hashed.getUint32(ID_BYTES * row, true), hashed.getUint32(ID_BYTES * row + 4, true)];
    const place = low % Math.max(1, places(row));
    if (place < bits) sampled.set(low * 2 ** 21 + (high >>> 11), place);
  }
  if (sampled.size < Math.floor(gone * (bits - unset))) return 1;
  const foreign = [...sampled.values()].filter(isUnset).length;
  return Math.min(1, foreign / Math.max(1e-9, (sampled.size * unset) / Math.max(1, bits)));
}

export const EXACT_BYTES = 4 + 32;

/** About how many of the Gaussians with `ids` [N, 16] are foreign, by the record of exact IDs. */
export function exactForeign(record: Uint8Array, secret: Uint8Array, ids: Uint8Array): number {
  const [count, filter] = [viewOf(record).getUint32(0, true), record.subarray(4)];
  const share = foreignShare(secret, ids, filter, Math.min(8 * filter.length, count), () => count);
  return Math.ceil((share * ids.length) / ID_BYTES);
}

// Of three positions (in sides of the cube), three log scales, opacity and three colours: bins, and maximum rounding errors.
const BINS = [1 / 16, 1 / 16, 1 / 16, 0.5, 0.5, 0.5, 0.1, 0.3, 0.3, 0.3];
const ERRORS = [0.002, 0.002, 0.002, 0.035, 0.035, 0.035, 0.005, 0.016, 0.016, 0.016];
const LOW = [-7, -7, -7, -8, -8, -8, 0, -1.7, -1.7, -1.7]; // formats may clip numbers outside of these
const HIGH = [7, 7, 7, 4, 4, 4, 1, 1.7, 1.7, 1.7];
const VISIBLE = 3.5 / 255; // minimum opacity; 8 bits round none across it
const BLOOM_BYTES = 128;

const [MORE, GONE] = [1.25, 0.02]; // factor by which formats may increase the number of faint Gaussians; share of the sample
const LEAST_SHARE = 0.05; // of foreign Gaussians that is told
const BLOOM = 16; // after four numbers
const POSITIONS = 3; // the first numbers

export const COARSE_BYTES = BLOOM + BLOOM_BYTES;

/** About how many of a model's Gaussians are foreign, by the record of coarse IDs; 0 if they are at most a LEAST_SHARE. */
export function coarseForeign(record: Uint8Array, secret: Uint8Array, model: Gaussians, toOwn: Similarity): number {
  const view = viewOf(record);
  const [before, faint] = [view.getUint32(0, true), model.opacityLogits.reduce((sum, each) => sum + Number(opacity(each) <= VISIBLE), 0)];
  const outsideBefore = view.getUint32(4, true);
  const [count, area] = [Math.max(1, view.getUint32(8, true)), Math.max(1e-30, view.getFloat32(12, true))];
  const rows = numbersOf(model, toOwn);
  const [steps, offsets] = stepsOf(rows, secret);
  const ids = new Int8Array(ID_BYTES * rows.length);
  const places: number[] = [];
  for (const [row, numbers] of rows.entries()) {
    const bins = steps[row].map(Math.floor);
    // A format may have moved it from another bin.
    if (numbers.some((each, at) => each > LOW[at] && each < HIGH[at] && isNearBorder(steps[row][at], at))) continue;
    const middles = bins.map((bin, at) => (bin + 0.5 - offsets[row][at]) * BINS[at]);
    const [, b, c] = middles.slice(3, 6).sort((x, y) => x - y);
    const size = Math.exp(b + c) * Math.max(0.02, Math.min(1, middles[6])) / area;
    ids.set(bins, ID_BYTES * places.length);
    places.push(Math.max(8 * BLOOM_BYTES, Math.round(2 / (1 / count + size))));
  }
  const known = new Uint8Array(ids.buffer, 0, ID_BYTES * places.length);
  const visible = model.count - faint;
  const share = foreignShare(secret, known, record.subarray(BLOOM), 8 * BLOOM_BYTES, (row) => places[row], GONE);
  let sure = share > LEAST_SHARE ? Math.round(share * visible) : 0;
  const outside = rows.filter(isOutside).length;
  if (outside > outsideBefore + LEAST_SHARE * visible) sure = Math.max(sure, outside - outsideBefore);
  return sure + (faint > MORE * before ? faint - before : 0); // a hundred faint ones in one place are visible
}

/** Numbers of the visible Gaussians in the own frame, in the range of the bins. */
function numbersOf(model: Gaussians, toOwn: Similarity): number[][] {
  const [larger, width] = [Math.log(toOwn.scale), 3 * coefficients(model.shDegree)];
  const rows: number[][] = [];
  for (let row = 0; row < model.count; row++) {
    const numbers = [
      ...movedPoint(toOwn, vectorAt(model.means, row)), ...vectorAt(model.logScales, row).map((each) => each + larger),
      opacity(model.opacityLogits[row]), ...model.sh.subarray(width * row, width * row + 3),
    ];
    if (!(numbers.every(Number.isFinite) && numbers[6] > VISIBLE)) continue;
    rows.push(numbers.map((each, at) => Math.max(LOW[at], Math.min(HIGH[at], each))));
  }
  return rows;
}

/** Numbers in bins, and the offsets of the borders: those after the positions depend on the position's bin. */
function stepsOf(rows: readonly number[][], secret: Uint8Array): [steps: number[][], offsets: number[][]] {
  const first = Array.from(expand(secret, 'bins').subarray(0, POSITIONS), offsetOf);
  const blocks = new Int8Array(ID_BYTES * rows.length);
  rows.forEach((numbers, row) => {
    blocks.set(first.map((offset, at) => Math.floor(numbers[at] / BINS[at] + offset)), ID_BYTES * row);
  });
  const borders = encryptBlocks(expand(secret, 'borders'), new Uint8Array(blocks.buffer));
  const offsets = rows.map((_, row) => {
    const others = borders.subarray(ID_BYTES * row, ID_BYTES * row + BINS.length - POSITIONS);
    return [...first, ...Array.from(others, offsetOf)];
  });
  return [rows.map((numbers, row) => numbers.map((each, at) => each / BINS[at] + offsets[row][at])), offsets];
}

const offsetOf = (random: number): number => (random + 0.5) / 256;

function isNearBorder(step: number, at: number): boolean {
  const inside = step - Math.floor(step);
  return Math.min(inside, 1 - inside) < ERRORS[at] / BINS[at];
}

/** True if a position, or two of the log scales, are out of range. */
function isOutside(numbers: readonly number[]): boolean {
  const far = numbers.map((each, at) => each <= LOW[at] || each >= HIGH[at]);
  return far.slice(0, POSITIONS).some(Boolean) || far.slice(POSITIONS, 6).filter(Boolean).length > 1;
}

const [MAX_COPIES, COPIED] = [0.1, 2 / 255]; // share of a sound model; opacity, above that of appended Gaussians

/** The number of visible Gaussians with the position and the red of another, or 0 for no suspicious number. */
export function copies(model: Gaussians): number {
  const width = 3 * coefficients(model.shDegree);
  const rows = [...Array(model.count).keys()].filter((row) => opacity(model.opacityLogits[row]) > COPIED);
  const numbers = new Float32Array(4 * rows.length);
  rows.forEach((row, at) => numbers.set([...vectorAt(model.means, row), model.sh[width * row]], 4 * at));
  const words = new Uint32Array(numbers.map((each) => each + 0).buffer); // no negative zeros
  const order = sortingOrder(words, 4);
  let count = 0;
  for (let at = 1; at < order.length; at++) {
    const [a, b] = [4 * order[at - 1], 4 * order[at]];
    if ([0, 1, 2, 3].every((word) => words[a + word] === words[b + word])) count++;
  }
  return count > MAX_COPIES * rows.length ? count : 0;
}
