/** Reader of appended Gaussians (docs/channels.md); counterpart of `keyss.channels.appended.channel`. */
import { ascii, rowsOf, viewOf } from '../../core/bytes.ts';
import { damaged } from '../../core/errors.ts';
import type { Gaussians } from '../../core/gaussians.ts';
import { decrypted, type Derive, expand } from '../../keys/keys.ts';
import { here } from '../../keys/pool.ts';
import { carriersOf } from '../colours/carriers.ts';
import { type Payload, type Reader, unpackPayload } from '../content.ts';
import { decoded } from '../reed_solomon.ts';
import { foreign } from '../sketch.ts';
import {
  allShifts, candidates, coloursOf, inOwnFrame, invariantsOf, likelyShifts, scalesAt, scaleSteps,
} from './lattice.ts';
import { readHeader, readPackets, type TaggedWords, WIDTHS, wordsOfPoints } from './packets.ts';
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
      const codewords = readHeader(expand(secret, `appended/header/${width}`, 32), this.words, width);
      if (codewords === null) continue;
      const packets = readPackets(expand(secret, 'appended/packets', 32), this.words, width);
      const encrypted = decoded(codewords, packets, true);
      const whole = await decrypted(expand(secret, 'appended/data', 32), encrypted, ASSOCIATED);
      if (whole.length < HOST_BYTES) throw damaged();
      const own = whole.subarray(4, HOST_BYTES);
      const told = foreign(expand(secret, 'appended/host', 32), this.ids, own, viewOf(whole).getUint32(0, true));
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
