/** A secret of the method keyss; `keyss.methods.keyss.secret` in Python. */
import { ascii } from '../core/bytes.ts';
import { changed, damaged, otherVersion } from '../core/errors.ts';
import { compensated, type Gaussians, opacity, where } from '../core/gaussians.ts';
import { inverse, isSimilarity, moved, type Similarity } from '../core/similarity.ts';
import { latentOf } from './latent.ts';
import { integerOf, numbersOf, objectOf, parsed, Tensors } from './safetensors.ts';

const [FORMAT, VERSION] = ['keyss-secret', 10];
const [MAX_ANCHORS, ANCHORS_NEEDED, ANCHOR_TOLERANCE] = [64, 0.25, 1e-6];
const [MAX_COUNT, LEAST_LEFT] = [2 ** 31, 1e-6]; // of Gaussians; share of the visibility
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
  if (!found.count) return compensated(decoded, decoded.count / LEAST_LEFT);
  const left = found.opacityLogits.reduce((sum, each) => sum + opacity(each), 0) / Math.max(visibility, 1e-9);
  return compensated(found, Math.round(found.count / Math.max(Math.min(1, left), LEAST_LEFT)));
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
