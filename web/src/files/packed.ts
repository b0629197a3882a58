/** The container of .sog: a ZIP archive, stored or deflated, of lossless WebP images. */
import { unzipSync } from 'fflate';
import { viewOf } from '../core/bytes.ts';
import { damaged, InputError } from '../core/errors.ts';

const MAX_MEMBERS = 64;
export const SMALL = 1 << 20; // bytes that archives of any size may inflate to

/** The members of an archive by name. Raises InputError for damaged archives. */
export function unzipped(bytes: Uint8Array): Record<string, Uint8Array | undefined> {
  let [members, whole] = [0, 0];
  try {
    return unzipSync(bytes, {
      filter: ({ size, originalSize }) => {
        whole += Math.max(size, originalSize); // before allocating
        if (++members > MAX_MEMBERS || whole > 2 * bytes.length + SMALL) throw damaged();
        return true;
      },
    });
  } catch {
    throw damaged();
  }
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
