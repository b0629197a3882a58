/**
 * Secrets of the method keyss with the design `latent`: `keyss.methods.keyss.keyss_secret`, `keyss.methods.keyss.decoder` and
 * `keyss.channels.harmonics` in Python say why.
 */
import { sha256 } from '@noble/hashes/sha2.js';
import { fieldsOf, gaussianIds, ID_BYTES } from '../channels/quiet/bits.ts';
import { CellCipher } from '../channels/quiet/cells.ts';
import { ascii, bytesKey, joined } from '../core/bytes.ts';
import { changed, damaged, otherVersion } from '../core/errors.ts';
import { coefficients, emptyGaussians, type Gaussians, opacity, where, withDegree } from '../core/gaussians.ts';
import { inverse, isSimilarity, moved, type Similarity } from '../core/similarity.ts';
import { wordsOf } from '../core/words.ts';
import { expand } from '../keys/keys.ts';
import { integerOf, numbersOf, objectOf, parsed, Tensors } from './safetensors.ts';

const [FORMAT, VERSION] = ['keyss-secret', 10];
const [MAX_ANCHORS, ANCHORS_NEEDED, ANCHOR_TOLERANCE] = [64, 0.25, 1e-6];
const MAX_COUNT = 2 ** 31; // of Gaussians
const [GROWTH, LEAST_LEFT, COMPLETE] = [0.25, 0.1, 0.99]; // exponent; shares that are left
const DRAWN_OPACITY = Math.fround(1 / 255);
const APPENDED_OPACITY = 1.00001 / 255;
const APPENDED_LOGIT = Math.fround(Math.log(APPENDED_OPACITY / (1 - APPENDED_OPACITY)));

/** The Gaussians that a payload reveals of a model; null for designs other than `latent`. Raises InputError. */
export function decodeKeyss(payload: Uint8Array, stego: Gaussians): Gaussians | null {
  const tensors = Tensors.of(payload);
  const header = objectOf(parsed(ascii(String(tensors.metadata.keyss))));
  if (header.format !== FORMAT) throw damaged();
  if (header.version !== VERSION) throw otherVersion();
  objectOf(header, 'format', 'version', 'shape', 'frame', 'count', 'visibility');
  if (objectOf(header.shape).kind !== 'latent') return null;
  const [frame, [visibility]] = [frameOf(header.frame), numbersOf([header.visibility], 1)];
  integerOf(header.count, 0, MAX_COUNT);
  const anchors = tensors.take('anchors', integerOf(tensors.shapeOf('anchors')[0], 1, MAX_ANCHORS), 3);
  const decode = latentOf(header.shape, tensors);
  if (visibility < 0 || !tensors.done) throw damaged();
  checkAnchors(anchors, stego);
  // What was appended came after the training.
  const own = where(stego, (row) => stego.opacityLogits[row] !== APPENDED_LOGIT);
  return moved(inverse(frame), drawn(decode(own), visibility));
}

/** Without what is never drawn, unless that is all, making up for what was lost of the sum of opacities. */
function drawn(decoded: Gaussians, visibility: number): Gaussians {
  const found = where(decoded, (row) => Math.fround(opacity(decoded.opacityLogits[row])) >= DRAWN_OPACITY);
  if (!found.count) return compensated(decoded, 0);
  const left = found.opacityLogits.reduce((sum, each) => sum + opacity(each), 0) / Math.max(visibility, 1e-9);
  return compensated(found, left);
}

/** The Gaussians that are `left` of a pruned model, a share, made denser and larger; see `compensate_pruning`. */
function compensated(gaussians: Gaussians, left: number): Gaussians {
  if (left >= COMPLETE) return gaussians;
  const share = Math.max(left, LEAST_LEFT);
  const opacityLogits = gaussians.opacityLogits.map((logit) => {
    const rest = Math.min(Math.max(1 - Math.fround(opacity(logit)), 1e-7), 1 - 1e-7);
    const opaque = 1 - Math.max(rest ** (1 / share), 1e-7);
    return Math.log(opaque / (1 - opaque));
  });
  const grown = Math.fround(GROWTH * Math.log(1 / share));
  return { ...gaussians, opacityLogits, logScales: gaussians.logScales.map((each) => each + grown) };
}

