/** Secrets of the design `latent`; `keyss.methods.keyss.latent` and `keyss.channels.harmonics` in Python say why. */
import { sha256 } from '@noble/hashes/sha2.js';
import { fieldsOf, IDENTITY_BYTES, identities } from '../channels/low_bits/bits.ts';
import { CellCipher } from '../channels/low_bits/cells.ts';
import { bytesKey, joined, viewOf } from '../core/bytes.ts';
import { changed, damaged } from '../core/errors.ts';
import { coefficients, emptyGaussians, type Gaussians, withDegree } from '../core/gaussians.ts';
import { expand } from '../keys/keys.ts';
import { type Shape, tensorOf } from './decoder.ts';
import type { Tensors } from './safetensors.ts';

const KEPT = 4; // harmonics of a channel, those of degrees 0 and 1, that are as they were
const [OWN, MOST, LEAST_KEPT] = [13, 24, 2]; // latents without the code, latents at most, directions of the cover's
const [SHARE, GUARD] = [4, 1 / 256];
const NONCE_BYTES = 16;
const ROUNDING = 1e-10;
const MAX_EXPONENT = 80;
const RANKS = [0, ...Array.from({ length: 31 }, (_, at) => 1 / (1 + Math.exp(7 - (14 * at) / 30))), 1];

/** The Gaussians that the harmonics of `model` hold for a key. Raises InputError for damage, and where there are none. */
export function decodeLatent(shape: Shape, read: Tensors, key: Float32Array, model: Gaussians): Gaussians {
  const width = 3 * (coefficients(shape.shDegree) - KEPT);
  const count = Math.min(MOST, Math.floor((width - LEAST_KEPT) / shape.secrets)); // latents
  if (count < OWN) throw damaged();
  const all = count * shape.secrets;
  const numbers = (name: string, ...size: number[]): Float32Array => tensorOf(read, `decoder.${name}`, ...size).values;
  const place = {
    width, all, directions: numbers('place.directions', width, all), slopes: numbers('place.slopes', 2, all),
    quantiles: numbers('place.quantiles', all, RANKS.length),
  };
  const [knots, basis] = [numbers('knots', count, RANKS.length), numbers('basis', count - OWN, width + 9)];
  const seed = joined(new Uint8Array(Float32Array.from(key).buffer), Uint8Array.from(numbers('nonce', NONCE_BYTES)));
  const own = withDegree(model, shape.shDegree);
  const bare = withDegree(model, 0);
  const names = identities(bare, fieldsOf(bare));
  const pads = viewOf(new CellCipher(expand(sha256(seed), 'latents', 32), 'pad', 4 * count).stream(names));
  const found: Float64Array[] = [];
  const seen = new Set<string>(); // copies of a row count once
  for (let row = 0; row < model.count; row++) {
    const end = 3 * coefficients(shape.shDegree) * (row + 1);
    const ranks = ranksOf(place, own.sh.subarray(end - width, end));
    const name = bytesKey(names.subarray(IDENTITY_BYTES * row, IDENTITY_BYTES * (row + 1)));
    if (!ranks || seen.has(name)) continue;
    const latents = new Float64Array(count);
    let fits = true;
    for (let at = 0; at < count && fits; at++) {
      const pad = pads.getUint32(4 * (count * row + at), true) / 2 ** 32;
      const rank = ranks[count * shape.secret + at] - pad;
      const inside = SHARE * (rank - Math.floor(rank));
      fits = inside <= 1;
      const share = Math.min(1, Math.max(0, (inside - GUARD) / (1 - 2 * GUARD)));
      latents[at] = interpolated(share, RANKS, knots.subarray(RANKS.length * at, RANKS.length * (at + 1)));
    }
    if (!fits) continue;
    seen.add(name);
    found.push(latents);
  }
  if (!found.length) throw changed();
  return gaussiansOf(found, basis, shape.shDegree);
}

interface Place {
  readonly width: number; // harmonics above degree 1
  readonly all: number; // directions
  readonly directions: Float32Array; // [width, all]
  readonly slopes: Float32Array; // [2, all]
  readonly quantiles: Float32Array; // [all, 33]
}

/** [all] the ranks that were written into harmonics [width]; null where there is nothing. */
function ranksOf({ width, all, directions, slopes, quantiles }: Place, harmonics: Float32Array): Float64Array | null {
  const [written, kept] = [new Float64Array(all), Float64Array.from(harmonics)];
  for (let at = 0; at < width; at++) for (let j = 0; j < all; j++) written[j] += harmonics[at] * directions[all * at + j];
  for (let at = 0; at < width; at++) for (let j = 0; j < all; j++) kept[at] -= written[j] * directions[all * at + j];
  let power = kept.reduce((sum, each) => sum + each * each, 0);
  if (!(power > ROUNDING * harmonics.reduce((sum, each) => sum + each * each, 0))) return null;
  return written.map((each, j) => {
    const level = Math.sqrt(power / (width - all + j));
    const exponent = slopes[j] + slopes[all + j] * Math.log(level);
    const spread = Math.exp(Math.min(MAX_EXPONENT, Math.max(-MAX_EXPONENT, exponent)));
    power += each * each;
    return interpolated(each / spread, quantiles.subarray(RANKS.length * j, RANKS.length * (j + 1)), RANKS);
  });
}

/** The number at `x` on the line through the points (xs, ys), whose ends it does not leave. */
function interpolated(x: number, xs: ArrayLike<number>, ys: ArrayLike<number>): number {
  let [low, high] = [0, xs.length - 1];
  if (!(x > xs[low])) return ys[low];
  if (x >= xs[high]) return ys[high];
  while (high - low > 1) {
    const middle = (low + high) >> 1;
    if (xs[middle] <= x) low = middle;
    else high = middle;
  }
  return ys[low] + ((x - xs[low]) / (xs[high] - xs[low])) * (ys[high] - ys[low]);
}

function gaussiansOf(latents: Float64Array[], basis: Float32Array, shDegree: number): Gaussians {
  const found = emptyGaussians(latents.length, shDegree);
  const width = 3 * coefficients(shDegree);
  latents.forEach((own, row) => {
    found.opacityLogits[row] = own[0];
    const [x, y, z] = own.subarray(1, 4);
    found.quats.set([Math.sqrt(Math.max(0, 1 - x * x - y * y - z * z)), x, y, z], 4 * row);
    found.logScales.set(own.subarray(4, 7), 3 * row);
    found.means.set(own.subarray(7, 10), 3 * row);
    const sh = new Float64Array(width);
    sh.set(own.subarray(10, OWN));
    for (let code = OWN; code < own.length; code++) {
      for (let at = 3; at < width; at++) sh[at] += own[code] * basis[(width - 3) * (code - OWN) + at - 3];
    }
    found.sh.set(sh, width * row);
  });
  return found;
}
