/** The part of glTF 2.0 that Gaussians need, from strangers; `keyss.files.formats.gltf` on the other side. */
import { viewOf } from '../core/bytes.ts';
import { damagedFile } from './coded.ts';

export const EXTENSION = 'KHR_gaussian_splatting';
const HEADER_BYTES = 12;
const CHUNK_BYTES = 8;
const [MAGIC, JSON_CHUNK, BINARY_CHUNK] = [0x46546c67, 0x4e4f534a, 0x004e4942];
const WIDTHS: Record<string, number> = { SCALAR: 1, VEC2: 2, VEC3: 3, VEC4: 4 };
// By the number of a component's type: its bytes, its largest value where it is an integer, and how it is read.
const COMPONENTS: Record<number, [number, number, (view: DataView, at: number) => number]> = {
  5120: [1, 127, (view, at) => view.getInt8(at)],
  5121: [1, 255, (view, at) => view.getUint8(at)],
  5122: [2, 32767, (view, at) => view.getInt16(at, true)],
  5123: [2, 65535, (view, at) => view.getUint16(at, true)],
  5125: [4, 4294967295, (view, at) => view.getUint32(at, true)],
  5126: [4, 0, (view, at) => view.getFloat32(at, true)],
};

interface Accessor {
  count: number;
  type: string;
  componentType: number;
  bufferView?: number;
  byteOffset?: number;
  normalized?: boolean;
  sparse?: object;
}

interface BufferView {
  buffer: number;
  byteOffset?: number;
  byteLength?: number;
  byteStride?: number;
}

export interface Node {
  mesh?: number;
  children?: number[];
  matrix?: number[];
  translation?: number[];
  rotation?: number[];
  scale?: number[];
}

export interface Primitive {
  attributes: Record<string, number>;
  extensions?: Record<string, Record<string, unknown>>;
}

export interface Document {
  scene?: number;
  scenes?: { nodes?: number[] }[];
  nodes?: Node[];
  meshes?: { primitives: Primitive[] }[];
  buffers?: { uri?: string }[];
  bufferViews?: BufferView[];
  accessors?: Accessor[];
}

/** The JSON and the binary part of a .glb. Raises InputError for what is no whole one. */
export function chunksOf(bytes: Uint8Array): { document: Document; binary: Uint8Array } {
  const view = viewOf(bytes);
  if (bytes.length < HEADER_BYTES || view.getUint32(0, true) !== MAGIC) throw damagedFile();
  if (view.getUint32(4, true) !== 2 || view.getUint32(8, true) > bytes.length) throw damagedFile();
  let at = HEADER_BYTES;
  const [text, binary] = [JSON_CHUNK, BINARY_CHUNK].map((kind) => {
    if (at + CHUNK_BYTES > bytes.length) throw damagedFile();
    const [size, found] = [view.getUint32(at, true), view.getUint32(at + 4, true)];
    at += CHUNK_BYTES;
    if (found !== kind || at + size > bytes.length) throw damagedFile();
    at += size;
    return bytes.subarray(at - size, at);
  });
  try {
    const document: unknown = JSON.parse(new TextDecoder('utf-8', { fatal: true }).decode(text));
    if (typeof document !== 'object' || document === null) throw damagedFile();
    return { document: document as Document, binary };
  } catch {
    throw damagedFile();
  }
}

/** [N, width] the values of an accessor into the binary part. Raises InputError. */
export function values(document: Document, index: number, width: number, binary: Uint8Array): Float64Array {
  const accessor = document.accessors?.[index];
  const own = document.bufferViews?.[accessor?.bufferView ?? -1];
  if (!accessor || !own || accessor.sparse || WIDTHS[accessor.type] !== width) throw damagedFile();
  const component = COMPONENTS[accessor.componentType];
  if (!component || own.buffer !== 0 || document.buffers?.[0]?.uri !== undefined) throw damagedFile();
  const [size, largest, read] = component;
  const { count, byteOffset = 0 } = accessor;
  const { byteOffset: start = 0, byteLength = 0 } = own;
  const stride = own.byteStride || width * size;
  const whole = [count, byteOffset, start, byteLength, stride].every((each) => Number.isSafeInteger(each) && each >= 0);
  const end = Math.min(start + byteLength, binary.length);
  if (!whole || stride < width * size) throw damagedFile();
  if (count && start + byteOffset + (count - 1) * stride + width * size > end) throw damagedFile();
  const found = new Float64Array(count * width);
  const view = viewOf(binary);
  for (let row = 0; row < count; row++) {
    for (let each = 0; each < width; each++) {
      const value = read(view, start + byteOffset + row * stride + each * size);
      found[row * width + each] = accessor.normalized && largest ? Math.max(value / largest, -1) : value;
    }
  }
  return found;
}
