/** Reader and writer of models in the Inria .ply layout; hostile files end in an InputError. */
import { ascii, joined, viewOf } from '../core/bytes.ts';
import { InputError } from '../core/errors.ts';
import { coefficients, emptyGaussians, type Gaussians } from '../core/gaussians.ts';

const MAX_HEADER_BYTES = 65536;
const OPACITY_LOGIT_BOUND = 16; // in the place of infinities
const SIZES: Record<string, number> = {
  char: 1, int8: 1, uchar: 1, uint8: 1, short: 2, int16: 2, ushort: 2, uint16: 2,
  int: 4, int32: 4, uint: 4, uint32: 4, float: 4, float32: 4, double: 8, float64: 8,
};

interface Property {
  readonly name: string;
  readonly type: string;
  readonly offset: number; // bytes
}

export interface Element {
  readonly name: string;
  readonly count: number;
  readonly stride: number; // bytes of a row
  readonly properties: readonly Property[];
  readonly start: number; // byte of the file
}

export interface PlyHeader {
  readonly littleEndian: boolean;
  readonly elements: readonly Element[];
}

/** The elements of a binary .ply that end inside the file. Raises InputError. */
export function plyHeader(bytes: Uint8Array): PlyHeader {
  const text = new TextDecoder('latin1').decode(bytes.subarray(0, MAX_HEADER_BYTES));
  const end = /(^|\n)end_header\r?\n/.exec(text);
  if (!/^ply\r?\n/.test(text) || end === null) throw notWhole();
  const elements: { name: string; count: number; properties: Property[]; stride: number }[] = [];
  let format = '';
  for (const line of text.slice(0, end.index).split(/\r?\n/).slice(1)) {
    const words = line.trim().split(/\s+/);
    const last = elements.at(-1);
    if (words[0] === 'format' && !format) format = words[1];
    else if (words[0] === 'element' && /^[0-9]{1,15}$/.test(words[2] ?? '')) {
      elements.push({ name: words[1], count: Number(words[2]), properties: [], stride: 0 });
    } else if (words[0] === 'property' && words.length === 3 && last && words[1] in SIZES) {
      last.properties.push({ name: words[2], type: words[1], offset: last.stride });
      last.stride += SIZES[words[1]];
    } else if (!['', 'comment', 'obj_info'].includes(words[0])) throw notWhole();
  }
  if (!['binary_little_endian', 'binary_big_endian'].includes(format)) {
    throw new InputError('This .ply is not a binary one.');
  }
  let start = end.index + end[0].length;
  const placed = elements.map((each) => {
    const element = { ...each, start };
    start += each.count * each.stride;
    return element;
  });
  if (start > bytes.length) throw notWhole();
  return { littleEndian: format === 'binary_little_endian', elements: placed };
}

/** Numbers of one property of all rows. */
export function column(bytes: Uint8Array, header: PlyHeader, element: Element, name: string): Float64Array | null {
  const property = element.properties.find((each) => each.name === name);
  if (property === undefined) return null;
  const read = reader(viewOf(bytes), property.type, header.littleEndian);
  const values = new Float64Array(element.count);
  for (let row = 0; row < element.count; row++) {
    values[row] = read(element.start + row * element.stride + property.offset);
  }
  return values;
}

function reader(view: DataView, type: string, little: boolean): (at: number) => number {
  switch (type) {
    case 'char': case 'int8': return (at) => view.getInt8(at);
    case 'uchar': case 'uint8': return (at) => view.getUint8(at);
    case 'short': case 'int16': return (at) => view.getInt16(at, little);
    case 'ushort': case 'uint16': return (at) => view.getUint16(at, little);
    case 'int': case 'int32': return (at) => view.getInt32(at, little);
    case 'uint': case 'uint32': return (at) => view.getUint32(at, little);
    case 'float': case 'float32': return (at) => view.getFloat32(at, little);
    default: return (at) => view.getFloat64(at, little);
  }
}