function frameOf(value: unknown): Similarity {
  const described = objectOf(value, 'scale', 'rotation', 'translation');
  const rows = described.rotation;
  if (!Array.isArray(rows) || rows.length !== 3) throw damaged();
  const [scale] = numbersOf([described.scale], 1);
  const rotation = rows.flatMap((row) => numbersOf(row, 3));
  const found = { scale, rotation, translation: numbersOf(described.translation, 3) };
  if (!isSimilarity(found)) throw damaged();
  return found;
}

/** Raises InputError unless enough of some positions are there: what was moved or rounded no decoder fits. */
function checkAnchors(anchors: Float32Array, { means }: Gaussians): void {
  const count = anchors.length / 3;
  const [low, high] = [[Infinity, Infinity, Infinity], [-Infinity, -Infinity, -Infinity]];
  means.forEach((each, at) => {
    low[at % 3] = Math.min(low[at % 3], each);
    high[at % 3] = Math.max(high[at % 3], each);
  });
  const tolerance = (ANCHOR_TOLERANCE * Math.max(...high.map((each, axis) => each - low[axis]))) ** 2;
  let found = 0;
  for (let anchor = 0; anchor < count; anchor++) {
    const [x, y, z] = anchors.subarray(3 * anchor, 3 * anchor + 3);
    for (let at = 0; at < means.length; at += 3) {
      if ((means[at] - x) ** 2 + (means[at + 1] - y) ** 2 + (means[at + 2] - z) ** 2 <= tolerance) {
        found++;
        break;
      }
    }
  }
  if (found < ANCHORS_NEEDED * count) throw changed();
}

const KEPT = 3 * coefficients(1); // numbers of the harmonics that hold nothing
const [OWN, LEAST_KEPT] = [13, 2]; // latents without the code; directions that hold none
const [ONE, TWO] = [24, 14]; // latents of one secret at most, and of each of two
const [SHARE, GUARD, ROUNDING] = [4, 1 / 256, 1e-10];
const [NONCE_BYTES, ROWS] = [16, 1 << 14]; // rows at a time
const MAX_EXPONENT = 80; // of a spread
const RANKS = [0, ...Array.from({ length: 31 }, (_, at) => 1 / (1 + Math.exp(7 - (14 * at) / 30))), 1];
const MAX_KEY = 4096; // numbers
const SHAPE = ['kind', 'mask', 'hidden', 'branch', 'sh_degree', 'key_size', 'released', 'secrets', 'secret'];

/**
 * A function that maps a model to the Gaussians of a secret. Raises InputError for other tensors than the `shape` needs, as does
 * the function where no row is the secret's.
 */
