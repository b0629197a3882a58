/** Reader of SOG, version 2; `keyss.files.formats.sog` on the other side. */
import { InputError } from '../core/errors.ts';
import { coefficients, emptyGaussians, type Gaussians } from '../core/gaussians.ts';
import { checkCount, damagedFile, fromSmallestThree, logit } from './coded.ts';
import { checkedFinite } from './ply.ts';
import { browserPixels, type Pixels } from './webp.ts';
import { openZip } from './zip.ts';

const FINEST = 65535;
const LARGEST = 252; // of the fourth byte of a quaternion: w, x, y or z is not stored
const ROW = 64; // vectors of the palette in a row of pixels
const BOOK = 256;
const MOST_LABELS = 65536;

interface Meta {
  version: number;
  count: number;
  means: { mins: number[]; maxs: number[]; files: string[] };
  scales: { codebook: number[]; files: string[] };
  quats: { files: string[] };
  sh0: { codebook: number[]; files: string[] };
  shN?: { count: number; bands: number; codebook: number[]; files: string[] };
}

export async function readSog(bytes: Uint8Array, pixels: Pixels = browserPixels): Promise<Gaussians> {
  const file = openZip(bytes);
  const meta = checkedMeta(await file('meta.json'), bytes.length);
  const { count } = meta;
  const image = async (name: string): Promise<Uint8Array> => pixels(await file(name), count);
  const [low, high] = [await image(meta.means.files[0]), await image(meta.means.files[1])];
  const [quats, scales] = [await image(meta.quats.files[0]), await image(meta.scales.files[0])];
  const colours = await image(meta.sh0.files[0]);
  const degree = meta.shN?.bands ?? 0;
  const model = emptyGaussians(count, degree);
  const k = coefficients(degree);
  for (let row = 0; row < count; row++) {
    const largest = quats[4 * row + 3] - LARGEST;
    if (largest < 0) throw damagedFile();
    const others = [0, 1, 2].map((part) => ((quats[4 * row + part] / 255) * 2 - 1) * Math.sqrt(0.5));
    model.quats.set(fromSmallestThree(largest, others), 4 * row);
    for (let axis = 0; axis < 3; axis++) {
      const [min, max] = [meta.means.mins[axis], meta.means.maxs[axis]];
      const level = low[4 * row + axis] | (high[4 * row + axis] << 8);
      const log = min + (min === max ? 1 : max - min) * (level / FINEST);
      model.means[3 * row + axis] = Math.sign(log) * Math.expm1(Math.abs(log));
      model.logScales[3 * row + axis] = meta.scales.codebook[scales[4 * row + axis]];
      model.sh[3 * k * row + axis] = meta.sh0.codebook[colours[4 * row + axis]];
    }
    model.opacityLogits[row] = logit(colours[4 * row + 3]);
  }
  if (meta.shN && degree) await putHarmonics(model, meta.shN, file, pixels);
  return checkedFinite(model);
}

async function putHarmonics(
  model: Gaussians, shN: NonNullable<Meta['shN']>, file: (name: string) => Promise<Uint8Array>, pixels: Pixels,
): Promise<void> {
  const rest = coefficients(shN.bands) - 1;
  const labels = await pixels(await file(shN.files[1]), model.count);
  const size = Math.ceil(shN.count / ROW) * ROW;
  const palette = await pixels(await file(shN.files[0]), size * rest, ROW * rest);
  for (let row = 0; row < model.count; row++) {
    const label = labels[4 * row] | (labels[4 * row + 1] << 8);
    if (label >= shN.count) throw damagedFile();
    for (let each = 0; each < rest; each++) {
      for (let colour = 0; colour < 3; colour++) {
        const code = palette[4 * (label * rest + each) + colour];
        model.sh[3 * ((rest + 1) * row + each + 1) + colour] = shN.codebook[code];
      }
    }
  }
}

function checkedMeta(bytes: Uint8Array, size: number): Meta {
  let meta: Meta;
  try {
    meta = JSON.parse(new TextDecoder().decode(bytes)) as Meta;
    if (meta.version !== 2) throw new InputError('This SOG is of a version that cannot be read.');
    const { means, scales, quats, sh0, shN } = meta;
    const images = [[means.files, 2], [scales.files, 1], [quats.files, 1], [sh0.files, 1]] as [string[], number][];
    if (shN) images.push([shN.files, 2]);
    const named = images.every(([names, count]) => Array.isArray(names) && names.length >= count);
    if (!named || means.mins.length !== 3 || means.maxs.length !== 3) throw damagedFile();
    for (const book of [scales, sh0, ...(shN ? [shN] : [])]) book.codebook = checkedBook(book.codebook);
    const bands = shN?.bands ?? 0;
    if (shN && !(bands in [0, 1, 2, 3] && shN.count > 0 && shN.count <= MOST_LABELS)) throw damagedFile();
  } catch (error) {
    throw error instanceof InputError ? error : damagedFile();
  }
  checkCount(meta.count, size);
  return meta;
}

function checkedBook(book: number[]): number[] {
  const fine = Array.isArray(book) && book.length <= BOOK && book.every((each) => Number.isFinite(each));
  if (!fine) throw damagedFile();
  return [...book, ...new Array<number>(BOOK - book.length).fill(0)];
}
