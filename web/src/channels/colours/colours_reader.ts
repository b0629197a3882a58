/** Reader of colours (docs/channels.md); counterpart of `keyss.channels.colours.colours_channel`, `header` and `qim`. */
import { hmac } from '@noble/hashes/hmac.js';
import { sha256 } from '@noble/hashes/sha2.js';
import { ascii, joined, quantile } from '../../core/bytes.ts';
import { InputError, tooMuchLost } from '../../core/errors.ts';
import type { Gaussians } from '../../core/gaussians.ts';
import { mix, type Words } from '../../core/words.ts';
import { expand, here, SALT_BYTES } from '../../keys/keys.ts';
import { keySecret, type Payload, type Reader, unsealed } from '../container.ts';
import { type Carriers, carriersOf, chosen, fractions, randomPairs, saltsOf } from './carriers.ts';
import { Fountain, NOISY } from './fountain.ts';

const CHANGED = 0.03; // share of carriers that are overwritten after hiding
const MAX_RATE = 4; // data bits per code bit
const ALIGNMENTS = 4; // offsets of log scales tried
const [FOREIGN, DEVIATIONS] = [0.25, 4]; // share of foreign carriers that is told; standard errors

export function coloursReader(model: Gaussians): Reader {
  const alignments = Array.from({ length: ALIGNMENTS }, (_, each) => carriersOf(model, each / ALIGNMENTS));
  const salts = [STATIC_SALT, ...saltsOf(alignments[0])];
  return {
    derivations: salts.length,
    async open(key, derive = here) {
      const [fixed, ...salted] = (await Promise.all(salts.map((salt) => derive(key, salt)))).map(keySecret);
      const secrets = { fixed, salted };
      const headers = alignments.map((carriers) => readHeader(secrets, carriers));
      for (const [index, header] of headers.entries()) {
        if (header === null) continue;
        const carriers = alignments[index];
        for (const shift of header.level === ONE ? [0] : [0, shiftOf(header, carriers)]) {
          const payload = await payloadOf(header, secrets, carriers, shift);
          if (payload !== null) return payload;
        }
      }
      if (headers.some((each) => each !== null)) throw tooMuchLost();
      return null;
    },
  };
}

/** The payload decrypted by the header's key, or null. */
async function payloadOf(header: Header, secrets: Secrets, carriers: Carriers, shift: number): Promise<Payload | null> {
  const rows = ownRows(header, secrets, carriers);
  const used = chosen(carriers, rows);
  const bits = bitCounts(used.impact.map((each) => each - shift), header.level);
  const sure: number[] = [];
  bits.forEach((count, row) => {
    const each = (header.occupancy * (1 - CHANGED) * (1 - used.errorProbability[row])) / used.idCounts[row];
    for (let bit = 0; bit < COLUMNS * count; bit++) sure.push(each);
  });
  if (8 * header.size > MAX_RATE * sure.length) return null;
  const [values, seeds, code] = [readBits(header.key, used, bits), seedsOf(header.key, 'seeds', used, bits), new Fountain(8 * header.size)];
  const data = code.decode(seeds, values.map((value, at) => value * sure[at]));
  let payload: Payload;
  try {
    payload = (await unsealed(header.key, packBits(data)))[1];
  } catch (error) {
    if (error instanceof InputError) return null;
    throw error;
  }
  const written = code.encode(data, seeds);
  const agreement = values.map((value, at) => value * (1 - 2 * written[at])); // -1 to 1
  const share = foreignShareOf(agreement, header, used, bits, partWeights(carriers, rows));
  return share > FOREIGN ? { ...payload, foreign: Math.round(share * carriers.count) } : payload;
}

/** Weights of `rows` as a part of the model: by area x opacity up to the mean, equal IDs once. */
function partWeights({ count, logScales, opacities, idCounts }: Carriers, rows: readonly number[]): number[] {
  const sizes = Array.from(opacities, (opacity, row) => {
    const [, b, c] = logScales.slice(3 * row, 3 * row + 3).sort();
    return Math.exp(Math.max(-80, Math.min(80, b + c))) * opacity;
  });
  const mean = Math.max(1e-300, sizes.reduce((sum, each) => sum + each, 0) / count);
  return rows.map((row) => Math.min(1, sizes[row] / mean) / idCounts[row]);
}

/** The share of foreign carriers that is certain: the agreement of foreign ones is 0 in the mean. */
function foreignShareOf(
  agreement: Float64Array, header: Header, used: Carriers, bits: Uint8Array, weights: readonly number[],
): number {
  let [agreed, expected, variance, at] = [0, 0, 0, 0];
  bits.forEach((count, row) => {
    const held = header.occupancy * (1 - used.errorProbability[row]);
    for (let end = at + COLUMNS * count; at < end; at++) {
      const most = weights[row] * Math.abs(agreement[at]);
      agreed += weights[row] * agreement[at];
      expected += held * most;
      variance += most ** 2 * (1 - held ** 2);
    }
  });
  return Math.max(0, 1 - (agreed + DEVIATIONS * Math.sqrt(variance)) / Math.max(1e-9, expected));
}

