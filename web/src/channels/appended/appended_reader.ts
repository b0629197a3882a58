/**
 * Reader of appended Gaussians (docs/channels.md): words of 84 bits, read after a format has rounded them, and packets in words;
 * counterpart of `keyss.channels.appended.appended_channel` and `words`.
 */
import { rowsOf, viewOf } from '../../core/bytes.ts';
import { type Gaussians, opacity, where, withDegree } from '../../core/gaussians.ts';
import { moved, type Similarity } from '../../core/similarity.ts';
import { type Quaternion, quaternionProduct } from '../../core/vectors.ts';
import type { Words } from '../../core/words.ts';
import { encryptBlocks } from '../../keys/aes.ts';
import { expand } from '../../keys/keys.ts';
import { type Reader, saltedReader, unsealedShards } from '../container.ts';
import { COARSE_BYTES, coarseForeign } from '../foreign.ts';
import type { Codewords, Shards } from '../reed_solomon.ts';
import { LEAST, ONE_IN, type PilotData, pilotsOf, POSITION_BITS, readPilots } from './pilots.ts';

// Gaussians sampled for pilots; maximum number of lattice offsets tried; minimum excess of pilots, in standard deviations.
const [SAMPLE, TRIED, NOT_BY_CHANCE] = [8000, 8, 3];

/** Null if there are no appended Gaussians, or if their frame cannot be found. */
export function appendedReader(model: Gaussians): Reader | null {
  const faint = candidates(model);
  if (faint.count < LEAST / 4) return null;
  const colours = Uint8Array.from(faint.sh, (each) => nearest(each / COLOUR_STEP + 2 ** (COLOUR_BITS - 1) - 0.5, COLOUR_BITS));
  const steps = Float64Array.from(faint.logScales, (each) => each / SCALE_STEP); // of their lattice, which lies anywhere
  for (const shifts of [likelyShifts, shiftsWithPilots]) {
    let best: { data: PilotData; scales: Uint8Array } | null = null;
    for (const shift of shifts(steps, colours)) {
      const scales = scalesAt(steps, shift);
      const data = readPilots(invariantsOf(colours, scales), faint.means);
      if (data && (best === null || data.agreeing > best.data.agreeing)) best = { data, scales };
    }
    if (best !== null) {
      const { data: { salt, toOwn }, scales } = best;
      return wordReader(model, wordsOfPoints(colours, scales, inOwnFrame(faint, toOwn)), salt, toOwn);
    }
  }
  return null;
}

/** Reads payloads in `words`; `toOwn`: from the world to the own frame. */
function wordReader(model: Gaussians, words: Uint8Array, salt: Uint8Array, toOwn: Similarity): Reader {
  return saltedReader([salt], async (dataKey) => {
    for (const width of WIDTHS) {
      const codewords = readHeader(expand(dataKey, `header/${width}`), words, width);
      if (codewords === null) continue;
      const packets = readPackets(expand(dataKey, 'packets'), words, width);
      const [record, payload] = await unsealedShards(dataKey, codewords, packets, COARSE_BYTES);
      return { ...payload, foreign: coarseForeign(record, dataKey, model, toOwn) || undefined };
    }
    return null;
  });
}

/** The offsets of the log-scale lattice with the most pilots. */
function shiftsWithPilots(steps: Float64Array, colours: Uint8Array): number[] {
  const count = Math.min(SAMPLE, steps.length / 3);
  const every = steps.length / 3 / count;
  const rows = Array.from({ length: count }, (_, at) => Math.floor(at * every));
  const [fewSteps, fewColours] = [rowsOf(steps, rows, 3), rowsOf(colours, rows, 3)];
  const byChance = count / ONE_IN;
  return allShifts(fewSteps)
    .map((shift) => ({ shift, pilots: pilotsOf(invariantsOf(fewColours, scalesAt(fewSteps, shift))).length }))
    .filter(({ pilots }) => pilots > byChance + NOT_BY_CHANCE * Math.sqrt(byChance))
    .sort((a, b) => b.pilots - a.pilots)
    .slice(0, TRIED)
    .map(({ shift }) => shift);
}

const WIDTHS = [8, 6]; // data bytes per packet
const HEADER_BITS = 20;
const WORD_BYTES = 11;
const MAX_DATA = 5895; // packets per codeword
const [LEFT, DEVIATIONS] = [0.74, 4.2]; // expected share of surviving packets, and the margin
const AGREEING_HEADERS = 12; // fewer agree by chance among a million words

