/** Gaussians that carry bits, IDs, and salts; counterpart of `keyss.channels.colours.carriers`. */
import { sha256 } from '@noble/hashes/sha2.js';
import { ascii, bytesKey, joined, rowsOf } from '../../core/bytes.ts';
import { type Gaussians, opacity, where, withDegree } from '../../core/gaussians.ts';
import { multiplicities, type Words, wordsOf } from '../../core/words.ts';
import { encryptBlocks } from '../../keys/aes.ts';
import { expand, SALT_BYTES } from '../../keys/keys.ts';

const [SCALE_STEPS, COLOUR_STEPS, OPACITY_STEPS] = [16, 38.25, 255]; // quantisation steps of 8-bit formats per unit
const [COLOUR_NOISE, OPACITY_NOISE] = [0.344, 1.02]; // maximum rounding error, in steps
const SCALE_NOISE = 0.144;
const [RATIO_BIN, OPACITY_BIN, RED_BIN] = [4, 8, 3]; // steps
const MIN_OPACITY = 2.5 / 255;
const BINS = 30_000; // bins on either side of zero
const ID_VALUES = 8; // values of an ID: four, zero-padded to a block of AES

/** C Gaussians as a reader sees them. */
export interface Carriers {
  readonly count: number;
  readonly logScales: Float64Array; // [C, 3]
  readonly opacities: Float64Array; // [C]
  readonly colours: Float64Array; // [C, 3] constant coefficients
  readonly ids: Int16Array; // [C, ID_VALUES] bin indices: two scale ratios, opacity, red; zeros
  readonly errorProbability: Float64Array; // [C] probability that the ID has changed since writing
  readonly impact: Float64Array; // [C] visibility of a colour change
  readonly idCounts: Float64Array; // [C] carriers with the same ID, itself included
}

/** The visible Gaussians. `alignment`: offset of log scales, in steps, to undo a scaling of the model. */
export function carriersOf(model: Gaussians, alignment = 0): Carriers {
  const bare = withDegree(model, 0);
  const seen = where(bare, (row) => Math.fround(opacity(bare.opacityLogits[row])) > MIN_OPACITY);
  const [logScales, colours] = [Float64Array.from(seen.logScales), Float64Array.from(seen.sh)];
  const opacities = Float64Array.from(seen.opacityLogits, (logit) => Math.fround(opacity(logit)));
  const ids = new Int16Array(ID_VALUES * seen.count);
  const [errorProbability, impact] = [new Float64Array(seen.count), new Float64Array(seen.count)];
  for (let row = 0; row < seen.count; row++) {
    const [a, b, c] = logScales.subarray(3 * row, 3 * row + 3);
    const whole = [a, b, c].map((each) => binOf(each * SCALE_STEPS + 0.5 + alignment, 1, SCALE_NOISE));
    const ratios = [0, 1].map((axis) => {
      const [bin, edge] = binOf(whole[axis + 1][0] - whole[axis][0] + 0.5, RATIO_BIN, 1);
      return [bin, 2 * edge * (whole[axis][1] + whole[axis + 1][1])];
    });
    const seenAs = binOf(opacities[row] * OPACITY_STEPS - 0.5, OPACITY_BIN, OPACITY_NOISE);
    const bins = [...ratios, seenAs, binOf(colours[3 * row] * COLOUR_STEPS, RED_BIN, COLOUR_NOISE)];
    bins.forEach(([bin], column) => (ids[ID_VALUES * row + column] = bin));
    errorProbability[row] = 1 - bins.reduce((product, [, each]) => product * (1 - each), 1);
    impact[row] = Math.max(a + b, a + c, b + c) + 2 * Math.log(Math.max(1e-3, ((seenAs[0] + 0.5) * OPACITY_BIN) / OPACITY_STEPS));
  }
  const idCounts = Float64Array.from(multiplicities(new Uint32Array(ids.buffer).filter((_, at) => at % 4 < 2))); // by the four values
  return { count: seen.count, logScales, opacities, colours, ids, errorProbability, impact, idCounts };
}

