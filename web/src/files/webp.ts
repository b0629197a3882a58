/** Pixels of lossless WebP images, by the browser; exact, because they are never multiplied by their alpha. */
import { viewOf } from '../core/bytes.ts';
import { damaged } from '../core/errors.ts';

const SMALL_IMAGE = 1 << 16; // pixels; larger ones may have four times the pixels that are needed

/** [count, 4] RGBA of the first pixels; `width`: what it has to have. Raises InputError. */
export type Pixels = (data: Uint8Array, count: number, width?: number) => Promise<Uint8Array>;

export const browserPixels: Pixels = async (data, count, width) => {
  const [w, h] = sizeOf(data);
  const fits = w * h >= count && (width === undefined || w === width);
  if (!fits || w * h > Math.max(SMALL_IMAGE, 4 * count)) throw damaged();
  let image: ImageBitmap;
  try {
    image = await createImageBitmap(new Blob([data as BlobPart], { type: 'image/webp' }), {
      premultiplyAlpha: 'none', colorSpaceConversion: 'none',
    });
  } catch {
    throw damaged();
  }
  const gl = new OffscreenCanvas(1, 1).getContext('webgl2');
  if (gl === null || image.width !== w || image.height !== h) throw damaged();
  gl.pixelStorei(gl.UNPACK_PREMULTIPLY_ALPHA_WEBGL, false);
  gl.pixelStorei(gl.UNPACK_COLORSPACE_CONVERSION_WEBGL, gl.NONE);
  gl.bindTexture(gl.TEXTURE_2D, gl.createTexture());
  gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA, gl.RGBA, gl.UNSIGNED_BYTE, image);
  gl.bindFramebuffer(gl.FRAMEBUFFER, gl.createFramebuffer());
  gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, gl.getParameter(gl.TEXTURE_BINDING_2D), 0);
  const pixels = new Uint8Array(4 * w * h);
  gl.readPixels(0, 0, w, h, gl.RGBA, gl.UNSIGNED_BYTE, pixels);
  const failed = gl.getError() !== gl.NO_ERROR;
  image.close();
  gl.getExtension('WEBGL_lose_context')?.loseContext();
  if (failed) throw damaged();
  return pixels.subarray(0, 4 * count);
};

/** Width and height of the header. Raises InputError for what is no lossless WebP. */
export function sizeOf(data: Uint8Array): [number, number] {
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