const STATIC_SALT = sha256(ascii('keyss/v1/colours-static')).slice(0, SALT_BYTES);
const FILE_KEY_BYTES = 5;
const SHARES = 256; // parts of the carriers, shared out to payloads
const IDLE = 1 / 255; // unit of the share of unmodified carriers
const PLACES = 80; // Gaussians of a header under each salt
const PILOTS = 10; // places whose bits are known
const DEPTHS = [1, 2]; // bits per value
const PLAIN_BYTES = FILE_KEY_BYTES + 6;
const CHECK_BYTES = 2;
const PRIOR = 0.4; // prior log odds that a salt is genuine
const TRIES = 3; // rounds of reweighting salts
const DECODED = 0.3; // weight of decoded bits relative to known ones
const HELD = 0.5; // probability that a place is intact
const MEDIAN_STEPS = 8; // per unit of the median impact
const CODE = new Fountain(8 * (PLAIN_BYTES + CHECK_BYTES), NOISY);

/** The secrets of one key in one file: one shared by all files, and one per salt. */
interface Secrets {
  readonly fixed: Uint8Array;
  readonly salted: readonly Uint8Array[];
}

/** Parameters for reading a payload. */
interface Header {
  readonly key: Uint8Array; // data key of the payload
  readonly partition: Uint8Array; // assigns carriers to parts
  readonly level: number; // see `bitCounts`
  readonly first: number; // first of the payload's parts of the carriers, below SHARES
  readonly last: number; // last part, inclusive
  readonly size: number; // bytes of the payload
  readonly occupancy: number; // share of the payload's carriers in use
  readonly median: number; // median impact at hiding, in MEDIAN_STEPS, modulo 256
}

/** Null if there is none; one attempt in 2^16 finds one by chance, which opens nothing. */
function readHeader(secrets: Secrets, carriers: Carriers): Header | null {
  const places = secrets.salted.map((secret) => placesOf(secret, carriers));
  const [one, two] = DEPTHS.map((depth) => readAt(depth, secrets, carriers, places));
  return one ?? two;
}

/** The header with `depth` bits in each number of its places. */
function readAt(depth: number, { fixed, salted }: Secrets, carriers: Carriers, places: readonly Places[]): Header | null {
  const [words, hints, owners]: [number[], number[], number[]] = [[], [], []];
  const odds = salted.map((secret, salt) => {
    const { rows, pilots } = places[salt];
    const own = chosen(carriers, rows);
    const bits = new Uint8Array(rows.length).fill(depth);
    const seeds = seedsOf(secret, 'header-seeds', own, bits);
    let sum = PRIOR;
    readBits(secret, own, bits).forEach((read, at) => {
      const place = Math.floor(at / (COLUMNS * depth));
      const hint = (HELD * (1 - own.errorProbability[place]) * read) / own.idCounts[place];
      if (pilots[place]) {
        sum += Math.log1p(hint);
      } else {
        hints.push(hint);
        words.push(seeds[2 * at], seeds[2 * at + 1]);
        owners.push(salt);
      }
    });
    return sum;
  });
  const seeds = Uint32Array.from(words);
  const agreement = new Float64Array(odds.length);
  let header: Header | null = null;
  for (let attempt = 0; attempt < TRIES; attempt++) { // no early exit, so that right and wrong keys take equally long
    const trust = odds.map((each, salt) => 1 / (1 + Math.exp(-each - DECODED * agreement[salt])));
    const decoded = CODE.decode(seeds, hints.map((hint, at) => hint * trust[owners[at]]));
    const data = packBits(decoded);
    const check = hmac(sha256, expand(fixed, 'colours/check'), data.subarray(0, PLAIN_BYTES));
    if (!header && data.subarray(PLAIN_BYTES).every((each, at) => each === check[at])) header = unpacked(fixed, data);
    agreement.fill(0);
    CODE.encode(decoded, seeds).forEach((bit, at) => (agreement[owners[at]] += Math.log1p(bit ? -hints[at] : hints[at])));
  }
  return header;
}

function unpacked(fixed: Uint8Array, data: Uint8Array): Header {
  const [level, first, last, bucket, idle, middle] = data.subarray(FILE_KEY_BYTES, PLAIN_BYTES);
  const partition = data.slice(0, FILE_KEY_BYTES);
  const key = expand(joined(fixed, partition), 'colours/data-key');
  const size = (16 + (bucket % 16)) << (Math.floor(bucket / 16) + 1); // 32 to 2 million
  return { key, partition, level, first, last, size, occupancy: 1 - idle * IDLE, median: middle };
}