/** [N, WORD_BYTES] words of colours, scales [N, 3] and positions and turns [N, 6]; the last four bits are zero. */
function wordsOfPoints(colours: Uint8Array, scales: Uint8Array, others: Uint16Array): Uint8Array {
  const count = colours.length / 3;
  const bytes = new Uint8Array(WORD_BYTES * count);
  const view = new DataView(bytes.buffer);
  for (let row = 0; row < count; row++) {
    const [r, g, b] = colours.subarray(3 * row, 3 * row + 3);
    const [u, v, w] = scales.subarray(3 * row, 3 * row + 3);
    const [x, y, z, i, j, k] = others.subarray(6 * row, 6 * row + 6);
    const at = WORD_BYTES * row;
    // 7 + 7 + 7 + 6 + 5 bits, then 1 + 6 + 10 + 10 + 5, then 5 + 5 + 5 + 1 and 4.
    view.setUint32(at, (r << 25) | (g << 18) | (b << 11) | (u << 5) | (v >> 1));
    view.setUint32(at + 4, ((v & 1) << 31) | (w << 25) | (x << 15) | (y << 5) | (z >> 5));
    view.setUint16(at + 8, ((z & 31) << 11) | (i << 6) | (j << 1) | (k >> 4));
    bytes[at + 10] = (k & 15) << 4;
  }
  return bytes;
}

/** All words as if they were packets: data bytes, and then a tag, the encrypted number. */
function readPackets(key: Uint8Array, bytes: Uint8Array, width: number): Shards {
  const count = bytes.length / WORD_BYTES;
  const [numbers, data, blocks] = [new Float64Array(count), new Uint8Array(width * count), new Uint8Array(16 * count)];
  for (let row = 0; row < count; row++) {
    for (let byte = 0; byte < width; byte++) {
      data[width * row + byte] = blocks[16 * row + byte] = bytes[WORD_BYTES * row + byte];
    }
  }
  const encrypted = encryptBlocks(key, blocks);
  for (let row = 0; row < count; row++) {
    let tag = 0;
    for (let byte = 0; byte < WORD_BYTES - width; byte++) {
      tag = 256 * tag + (bytes[WORD_BYTES * row + width + byte] ^ encrypted[16 * row + byte]); // may pass 2^32
    }
    numbers[row] = Math.floor(tag / 16);
  }
  return { numbers, data };
}

/** The codewords by majority of the headers; null if too few agree. Copies of one word have one vote. */
function readHeader(key: Uint8Array, words: Uint8Array, width: number): Codewords | null {
  const votes = new Uint32Array(1 << HEADER_BITS);
  const seen = new Set<number>();
  const { numbers, data } = readPackets(key, words, width);
  const view = viewOf(data);
  for (let row = 0; row < numbers.length; row++) {
    const first = view.getUint32(width * row) * 2 ** 16 + view.getUint16(width * row + 4);
    if (numbers[row] < votes.length && !seen.has(first)) votes[numbers[row]]++;
    seen.add(first);
  }
  const header = votes.reduce((best, each, value) => (each > votes[best] ? value : best), 0);
  if (!(votes[header] >= AGREEING_HEADERS && header > 0)) return null;
  const count = Math.ceil(header / MAX_DATA);
  const k = Math.ceil(header / count);
  let n = k;
  while (n * LEFT - DEVIATIONS * Math.sqrt(n * LEFT * (1 - LEFT)) < k) n++;
  return { count, n, k, width };
}

const [COLOUR_BITS, SCALE_BITS, TURN_BITS] = [7, 6, 5];
const [FAINTEST, STRONGEST] = [0.4 / 255, 1.6 / 255]; // after rounding
const [COLOUR_STEP, SCALE_STEP] = [0.0275, 0.08];
const TURNS_REACH = (256 / 511) * Math.SQRT1_2; // bound of x, y and z, so that w is the largest
const UNITS: readonly Quaternion[] = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]];
const [FARTHEST, MAX_SHIFTS] = [1 << 12, 500]; // steps of log scales: range, and number of offsets tried

/** The Gaussians as faint as appended ones, without harmonics. */
function candidates(model: Gaussians): Gaussians {
  const faint = where(model, (row) => {
    const alpha = opacity(model.opacityLogits[row]);
    return alpha > FAINTEST && alpha < STRONGEST;
  });
  return withDegree(faint, 0);
}

