/** Reader of SOG, version 2, a ZIP archive of lossless WebP images; counterpart of `keyss.files.formats.sog`. */
import { unzipSync } from 'fflate';
import { bytesKey, viewOf } from '../core/bytes.ts';
import { damaged, InputError } from '../core/errors.ts';
import { coefficients, type Gaussians } from '../core/gaussians.ts';
import { fromSmallestThree, gaussiansOf, holds } from './coded.ts';
import { checkFinite } from './ply.ts';

export const FINEST = 65535; // largest position code
export const LARGEST = 252; // a quaternion's fourth byte: this plus the index (wxyz) of the component left out
const ROW = 64; // palette vectors per row of pixels
const BOOK = 256;
const MAX_LABELS = 65536;

interface Meta {
  version: number;
  count: number;
  means: { mins: number[]; maxs: number[]; files: string[] };
  scales: { codebook: number[]; files: string[] };
  quats: { files: string[] };
  sh0: { codebook: number[]; files: string[] };
  shN?: { count: number; bands: number; codebook: number[]; files: string[] };
}

/** All values of a file. */
export interface SogCodes {
  readonly kind: 'sog';
  readonly count: number;
  readonly mins: readonly number[]; // [3] bounds of positions, as sign(x) ln(|x| + 1)
  readonly maxs: readonly number[]; // [3]
  readonly positions: Uint16Array; // [N, 3] 65535ths between the bounds
  readonly quats: Uint8Array; // [N, 4] three components of a quaternion, then 252 + the index of the fourth
  readonly scaleBook: Float32Array; // [256] log scales
  readonly scales: Uint8Array; // [N, 4] three codebook indices
  readonly colourBook: Float32Array; // [256] constant harmonics
  readonly colours: Uint8Array; // [N, 4] three codebook indices, then opacity in 255ths
  readonly shDegree: number;
  readonly labels: Uint16Array; // [N] palette indices; 0 without harmonics
  readonly harmonicBook: Float32Array; // [256]
  readonly palette: Uint8Array; // [P, K - 1, 4] three codebook indices
}

export async function readSog(
  bytes: Uint8Array, decode: Decode = decodeInBrowser,
): Promise<Gaussians & { readonly codes: SogCodes }> {
  const codes = await parse(bytes, decode);
  return { ...checkFinite(dequantiseSog(codes)), codes };
}

async function parse(bytes: Uint8Array, decode: Decode): Promise<SogCodes> {
  const members = unzipped(bytes);
  const { count, means, quats, scales, sh0, shN } = parseMeta(members.get('meta.json'), bytes.length);
  const image = (name: string): Promise<Uint8Array> => pixelsOf(decode, members.get(name), count);
  const [low, high] = [await image(means.files[0]), await image(means.files[1])];
  const positions = new Uint16Array(3 * count);
  for (let row = 0; row < count; row++) {
    for (let axis = 0; axis < 3; axis++) positions[3 * row + axis] = low[4 * row + axis] | (high[4 * row + axis] << 8);
  }
  const rest = coefficients(shN?.bands ?? 0) - 1;
  let [labels, palette] = [new Uint16Array(count), new Uint8Array(0) as Uint8Array];
  if (shN && rest) {
    const pairs = await image(shN.files[1]);
    labels = labels.map((_, row) => pairs[4 * row] | (pairs[4 * row + 1] << 8));
    if (labels.some((label) => label >= shN.count)) throw damaged();
    palette = await pixelsOf(decode, members.get(shN.files[0]), Math.ceil(shN.count / ROW) * ROW * rest, ROW * rest);
  }
  return {
    kind: 'sog', count, mins: means.mins, maxs: means.maxs, positions, quats: await image(quats.files[0]),
    scaleBook: Float32Array.from(scales.codebook), scales: await image(scales.files[0]),
    colourBook: Float32Array.from(sh0.codebook), colours: await image(sh0.files[0]),
    shDegree: shN?.bands ?? 0, labels, harmonicBook: Float32Array.from(shN?.codebook ?? []), palette,
  };
}

/** Raises InputError for an impossible rotation. */
export function dequantiseSog(codes: SogCodes): Gaussians {
  const { count, mins, maxs, positions, quats, scaleBook, scales, colourBook, colours, labels, harmonicBook, palette } = codes;
  const rest = coefficients(codes.shDegree) - 1;
  return gaussiansOf(count, codes.shDegree, {
    mean: (row, axis) => {
      const [min, max] = [mins[axis], maxs[axis]];
      const log = min + (min === max ? 1 : max - min) * (positions[3 * row + axis] / FINEST);
      return Math.sign(log) * Math.expm1(Math.abs(log));
    },
    logScale: (row, axis) => scaleBook[scales[4 * row + axis]],
    quat: (row) => {
      const [largest, three] = [quats[4 * row + 3] - LARGEST, quats.subarray(4 * row, 4 * row + 3)];
      if (largest < 0) throw damaged();
      return fromSmallestThree(largest, Array.from(three, (code) => ((code / 255) * 2 - 1) * Math.sqrt(0.5)));
    },
    opacity: (row) => colours[4 * row + 3],
    sh: (row, index, channel) => {
      if (index === 0) return colourBook[colours[4 * row + channel]];
      return harmonicBook[palette[4 * (labels[row] * rest + index - 1) + channel]];
    },
  });
}

