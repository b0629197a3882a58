/** Reader and writer of the Inria .ply layout. Input is untrusted: defects raise InputError. */
import { ascii, joined, viewOf } from '../core/bytes.ts';
import { InputError } from '../core/errors.ts';
import { coefficients, COLUMNS, emptyGaussians, type Gaussians, where } from '../core/gaussians.ts';

const MAX_HEADER_BYTES = 65536;
const ROWS = 4096; // rows per batch, which fit in the cache
const OPACITY_LOGIT_BOUND = 16; // replaces infinity
const LEAST_LOG_SCALE = -87.33654; // replaces minus infinity

/** Size in bytes and DataView method of each type, by both of its names. */
const TYPES = new Map(([
  ['char', 'int8', 1, 'Int8'], ['uchar', 'uint8', 1, 'Uint8'], ['short', 'int16', 2, 'Int16'], ['ushort', 'uint16', 2, 'Uint16'],
  ['int', 'int32', 4, 'Int32'], ['uint', 'uint32', 4, 'Uint32'], ['float', 'float32', 4, 'Float32'],
  ['double', 'float64', 8, 'Float64'],
] as const).flatMap(([old, name, size, type]) => {
  return [old, name].map((each: string) => [each, { size, read: `get${type}` }] as const);
}));

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

export interface PlyFile {
  readonly bytes: Uint8Array;
  readonly littleEndian: boolean;
  readonly elements: readonly Element[];
}

/** Finds the elements of a binary file, which end inside it. Raises InputError. */
export function openPly(bytes: Uint8Array): PlyFile {
  const text = new TextDecoder('latin1').decode(bytes.subarray(0, MAX_HEADER_BYTES));
  const header = /^ply\r?\n(?:[^]*?\n)?end_header\r?\n/.exec(text)?.[0] ?? '';
  const format = /\nformat (\S+)/.exec(header)?.[1] ?? '';
  if (format === 'ascii') throw new InputError('This .ply file is text: keyss view converts it.');
  if (!['binary_little_endian', 'binary_big_endian'].includes(format)) throw notWhole();
  let start = header.length;
  const elements = elementsOf(header).map((each) => {
    const element = { ...each, start };
    start += each.count * each.stride;
    return element;
  });
  if (start > bytes.length) throw notWhole();
  return { bytes, littleEndian: format !== 'binary_big_endian', elements };
}

/** The elements of a header. Raises InputError. */
function elementsOf(header: string): Omit<Element, 'start'>[] {
  const elements: { name: string; count: number; properties: Property[]; stride: number }[] = [];
  for (const line of header.split(/\r?\n/).slice(1)) {
    const words = line.trim().split(/\s+/);
    const last = elements.at(-1);
    if (words[0] === 'element' && /^[0-9]{1,15}$/.test(words[2] ?? '')) {
      elements.push({ name: words[1], count: Number(words[2]), properties: [], stride: 0 });
    } else if (words[0] === 'property' && words.length === 3 && last && TYPES.has(words[1])) {
      last.properties.push({ name: words[2], type: words[1], offset: last.stride });
      last.stride += TYPES.get(words[1])!.size;
    } else if (words[1] === 'list') throw noModel(); // a mesh
    else if (!['', 'comment', 'obj_info', 'format', 'end_header'].includes(words[0])) throw notWhole();
  }
  return elements;
}

/** The values of a property in some rows, by default all; null if there is none. */
export function column(
  { bytes, littleEndian }: PlyFile, { count, properties, start, stride }: Element, name: string, first = 0, rows = count,
): Float64Array | null {
  const property = properties.find((each) => each.name === name);
  if (property === undefined) return null;
  const [view, { read }] = [viewOf(bytes), TYPES.get(property.type)!];
  const values = new Float64Array(Math.min(rows, count - first));
  for (let row = 0, at = start + first * stride + property.offset; row < values.length; row++, at += stride) {
    values[row] = view[read](at, littleEndian);
  }
  return values;
}

