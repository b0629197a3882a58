/** A secret of the method keyss; `keyss.methods.keyss.secret` in Python. */
import { changed, damaged, otherVersion } from '../core/errors.ts';
import { compensated, type Gaussians, opacity, where } from '../core/gaussians.ts';
import { inverse, isSimilarity, moved, type Similarity } from '../core/similarity.ts';
import { ascii } from '../core/bytes.ts';
import { decodeNetwork, shapeOf, tensorOf } from './decoder.ts';
import { decodeLatent } from './latent.ts';
import { numbersOf, objectOf, parsed, readTensors } from './safetensors.ts';

const FORMAT = 'keyss-secret';
const VERSION = 10;
const LEAST = 1e-6; // share of the visibility that is left
const [MAX_ANCHORS, ANCHORS_NEEDED, ANCHOR_TOLERANCE] = [64, 0.25, 1e-6];
const MAX_COUNT = 2 ** 31;
const DRAWN_OPACITY = Math.fround(1 / 255);
const APPENDED_OPACITY = 1.1 / 255;
const APPENDED_LOGIT = Math.fround(Math.log(APPENDED_OPACITY / (1 - APPENDED_OPACITY)));

/** What the payload reveals of a model, and how many Gaussians there were. Raises InputError. */
export function decodeKeyss(payload: Uint8Array, stego: Gaussians): { gaussians: Gaussians; hidden: number } {
  const read = readTensors(payload);
  const header = objectOf(parsed(ascii(String(read.metadata.keyss))));
  if (header.format !== FORMAT) throw damaged();
  if (header.version !== VERSION) throw otherVersion();
  const [count, visibility] = [header.count, header.visibility] as number[];
  if (!Number.isInteger(count) || count < 0 || count > MAX_COUNT || !(visibility >= 0)) throw damaged();
  const [frame, shape] = [frameOf(objectOf(header.frame)), shapeOf(objectOf(header.shape))];
  const own = where(stego, (row) => stego.opacityLogits[row] !== APPENDED_LOGIT);
  checkAnchors(read.tensors.get('anchors'), stego);
  const key = tensorOf(read, 'key', shape.keySize).values;
  const decoded = (shape.kind === 'latent' ? decodeLatent : decodeNetwork)(shape, read, key, own);
  return { gaussians: moved(inverse(frame), drawn(decoded, visibility)), hidden: count };
}

/** Without what is never drawn, unless that is all, making up for what is missing of the sum of all opacities. */
function drawn(decoded: Gaussians, visibility: number): Gaussians {
  const found = where(decoded, (row) => Math.fround(opacity(decoded.opacityLogits[row])) >= DRAWN_OPACITY);
  if (!found.count) return decoded;
  const seen = found.opacityLogits.reduce((sum, each) => sum + opacity(each), 0);
  const left = Math.max(Math.min(1, seen / Math.max(visibility, 1e-9)), LEAST);
  return compensated(found, Math.round(found.count / left));
}

function frameOf(described: Record<string, unknown>): Similarity {
  const rows = described.rotation;
  if (!Array.isArray(rows) || rows.length !== 3) throw damaged();
  const [scale] = numbersOf([described.scale], 1);
  const rotation = rows.flatMap((row) => numbersOf(row, 3));
  const found = { scale, rotation, translation: numbersOf(described.translation, 3) };
  if (!isSimilarity(found)) throw damaged();
  return found;
}

/** Raises InputError unless enough of some positions are there: what was moved or rounded no decoder fits. */
function checkAnchors(anchors: { shape: readonly number[]; values: Float32Array } | undefined, stego: Gaussians): void {
  const [count, axes] = anchors?.shape ?? [];
  if (!anchors || anchors.shape.length !== 2 || axes !== 3 || count < 1 || count > MAX_ANCHORS) throw damaged();
  const { means } = stego;
  const [low, high] = [[Infinity, Infinity, Infinity], [-Infinity, -Infinity, -Infinity]];
  means.forEach((each, at) => {
    low[at % 3] = Math.min(low[at % 3], each);
    high[at % 3] = Math.max(high[at % 3], each);
  });
  const tolerance = (ANCHOR_TOLERANCE * Math.max(...high.map((each, axis) => each - low[axis]))) ** 2;
  let found = 0;
  for (let anchor = 0; anchor < count; anchor++) {
    const [x, y, z] = anchors.values.subarray(3 * anchor, 3 * anchor + 3);
    for (let at = 0; at < means.length; at += 3) {
      if ((means[at] - x) ** 2 + (means[at + 1] - y) ** 2 + (means[at + 2] - z) ** 2 <= tolerance) {
        found++;
        break;
      }
    }
  }
  if (found < ANCHORS_NEEDED * count) throw changed();
}