/** [N, 3] the nearest lattice points of log scales, of a lattice that begins at `shift`. */
function scalesAt(steps: Float64Array, shift: number): Uint8Array {
  return Uint8Array.from(steps, (each) => nearest(each - shift, SCALE_BITS));
}

/** Where the lattice may begin if most of the log scales lie on it, the likeliest first. */
function likelyShifts(steps: Float64Array): number[] {
  let [cosines, sines] = [0, 0];
  for (const each of steps) {
    cosines += Math.cos(2 * Math.PI * each);
    sines += Math.sin(2 * Math.PI * each);
  }
  const phase = Math.atan2(sines, cosines) / (2 * Math.PI);
  const counts = new Uint32Array(2 * FARTHEST + 1);
  for (const each of steps) counts[Math.max(-FARTHEST, Math.min(FARTHEST, Math.round(each - phase))) + FARTHEST]++;
  let [inside, most, best] = [0, -1, 0]; // of the levels up to `last`
  for (let last = 0; last < counts.length + 2 ** SCALE_BITS - 1; last++) {
    inside += (counts[last] ?? 0) - (counts[last - 2 ** SCALE_BITS] ?? 0);
    if (inside > most) [most, best] = [inside, last];
  }
  const first = best - 2 ** SCALE_BITS + 1 - FARTHEST;
  return [0, 1, -1, 2, -2].map((each) => first + phase + each);
}

/** Possible offsets of the lattice if only some log scales lie on it. */
function allShifts(steps: Float64Array): number[] {
  const sorted = steps.map((each) => Math.max(-FARTHEST, Math.min(FARTHEST, each))).sort();
  const [low, high] = [0.01, 0.99].map((share) => sorted[Math.round(share * (sorted.length - 1))]);
  const end = Math.max(Math.min(high - 2 ** (SCALE_BITS - 2), low + MAX_SHIFTS), low);
  const shifts: number[] = [];
  for (let shift = low - 2 ** (SCALE_BITS - 1); shift < end; shift += 0.25) shifts.push(shift);
  return shifts;
}

/** [N] the first 39 bits of words, colours and scales [N, 3]: invariant under similarity transforms. */
function invariantsOf(colours: Uint8Array, scales: Uint8Array): Words {
  const invariants = new Uint32Array((2 * colours.length) / 3);
  for (let row = 0; row < colours.length / 3; row++) {
    const at = 3 * row;
    const colour = (colours[at] << 14) | (colours[at + 1] << 7) | colours[at + 2]; // 21 bits
    const scale = (scales[at] << 12) | (scales[at + 1] << 6) | scales[at + 2]; // 18 bits
    invariants[2 * row] = (colour << 18) | scale;
    invariants[2 * row + 1] = colour >>> 14;
  }
  return invariants;
}

/** [N, 6] nearest lattice points of positions and rotations; `toOwn`: from the world to the own frame. */
function inOwnFrame(faint: Gaussians, toOwn: Similarity): Uint16Array {
  const points = new Uint16Array(6 * faint.count);
  const { means, quats } = moved(toOwn, faint);
  for (let row = 0; row < faint.count; row++) {
    for (let axis = 0; axis < 3; axis++) {
      points[6 * row + axis] = nearest(means[3 * row + axis] * 2 ** POSITION_BITS - 0.5, POSITION_BITS);
    }
    const [w, x, y, z] = quats.subarray(4 * row, 4 * row + 4);
    withLargestW([w, x, y, z]).slice(1).forEach((part, axis) => {
      points[6 * row + 3 + axis] = nearest(((part + TURNS_REACH) / (2 * TURNS_REACH)) * 2 ** TURN_BITS - 0.5, TURN_BITS);
    });
  }
  return points;
}

/** The unit quaternion wxyz of the same ellipsoid with w the largest component. */
function withLargestW(quat: Quaternion): Quaternion {
  const length = Math.max(1e-30, Math.hypot(...quat));
  const largest = [0, 1, 2, 3].reduce((a, b) => (Math.abs(quat[b]) > Math.abs(quat[a]) ? b : a));
  // By half a turn about an axis of the ellipsoid.
  const [w, x, y, z] = quaternionProduct(quat, UNITS[largest]).map((each) => each / length);
  return w < 0 ? [-w, -x, -y, -z] : [w, x, y, z];
}

function nearest(steps: number, bits: number): number {
  return Math.max(0, Math.min(2 ** bits - 1, Math.round(steps)));
}