/** The finite Gaussians of a file. Raises InputError for anything other than a complete 3DGS model. */
export function readPly(file: PlyFile): Gaussians {
  const vertex = file.elements.find((each) => each.name === 'vertex');
  const rest = vertex?.properties.filter((each) => /^f_rest_[0-9]+$/.test(each.name)).length ?? 0;
  const shDegree = [0, 9, 24, 45].indexOf(rest);
  if (vertex === undefined || shDegree < 0) throw noModel();
  const names = new Set(vertex.properties.map(({ name }) => name)); // rows without properties take no bytes
  if (!plyColumns(shDegree).every(({ name }) => names.has(name))) throw noModel();
  if (vertex.count === 0) throw new InputError(`This file holds no Gaussians${CURE}`);
  const model = emptyGaussians(vertex.count, shDegree);
  for (let first = 0; first < model.count; first += ROWS) {
    for (const { name, to, offset } of plyColumns(shDegree)) {
      const width = model[to].length / model.count;
      column(file, vertex, name, first, ROWS)!.forEach((value, row) => (model[to][(first + row) * width + offset] = value));
    }
  }
  model.opacityLogits.forEach((logit, row) => {
    if (Math.abs(logit) === Infinity) model.opacityLogits[row] = Math.sign(logit) * OPACITY_LOGIT_BOUND;
  });
  model.logScales.forEach((logScale, at) => {
    if (logScale === -Infinity) model.logScales[at] = LEAST_LOG_SCALE;
  });
  return withoutNonFinite(model);
}

/** The Gaussians with finite values only. Raises InputError if there are none. */
export function withoutNonFinite(gaussians: Gaussians): Gaussians {
  if (isFinite(gaussians)) return gaussians;
  const widths = COLUMNS.map((each) => [gaussians[each], gaussians[each].length / gaussians.count] as const);
  const finite = where(gaussians, (row) =>
    widths.every(([values, width]) => values.subarray(row * width, (row + 1) * width).every(Number.isFinite)),
  );
  if (finite.count === 0) throw notFinite();
  return finite;
}

/** Raises InputError for values that are not finite. */
export function checkFinite(gaussians: Gaussians): Gaussians {
  if (isFinite(gaussians)) return gaussians;
  throw notFinite();
}

function isFinite(gaussians: Gaussians): boolean {
  return COLUMNS.every((each) => gaussians[each].every((value) => value - value === 0));
}

/** The properties of a .ply in the order written: the column that holds each, and its offset in a row. */
export function plyColumns(shDegree: number): { name: string; to: (typeof COLUMNS)[number]; offset: number }[] {
  const rest = coefficients(shDegree) - 1;
  const numbers = (prefix: string, count: number): string[] => Array.from({ length: count }, (_, at) => `${prefix}_${at}`);
  const columns = (to: (typeof COLUMNS)[number], names: string[], first = 0) =>
    names.map((name, at) => ({ name, to, offset: first + at }));
  const harmonics = numbers('f_rest', 3 * rest).map((name, at) => {
    return { name, to: 'sh' as const, offset: 3 * ((at % rest) + 1) + Math.floor(at / rest) };
  });
  return [
    ...columns('means', ['x', 'y', 'z']), ...columns('sh', numbers('f_dc', 3)), ...harmonics,
    ...columns('opacityLogits', ['opacity']), ...columns('logScales', numbers('scale', 3)), ...columns('quats', numbers('rot', 4)),
  ];
}

/** A model as keyss writes it: little-endian float32, normals zero. */
export function writePly(gaussians: Gaussians): Uint8Array {
  const { count, shDegree } = gaussians;
  const columns = plyColumns(shDegree).map(({ name, to, offset }) => {
    return { name, values: gaussians[to], width: gaussians[to].length / count, offset };
  });
  const zeros = { values: new Float32Array(count), width: 1, offset: 0 };
  columns.splice(3, 0, ...['nx', 'ny', 'nz'].map((name) => ({ ...zeros, name })));
  const lines = ['ply', 'format binary_little_endian 1.0', `element vertex ${count}`];
  const header = ascii([...lines, ...columns.map(({ name }) => `property float ${name}`), 'end_header\n'].join('\n'));
  const data = new Uint8Array(4 * columns.length * count);
  const view = viewOf(data);
  for (let row = 0, at = 0; row < count; row++) {
    for (const { values, width, offset } of columns) {
      view.setFloat32(at, values[row * width + offset], true);
      at += 4;
    }
  }
  return joined(header, data);
}

const CURE = ': export it again from the program that made it.';

function notFinite(): InputError {
  return new InputError(`This file holds numbers that are not finite${CURE}`);
}

function notWhole(): InputError {
  return new InputError('This is not a whole .ply file: download or copy it again.');
}

function noModel(): InputError {
  return new InputError('This .ply file is not a 3D Gaussian Splatting model.');
}