/** [C] the payload's carriers, without those of headers. */
function ownRows(header: Header, { salted }: Secrets, carriers: Carriers): number[] {
  const taken = new Set(salted.flatMap((secret) => placesOf(secret, carriers).rows));
  const parts = fractions(header.partition, 'partition', carriers.ids);
  return [...Array(carriers.count).keys()].filter((row) => {
    const part = Math.floor(SHARES * parts[2 * row]);
    return part >= header.first && part <= header.last && !taken.has(row);
  });
}

/** Increase of the median impact since the header was written. */
function shiftOf(header: Header, { impact }: Carriers): number {
  const off = MEDIAN_STEPS * quantile(impact, 0.5) - header.median + 128;
  return (off - Math.floor(off / 256) * 256 - 128) / MEDIAN_STEPS;
}

/** The carriers with the PLACES IDs chosen by a secret, and which of them are pilots. */
interface Places {
  readonly rows: readonly number[];
  readonly pilots: readonly boolean[];
}

function placesOf(secret: Uint8Array, { ids }: Carriers): Places {
  const numbers = fractions(secret, 'places', ids).filter((_, at) => at % 2 === 0);
  const least: number[] = [];
  for (const each of numbers.slice().sort()) {
    if (each !== least.at(-1) && least.push(each) > PLACES) break;
  }
  const rows = [...numbers.keys()].filter((row) => numbers[row] < (least[PLACES] ?? 1));
  return { rows, pilots: rows.map((row) => numbers[row] < (least[PILOTS] ?? 1)) };
}

/** Packs bits into bytes, most significant first. */
function packBits(bits: Uint8Array): Uint8Array {
  const bytes = new Uint8Array(Math.ceil(bits.length / 8));
  bits.forEach((bit, at) => (bytes[at >> 3] |= bit << (7 - (at & 7))));
  return bytes;
}

const COLUMNS = 2; // modulated values per Gaussian
const ONE = 0; // level at which every value carries one bit
const MAX_BITS = 5; // maximum bits per value
const SPACING = 0.0275; // distance of neighbouring points
const BIT = Math.log(4); // impact per bit; a level is a quarter of a bit
const MIDDLE = 24; // level at which an impact of zero carries nothing
const NOISE = 0.23; // standard deviation of rounding, in spacings
const POINTS = [-1, 0, 1, 2]; // candidate points, relative to the one below

/** [C] bits per value of carriers: more at higher levels, one less per factor 4 of impact. */
function bitCounts(impact: Float64Array, level: number): Uint8Array {
  if (level === ONE) return new Uint8Array(impact.length).fill(1);
  return Uint8Array.from(impact, (each) => Math.max(0, Math.min(MAX_BITS, Math.floor((level - MIDDLE) / 4 - each / BIT))));
}

/** [B] the seeds of all bits of carriers, for the fountain; `bits` [C]: of each number. */
function seedsOf(secret: Uint8Array, label: string, { ids }: Carriers, bits: Uint8Array): Words {
  const [pairs, seeds] = [randomPairs(secret, label, ids), [] as number[]];
  bits.forEach((count, row) => {
    for (let column = 0; column < COLUMNS; column++) {
      for (let bit = 0; bit < count; bit++) {
        const [low, high] = mix(column * MAX_BITS + bit);
        seeds.push(...mix(pairs[4 * row] ^ low, pairs[4 * row + 1] ^ high));
      }
    }
  });
  return Uint32Array.from(seeds);
}

/**
 * [B] P(0) - P(1) of all bits of carriers, `bits` [C] in each number: dithered quantisation index modulation with soft decisions.
 */
function readBits(secret: Uint8Array, { ids, colours }: Carriers, bits: Uint8Array): Float64Array {
  const [dithers, differences] = [fractions(secret, 'dither', ids), [] as number[]];
  bits.forEach((count, row) => {
    const period = 2 ** count;
    for (let column = 0; column < COLUMNS; column++) {
      const off = colours[3 * row + 1 + column] / SPACING - dithers[COLUMNS * row + column] * period;
      const place = off - Math.floor(off / period) * period;
      const points = POINTS.map((each) => Math.floor(place) + each);
      const weights = points.map((point) => Math.exp(-((place - point) ** 2) / (2 * NOISE ** 2)));
      const all = weights.reduce((sum, each) => sum + each);
      for (let bit = count - 1; bit >= 0; bit--) {
        const signed = weights.map((weight, at) => {
          const label = points[at] & (period - 1);
          return ((label ^ (label >> 1)) >> bit) & 1 ? -weight : weight;
        });
        differences.push(signed.reduce((sum, each) => sum + each) / all);
      }
    }
  });
  return Float64Array.from(differences);
}