/** The bin of width `steps` of a value, and the probability that noise moved it there. */
function binOf(value: number, steps: number, noise: number): [number, number] {
  const bin = Math.floor(value / steps);
  const inside = value - bin * steps;
  const nearest = Math.min(inside, steps - inside);
  return [Math.max(-BINS, Math.min(BINS, bin)), Math.max(0, Math.min(0.5, (noise - nearest) / (2 * noise)))];
}

/** The carriers of these rows. */
export function chosen({ logScales, opacities, colours, ids, errorProbability, impact, idCounts }: Carriers, rows: ArrayLike<number>): Carriers {
  return {
    count: rows.length, logScales: rowsOf(logScales, rows, 3), opacities: rowsOf(opacities, rows, 1),
    colours: rowsOf(colours, rows, 3), ids: rowsOf(ids, rows, ID_VALUES), errorProbability: rowsOf(errorProbability, rows, 1),
    impact: rowsOf(impact, rows, 1), idCounts: rowsOf(idCounts, rows, 1),
  };
}

/** [C, 2] words for ids [C, ID_VALUES], pseudo-random without the secret: AES-256 of the IDs. */
export function randomPairs(secret: Uint8Array, label: string, ids: Int16Array): Words {
  const bytes = new Uint8Array(ids.buffer, ids.byteOffset, ids.byteLength);
  return wordsOf(encryptBlocks(expand(secret, `colours/${label}`), bytes));
}

/** [C, 2] numbers in [0, 1) for ids [C, ID_VALUES]. */
export function fractions(secret: Uint8Array, label: string, ids: Int16Array): Float64Array {
  const words = randomPairs(secret, label, ids);
  return Float64Array.from({ length: words.length >> 1 }, (_, at) => {
    return (words[2 * at + 1] * 2 ** 21 + (words[2 * at] >>> 11)) / 2 ** 53;
  });
}

const SALTS = 16; // maximum number of salts
const BANDS = [0.08, 0.4, 1.01]; // limits of two opacity bands with half of the salts each
const [SALT_OPACITY_BIN, SALT_RATIO_BIN, SALT_COLOUR_BIN] = [16, 8, 5]; // steps
const LABEL = ascii('keyss/v1/colours-salt');

/** Up to 16 salts of 16 bytes. */
export function saltsOf({ count, logScales, opacities, colours }: Carriers): Uint8Array[] {
  const bins = new Int16Array(6 * count);
  const ids = new Int16Array(8 * count); // the first four bins, zero-padded to a block of AES
  const stable = Array.from({ length: count }, (_, row) => {
    const ratio = (axis: number) => (logScales[3 * row + axis + 1] - logScales[3 * row + axis]) * SCALE_STEPS - 0.5;
    const own = [
      binOf(opacities[row] * OPACITY_STEPS - 0.5, SALT_OPACITY_BIN, OPACITY_NOISE),
      ...[0, 1].map((axis) => binOf(ratio(axis), SALT_RATIO_BIN, 1)),
      ...[0, 1, 2].map((column) => binOf(colours[3 * row + column] * COLOUR_STEPS, SALT_COLOUR_BIN, COLOUR_NOISE)),
    ];
    own.forEach(([bin], column) => (bins[6 * row + column] = bin));
    ids.set(bins.subarray(6 * row, 6 * row + 4), 8 * row);
    return own.slice(0, 4).every(([, errorProbability]) => errorProbability === 0);
  });
  const hashes = fractions(sha256(LABEL), 'salt', ids);
  const salts = new Map<string, Uint8Array>();
  BANDS.slice(1).forEach((high, band) => {
    const listed = new Map<number, number>(); // the first Gaussian with each hash
    opacities.forEach((each, row) => {
      const hash = hashes[2 * row];
      if (stable[row] && each > BANDS[band] && each <= high && !listed.has(hash)) listed.set(hash, row);
    });
    for (const [, row] of [...listed].sort(([a], [b]) => a - b).slice(0, SALTS / (BANDS.length - 1))) {
      const salt = sha256(joined(LABEL, new Uint8Array(bins.slice(6 * row, 6 * row + 6).buffer))).slice(0, SALT_BYTES);
      salts.set(bytesKey(salt), salt);
    }
  });
  return [...salts.values()];
}
