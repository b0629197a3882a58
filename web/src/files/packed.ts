/** The container of .sog: a ZIP archive, stored or deflated, of lossless WebP images. */
import { inflate, viewOf } from '../core/bytes.ts';
import { damaged, InputError } from '../core/errors.ts';

const [END, CENTRAL, LOCAL] = [0x06054b50, 0x02014b50, 0x04034b50];
const MAX_MEMBERS = 64;
const MAX_END_BYTES = 65557; // of the end record with its comment
export const SMALL = 1 << 20; // bytes that archives of any size may inflate to

/** A function that reads a member by name. Raises InputError for damaged archives. */
export function openZip(bytes: Uint8Array): (name: string) => Promise<Uint8Array> {
  const view = viewOf(bytes);
  let end = bytes.length - 22;
  const last = Math.max(0, bytes.length - MAX_END_BYTES);
  while (end >= last && view.getUint32(end, true) !== END) end--;
  if (end < last) throw damaged();
  const count = view.getUint16(end + 10, true);
  if (count > MAX_MEMBERS) throw damaged();
  const members = new Map<string, { method: number; packed: number; size: number; at: number }>();
  let at = view.getUint32(end + 16, true);
  for (let index = 0; index < count; index++) {
    if (at + 46 > bytes.length || view.getUint32(at, true) !== CENTRAL) throw damaged();
    const [nameSize, extra, comment] = [28, 30, 32].map((offset) => view.getUint16(at + offset, true));
    const name = new TextDecoder().decode(bytes.subarray(at + 46, at + 46 + nameSize));
    members.set(name, {
      method: view.getUint16(at + 10, true), packed: view.getUint32(at + 20, true),
      size: view.getUint32(at + 24, true), at: view.getUint32(at + 42, true),
    });
    at += 46 + nameSize + extra + comment;
  }
  const whole = [...members.values()].reduce((sum, { size }) => sum + size, 0);
  const places = new Set([...members.values()].map((each) => each.at));
  if (places.size < members.size || whole > 2 * bytes.length + SMALL) throw damaged();
  return async (name) => {
    const found = members.get(name);
    if (!found || found.at + 30 > bytes.length || view.getUint32(found.at, true) !== LOCAL) throw damaged();
    const start = found.at + 30 + view.getUint16(found.at + 26, true) + view.getUint16(found.at + 28, true);
    const data = bytes.subarray(start, start + found.packed);
    if (data.length !== found.packed) throw damaged();
    if (found.method === 0) return data;
    if (found.method === 8) return inflate(data, 'deflate-raw', found.size);
    throw damaged();
  };
}

const SMALL_IMAGE = 1 << 16; // pixels; larger images may have at most four times the pixels needed

/** Decodes a lossless WebP to RGBA, row by row, not premultiplied by alpha. */
export type Decode = (webp: Uint8Array) => Promise<Uint8Array>;

/** [count, 4] RGBA of the first pixels of an image, of this `width` if given. Raises InputError. */
export type Pixels = (data: Uint8Array, count: number, width?: number) => Promise<Uint8Array>;

export function pixelReader(decode: Decode): Pixels {
  return async (data, count, width) => {
    const [w, h] = sizeOf(data);
    const fits = w * h >= count && (width === undefined || w === width);
    if (!fits || w * h > Math.max(SMALL_IMAGE, 4 * count)) throw damaged();
    const pixels = await decode(data);
    if (pixels.length !== 4 * w * h) throw damaged();
    return pixels.subarray(0, 4 * count);
  };
}

/** By WebGL: a 2D canvas would premultiply by alpha. */
export const decodeInBrowser: Decode = async (webp) => {
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
  const text = (at: number): string => String.fromCharCode(...data.subarray(at, at + 4));
  if (data.length < 30 || text(0) !== 'RIFF' || text(8) !== 'WEBP') throw damaged();
  if (text(12) === 'VP8L') {
    const bits = viewOf(data).getUint32(21, true);
    return [(bits & 0x3fff) + 1, ((bits >>> 14) & 0x3fff) + 1];
  }
  const three = (at: number): number => data[at] | (data[at + 1] << 8) | (data[at + 2] << 16);
  if (text(12) === 'VP8X') return [three(24) + 1, three(27) + 1];
  throw damaged();
}