function parseMeta(bytes: Uint8Array | undefined, size: number): Meta {
  let meta: Meta;
  if (!bytes || bytes.length > SMALL) throw damaged();
  try {
    meta = JSON.parse(new TextDecoder().decode(bytes)) as Meta;
    if (meta.version !== 2) throw new InputError('This SOG is of a version that cannot be read.');
    const { means, scales, quats, sh0, shN } = meta;
    const images = [[means.files, 2], [scales.files, 1], [quats.files, 1], [sh0.files, 1]] as [string[], number][];
    if (shN) images.push([shN.files, 2]);
    const named = images.every(([names, count]) => Array.isArray(names) && names.length >= count);
    if (!named || means.mins.length !== 3 || means.maxs.length !== 3) throw damaged();
    for (const book of [scales, sh0, ...(shN ? [shN] : [])]) book.codebook = paddedBook(book.codebook);
    const bands = shN?.bands ?? 0;
    if (shN && !(bands in [0, 1, 2, 3] && shN.count > 0 && shN.count <= MAX_LABELS)) throw damaged();
  } catch (error) {
    throw error instanceof InputError ? error : damaged();
  }
  if (!holds(size, meta.count)) throw damaged();
  return meta;
}

function paddedBook(book: number[]): number[] {
  const fine = Array.isArray(book) && book.length <= BOOK && book.every((each) => Number.isFinite(each));
  if (!fine) throw damaged();
  return [...book, ...new Array<number>(BOOK - book.length).fill(0)];
}

const MAX_MEMBERS = 64;
const SMALL = 1 << 20; // bytes that archives of any size may inflate to

/** The members of an archive by name. Raises InputError for damaged archives. */
export function unzipped(bytes: Uint8Array): Map<string, Uint8Array> {
  let [members, whole] = [0, 0];
  try {
    const found = unzipSync(bytes, {
      filter: ({ size, originalSize }) => {
        whole += Math.max(size, originalSize); // before allocating
        if (++members > MAX_MEMBERS || whole > 2 * bytes.length + SMALL) throw damaged();
        return true;
      },
    });
    return new Map(Object.entries(found));
  } catch {
    throw damaged();
  }
}

const SMALL_IMAGE = 1 << 16; // pixels; larger images may have at most four times the pixels needed

/** Decodes a lossless WebP to RGBA, row by row, not premultiplied by alpha. */
export type Decode = (webp: Uint8Array) => Promise<Uint8Array>;

/** [count, 4] RGBA of the first pixels of an image, of this `width` if given. Raises InputError. */
async function pixelsOf(decode: Decode, data: Uint8Array | undefined, count: number, width?: number): Promise<Uint8Array> {
  if (!data) throw damaged();
  const [w, h] = sizeOf(data);
  const fits = w * h >= count && (width === undefined || w === width);
  if (!fits || w * h > Math.max(SMALL_IMAGE, 4 * count)) throw damaged();
  const pixels = await decode(data);
  if (pixels.length !== 4 * w * h) throw damaged();
  return pixels.subarray(0, 4 * count);
}

/** By WebGL: a 2D canvas would premultiply by alpha. */
const decodeInBrowser: Decode = async (webp) => {
  if (typeof OffscreenCanvas === 'undefined') throw new InputError('This .sog has images, which only browsers decode.');
  let image: ImageBitmap;
  try {
    image = await createImageBitmap(new Blob([webp as BlobPart], { type: 'image/webp' }), {
      premultiplyAlpha: 'none', colorSpaceConversion: 'none',
    });
  } catch {
    throw damaged();
  }
  const gl = new OffscreenCanvas(1, 1).getContext('webgl2');
  if (gl === null) throw damaged();
  gl.pixelStorei(gl.UNPACK_PREMULTIPLY_ALPHA_WEBGL, false);
  gl.pixelStorei(gl.UNPACK_COLORSPACE_CONVERSION_WEBGL, gl.NONE);
  gl.bindTexture(gl.TEXTURE_2D, gl.createTexture());
  gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA, gl.RGBA, gl.UNSIGNED_BYTE, image);
  gl.bindFramebuffer(gl.FRAMEBUFFER, gl.createFramebuffer());
  gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, gl.getParameter(gl.TEXTURE_BINDING_2D), 0);
  const pixels = new Uint8Array(4 * image.width * image.height);
  gl.readPixels(0, 0, image.width, image.height, gl.RGBA, gl.UNSIGNED_BYTE, pixels);
  const failed = gl.getError() !== gl.NO_ERROR;
  image.close();
  gl.getExtension('WEBGL_lose_context')?.loseContext();
  if (failed) throw damaged();
  return pixels;
};

/** [width, height] from the header of a lossless WebP. Raises InputError. */
function sizeOf(data: Uint8Array): [number, number] {
  const text = (at: number): string => bytesKey(data.subarray(at, at + 4));
  if (data.length < 30 || text(0) !== 'RIFF' || text(8) !== 'WEBP') throw damaged();
  if (text(12) === 'VP8L') {
    const bits = viewOf(data).getUint32(21, true);
    return [(bits & 0x3fff) + 1, ((bits >>> 14) & 0x3fff) + 1];
  }
  const three = (at: number): number => data[at] | (data[at + 1] << 8) | (data[at + 2] << 16);
  if (text(12) === 'VP8X') return [three(24) + 1, three(27) + 1];
  throw damaged();
}