/** A model. Raises InputError for anything that is not a whole, finite 3DGS model. */
export function readPly(bytes: Uint8Array): Gaussians {
  const header = plyHeader(bytes);
  const vertex = header.elements.find((each) => each.name === 'vertex');
  const rest = vertex?.properties.filter((each) => /^f_rest_[0-9]+$/.test(each.name)).length ?? 0;
  const shDegree = [0, 9, 24, 45].indexOf(rest);
  if (vertex === undefined || vertex.count === 0 || shDegree < 0) throw noModel();
  const found = emptyGaussians(vertex.count, shDegree);
  const k = coefficients(shDegree);
  const put = (name: string, to: Float32Array, width: number, offset: number): void => {
    const values = column(bytes, header, vertex, name);
    if (values === null) throw noModel();
    for (let row = 0; row < values.length; row++) to[row * width + offset] = values[row];
  };
  ['x', 'y', 'z'].forEach((name, axis) => put(name, found.means, 3, axis));
  for (let axis = 0; axis < 3; axis++) put(`scale_${axis}`, found.logScales, 3, axis);
  for (let part = 0; part < 4; part++) put(`rot_${part}`, found.quats, 4, part);
  put('opacity', found.opacityLogits, 1, 0);
  for (let colour = 0; colour < 3; colour++) {
    put(`f_dc_${colour}`, found.sh, 3 * k, colour);
    for (let each = 1; each < k; each++) {
      put(`f_rest_${colour * (k - 1) + each - 1}`, found.sh, 3 * k, 3 * each + colour);
    }
  }
  for (const [row, logit] of found.opacityLogits.entries()) {
    if (Math.abs(logit) === Infinity) found.opacityLogits[row] = Math.sign(logit) * OPACITY_LOGIT_BOUND;
  }
  return checkedFinite(found);
}

/** Raises InputError for numbers that are none. */
export function checkedFinite(gaussians: Gaussians): Gaussians {
  const { means, quats, logScales, opacityLogits, sh } = gaussians;
  for (const values of [means, quats, logScales, opacityLogits, sh]) {
    for (const value of values) {
      if (!Number.isFinite(value)) throw new InputError('This file holds numbers that are not finite.');
    }
  }
  return gaussians;
}

/** A model as keyss writes it: little-endian float32, normals zero. */
export function writePly(gaussians: Gaussians): Uint8Array {
  const { count, shDegree, means, quats, logScales, opacityLogits, sh } = gaussians;
  const k = coefficients(shDegree);
  const numbers = (prefix: string, many: number): string[] =>
    Array.from({ length: many }, (_, index) => `${prefix}_${index}`);
  const names = [
    'x', 'y', 'z', 'nx', 'ny', 'nz', ...numbers('f_dc', 3), ...numbers('f_rest', 3 * (k - 1)),
    'opacity', ...numbers('scale', 3), ...numbers('rot', 4),
  ];
  const lines = ['ply', 'format binary_little_endian 1.0', `element vertex ${count}`];
  const header = ascii([...lines, ...names.map((name) => `property float ${name}`), 'end_header\n'].join('\n'));
  const data = new Uint8Array(4 * names.length * count);
  const view = viewOf(data);
  let at = 0;
  const put = (value: number): void => {
    view.setFloat32(at, value, true);
    at += 4;
  };
  for (let row = 0; row < count; row++) {
    for (let axis = 0; axis < 3; axis++) put(means[3 * row + axis]);
    for (let axis = 0; axis < 3; axis++) put(0);
    for (let colour = 0; colour < 3; colour++) put(sh[3 * k * row + colour]);
    for (let colour = 0; colour < 3; colour++) {
      for (let each = 1; each < k; each++) put(sh[3 * (k * row + each) + colour]);
    }
    put(opacityLogits[row]);
    for (let axis = 0; axis < 3; axis++) put(logScales[3 * row + axis]);
    for (let part = 0; part < 4; part++) put(quats[4 * row + part]);
  }
  return joined(header, data);
}

function notWhole(): InputError {
  return new InputError('This is not a whole .ply file.');
}

function noModel(): InputError {
  return new InputError('This .ply file is not a 3D Gaussian Splatting model.');
}
