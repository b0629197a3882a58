/** Reader of appended Gaussians (docs/channels.md); counterpart of `keyss.channels.appended.channel` and `packets`. */
import { ascii, rowsOf, viewOf } from '../../core/bytes.ts';
import { damaged } from '../../core/errors.ts';
import type { Gaussians } from '../../core/gaussians.ts';
import { blockwise, decrypted, type Derive, expand, here } from '../../keys/keys.ts';
import { carriersOf } from '../colours/carriers.ts';
import { type Payload, type Reader, unpackPayload } from '../content.ts';
import { type Codewords, decoded } from '../reed_solomon.ts';
import { foreign } from '../sketch.ts';
import {
  allShifts, candidates, coloursOf, inOwnFrame, invariantsOf, likelyShifts, scalesAt, scaleSteps,
} from './lattice.ts';
import { type Found, LEAST, ONE_IN, pilotsOf, readPilots } from './pilots.ts';

// Gaussians sampled for pilots; number of lattice offsets tried, with at least this many standard deviations more pilots
// than by chance.
const [SAMPLE, TRIED, NOT_BY_CHANCE] = [8000, 8, 3];
const [HOST_BYTES, FOREIGN] = [132, 0.4]; // how many Gaussians of the cover are seen, and their sketch
const ASSOCIATED = ascii('keyss/v1/appended/data');

/** A model's appended Gaussians, prepared for any number of keys. */
export class AppendedReader implements Reader {
  readonly derivations = 1;

  private constructor(
    readonly salt: Uint8Array, private readonly words: TaggedWords, private readonly ids: Uint8Array,
  ) {}

  /** Null if there are none, or if their frame cannot be found. */
  static of(model: Gaussians): AppendedReader | null {
    const faint = candidates(model);
    if (faint.count < LEAST / 4) return null;
    const [colours, steps] = [coloursOf(faint), scaleSteps(faint)];
    for (const shifts of [likelyShifts, shiftsWithPilots]) {
      let best: { found: Found; scales: Uint8Array } | null = null;
      for (const shift of shifts(steps, colours)) {
        const scales = scalesAt(steps, shift);
        const found = readPilots(invariantsOf(colours, scales), faint.means);
        if (found && (best === null || found.agreeing > best.found.agreeing)) best = { found, scales };
      }
      if (best !== null) {
        const { found, scales } = best;
        const words = wordsOfPoints(colours, scales, inOwnFrame(faint, found.toOwn));
        return new AppendedReader(found.salt, words, new Uint8Array(carriersOf(model).ids.buffer));
      }
    }
    return null;
  }

  /** The content that `key` opens, or null. Raises InputError if too much was lost or changed. */
  async open(key: string, derive: Derive = here): Promise<Payload | null> {
    const secret = await derive(key, this.salt);
    for (const width of WIDTHS) {
      const codewords = readHeader(expand(secret, `appended/header/${width}`), this.words, width);
      if (codewords === null) continue;
      const packets = readPackets(expand(secret, 'appended/packets'), this.words, width);
      const encrypted = decoded(codewords, packets, true);
      const whole = await decrypted(expand(secret, 'appended/data'), encrypted, ASSOCIATED);
      if (whole.length < HOST_BYTES) throw damaged();
      const own = whole.subarray(4, HOST_BYTES);
      const told = foreign(expand(secret, 'appended/host'), this.ids, own, viewOf(whole).getUint32(0, true));
      const payload = unpackPayload(whole.subarray(HOST_BYTES));
      return told > (FOREIGN * this.ids.length) / 16 ? { ...payload, foreign: told } : payload;
    }
    return null;
  }
}

/** The offsets of the log-scale lattice with the most pilots. */
function shiftsWithPilots(steps: Float64Array, colours: Uint8Array): number[] {
  const count = Math.min(SAMPLE, steps.length / 3);
  const every = steps.length / 3 / count;
  const rows = Array.from({ length: count }, (_, at) => Math.floor(at * every));
  const [few, own] = [rowsOf(steps, rows, 3), rowsOf(colours, rows, 3)];
  const byChance = count / ONE_IN;
  return allShifts(few)
    .map((shift) => ({ shift, pilots: pilotsOf(invariantsOf(own, scalesAt(few, shift))).length }))
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

/** N words: data bytes, then a tag. */
interface TaggedWords {
  readonly count: number;
  readonly bytes: Uint8Array; // [N, 11]; the last four bits are zero
}

/** Words of colours, scales [N, 3] and positions and turns [N, 6]. */
function wordsOfPoints(colours: Uint8Array, scales: Uint8Array, others: Uint16Array): TaggedWords {
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
  return { count, bytes };
}

/** [number, data] of each word, as if all were packets. */
function readPackets(key: Uint8Array, { count, bytes }: TaggedWords, width: number): [number, Uint8Array][] {
  const found: [number, Uint8Array][] = [];
  const blocks = new Uint8Array(16 * count);
  for (let row = 0; row < count; row++) blocks.set(bytes.subarray(WORD_BYTES * row, WORD_BYTES * row + width), 16 * row);
  const encrypted = blockwise(key, blocks);
  for (let row = 0; row < count; row++) {
    let tag = 0;
    for (let byte = 0; byte < WORD_BYTES - width; byte++) {
      tag = 256 * tag + (bytes[WORD_BYTES * row + width + byte] ^ encrypted[16 * row + byte]); // may pass 2^32
    }
    found.push([Math.floor(tag / 16), blocks.subarray(16 * row, 16 * row + width)]);
  }
  return found;
}

/** The codewords by majority of the headers; null if too few agree. */
function readHeader(key: Uint8Array, words: TaggedWords, width: number): Codewords | null {
  const votes = new Uint32Array(1 << HEADER_BITS);
  for (const [number] of readPackets(key, words, width)) if (number < votes.length) votes[number]++;
  const header = votes.reduce((best, each, value) => (each > votes[best] ? value : best), 0);
  if (!(votes[header] >= AGREEING_HEADERS && header > 0)) return null;
  const count = Math.ceil(header / MAX_DATA);
  const k = Math.ceil(header / count);
  let n = k;
  while (n * LEFT - DEVIATIONS * Math.sqrt(n * LEFT * (1 - LEFT)) < k) n++;
  return { count, n, k, width };
}