function latentOf(shape: unknown, tensors: Tensors): (model: Gaussians) => Gaussians {
  const described = objectOf(shape, ...SHAPE);
  const [shDegree, secrets] = [integerOf(described.sh_degree, 0, 3), integerOf(described.secrets, 1, 9)];
  const secret = integerOf(described.secret, 0, secrets - 1);
  const key = tensors.take('key', integerOf(described.key_size, 1, MAX_KEY));
  const harmonics = 3 * coefficients(shDegree);
  const high = Math.max(0, harmonics - KEPT);
  const count = Math.min(secrets > 1 ? TWO : ONE, Math.floor((high - LEAST_KEPT) / secrets));
  if (count < OWN) throw damaged();
  const [written, first] = [count * secrets, count * secret];
  const directions = tensors.take('decoder.place.directions', high, written);
  const slopes = tensors.take('decoder.place.slopes', 3, written);
  const quantiles = rows(tensors.take('decoder.place.quantiles', written, RANKS.length), RANKS.length);
  const basis = rows(tensors.take('decoder.basis', count - OWN, harmonics - 3), harmonics - 3);
  const knots = rows(tensors.take('decoder.knots', count, RANKS.length), RANKS.length);
  const nonce = Uint8Array.from(tensors.take('decoder.nonce', NONCE_BYTES));
  const seed = sha256(joined(new Uint8Array(key.buffer, key.byteOffset, 4 * key.length), nonce));
  const cipher = new CellCipher(expand(seed, 'latents'), 'pad', 4 * count);
  const [along, latents] = [new Float64Array(written), new Float32Array(count)];

  /** Whether a row is the secret's: then its latents are in `latents`. */
  function decrypt(numbers: Float32Array, pads: Uint32Array): boolean {
    along.fill(0);
    for (let at = 0; at < high; at++) {
      for (let j = 0; j < written; j++) along[j] += numbers[at] * directions[at * written + j];
    }
    let [power, whole, before] = [0, 0, 0];
    for (let at = 0; at < high; at++) {
      let rest = numbers[at];
      for (let j = 0; j < written; j++) rest -= along[j] * directions[at * written + j];
      [power, whole] = [power + rest ** 2, whole + numbers[at] ** 2];
    }
    if (power <= ROUNDING * whole) return false;
    for (let j = 0; j < first + count; before += along[j++] ** 2) {
      const own = j - first;
      if (own < 0) continue;
      const earlier = j && Math.log(Math.max(before, ROUNDING * power) / j) / 2;
      const kept = Math.log(power / (high - written)) / 2;
      const exponent = slopes[j] + slopes[written + j] * kept + slopes[2 * written + j] * earlier;
      const spread = Math.exp(Math.min(MAX_EXPONENT, Math.max(-MAX_EXPONENT, exponent)));
      const turned = interpolated(along[j] / spread, quantiles[j], RANKS) - pads[own] / 2 ** 32;
      const inside = SHARE * (turned - Math.floor(turned));
      if (!(inside <= 1)) return false;
      latents[own] = interpolated((inside - GUARD) / (1 - 2 * GUARD), RANKS, knots[own]);
    }
    return true;
  }

  return (published) => {
    const [model, bare] = [withDegree(published, shDegree), withDegree(published, 0)];
    const ids = gaussianIds(bare, fieldsOf(bare));
    const [found, seen] = [emptyGaussians(model.count, shDegree), new Set<string>()];
    let pads: Uint32Array = new Uint32Array(0);
    for (let row = 0; row < model.count; row++) {
      const at = row % ROWS;
      if (!at) pads = wordsOf(cipher.pads(ids.subarray(ID_BYTES * row, ID_BYTES * (row + ROWS))));
      const numbers = model.sh.subarray(harmonics * row + KEPT, harmonics * (row + 1));
      if (!decrypt(numbers, pads.subarray(count * at, count * (at + 1)))) continue;
      const [to, name] = [seen.size, bytesKey(ids.subarray(ID_BYTES * row, ID_BYTES * (row + 1)))];
      if (seen.has(name)) continue; // a copy of another row
      seen.add(name);
      const [opacity, x, y, z] = latents;
      found.opacityLogits[to] = opacity;
      found.quats.set([Math.sqrt(Math.max(0, 1 - x * x - y * y - z * z)), x, y, z], 4 * to);
      found.logScales.set(latents.subarray(4, 7), 3 * to);
      found.means.set(latents.subarray(7, 10), 3 * to);
      found.sh.set(latents.subarray(10, OWN), harmonics * to);
      const colours = found.sh.subarray(harmonics * to + 3, harmonics * (to + 1));
      colours.forEach((_, j) => (colours[j] = basis.reduce((sum, each, code) => sum + each[j] * latents[OWN + code], 0)));
      if (!colours.every(Number.isFinite)) throw damaged();
    }
    if (!seen.size) throw changed();
    return where(found, (row) => row < seen.size);
  };
}

function rows(table: Float32Array, width: number): Float32Array[] {
  return Array.from({ length: table.length / width }, (_, row) => table.subarray(row * width, (row + 1) * width));
}

/** The value at x of the line through points with ascending `from` and any `to`, which ends level. */
function interpolated(x: number, from: ArrayLike<number>, to: ArrayLike<number>): number {
  let [low, high] = [0, from.length - 1];
  if (!(x > from[low])) return x <= from[low] ? to[low] : NaN;
  if (x >= from[high]) return to[high];
  while (high - low > 1) {
    const middle = (low + high) >> 1;
    if (x >= from[middle]) low = middle;
    else high = middle;
  }
  return to[low] + ((to[high] - to[low]) * (x - from[low])) / (from[high] - from[low]);
}
