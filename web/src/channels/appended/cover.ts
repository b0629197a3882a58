/** What a payload knows of its cover: a sketch of its Gaussians; counterpart of `keyss.channels.appended.cover`. */
import { viewOf } from '../../core/bytes.ts';
import { coefficients, type Gaussians, opacity } from '../../core/gaussians.ts';
import { movedPoint, type Similarity } from '../../core/similarity.ts';
import { expand } from '../../keys/keys.ts';
import { foreignShare, ID_BYTES } from '../base.ts';

// Of three positions (in sides of the cube), three log scales, opacity and three colours: bins, and maximum rounding errors.
const BINS = [1 / 16, 1 / 16, 1 / 16, 0.5, 0.5, 0.5, 0.1, 0.3, 0.3, 0.3];
const ERRORS = [0.002, 0.002, 0.002, 0.035, 0.035, 0.035, 0.005, 0.016, 0.016, 0.016];
const LOW = [-7, -7, -7, -8, -8, -8, 0, -1.7, -1.7, -1.7]; // formats may clip numbers outside of these
const HIGH = [7, 7, 7, 4, 4, 4, 1, 1.7, 1.7, 1.7];
const VISIBLE = 3.5 / 255; // minimum opacity; 8 bits round none across it
const SKETCH_BYTES = 128;

const [MORE, GONE] = [1.25, 0.02]; // factor by which formats may increase the number of faint Gaussians; share of the sample
const TESTED = 0.1; // share of the visible Gaussians; about a third are not next to a border
const SKETCH = 12; // after three numbers

export const COVER_BYTES = SKETCH + SKETCH_BYTES;

/** About how many of a model's Gaussians are foreign to the cover that `packed` describes; 0 if they are at most a `share`. */
export function foreignCount(packed: Uint8Array, model: Gaussians, toOwn: Similarity, secret: Uint8Array, share: number): number {
  const view = viewOf(packed);
  const [before, faint] = [view.getUint32(0, true), model.opacityLogits.reduce((sum, each) => sum + Number(opacity(each) <= VISIBLE), 0)];
  const more = faint > MORE * before ? faint - before : 0; // a hundred of them in one place are visible
  const [count, area] = [Math.max(1, view.getUint32(4, true)), Math.max(1e-30, view.getFloat32(8, true))];
  const [larger, width] = [Math.log(toOwn.scale), 3 * coefficients(model.shDegree)];
  const offsets = Array.from(expand(secret, 'bins').subarray(0, BINS.length), (byte) => (byte + 0.5) / 256);
  const ids = new Int8Array(ID_BYTES * model.count);
  const among: number[] = [];
  for (let row = 0; row < model.count; row++) {
    const numbers = [
      ...movedPoint(toOwn, model.means.subarray(3 * row, 3 * row + 3)),
      ...model.logScales.subarray(3 * row, 3 * row + 3).map((each) => each + larger),
      opacity(model.opacityLogits[row]),
      ...model.sh.subarray(width * row, width * row + 3),
    ];
    if (!(numbers.every(Number.isFinite) && numbers[6] > VISIBLE)) continue;
    const bins = numbers.map((each, at) => binOf(each, at, offsets[at]));
    if (bins.some((bin) => bin === null)) continue; // a format may have moved it from another bin
    const middles = bins.map((bin, at) => (bin! + 0.5 - offsets[at]) * BINS[at]);
    const [, b, c] = middles.slice(3, 6).sort((x, y) => x - y);
    const size = Math.exp(b + c) * Math.max(0.02, Math.min(1, middles[6])) / area;
    ids.set(bins as number[], ID_BYTES * among.length);
    among.push(Math.max(8 * SKETCH_BYTES, Math.round(2 / (1 / count + size))));
  }
  const own = new Uint8Array(ids.buffer, 0, ID_BYTES * among.length);
  const visible = model.count - faint;
  const gone = among.length > TESTED * visible ? GONE : 0; // else most have one number, next to a border
  const found = foreignShare(secret, own, packed.subarray(SKETCH), among, gone);
  return more + (found > share ? Math.round(found * visible) : 0);
}

/** The bin of a number; null if it is next to a border. */
function binOf(value: number, at: number, offset: number): number | null {
  const inside = Math.max(LOW[at], Math.min(HIGH[at], value));
  const step = inside / BINS[at] + offset;
  const bin = Math.floor(step);
  const near = Math.min(step - bin, bin + 1 - step) < ERRORS[at] / BINS[at];
  return near && inside > LOW[at] && inside < HIGH[at] ? null : bin;
}
