/** A secret of the method keyss, of either version; `keyss.methods.keyss.secret` in Python. */
import { changed, damaged, otherVersion } from '../core/errors.ts';
import { compensated, type Gaussians, opacity, where } from '../core/gaussians.ts';
import { inverse, isSimilarity, moved, type Similarity } from '../core/similarity.ts';
import { ascii } from '../core/bytes.ts';
import { Decoder } from './decoder.ts';
import { decodeRows } from './rows.ts';
import { numbersOf, objectOf, parsed, readTensors } from './safetensors.ts';

const FORMAT = 'keyss-secret';
const [NETWORK, ROWS] = [8, 9]; // versions: by a decoder, or row by row
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
  if (header.version !== NETWORK && header.version !== ROWS) throw otherVersion();
  const count = header.count as number;
  if (!Number.isInteger(count) || count < 0 || count > MAX_COUNT) throw damaged();
  const frame = frameOf(objectOf(header.frame));
  const own = where(stego, (row) => stego.opacityLogits[row] !== APPENDED_LOGIT);
  if (header.version === NETWORK) checkAnchors(read.tensors.get('anchors'), stego);
  const left = header.version === ROWS ? decodeRows(header, read, own) : drawn(Decoder.of(header.shape, read).decode(own), count);
  return { gaussians: moved(inverse(frame), left), hidden: count };
}

/** Without what is never drawn, unless that is all, making up for what was lost of `count` Gaussians. */
function drawn(decoded: Gaussians, count: number): Gaussians {
  const found = where(decoded, (row) => Math.fround(opacity(decoded.opacityLogits[row])) >= DRAWN_OPACITY);
  return found.count ? compensated(found, count) : decoded;
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
