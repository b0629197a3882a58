/** Reader of PlayCanvas's compressed .ply; counterpart of `keyss.files.formats.compressed_ply`. */
import { damaged } from '../core/errors.ts';
import { coefficients, type Gaussians } from '../core/gaussians.ts';
import { fromSmallestThree, gaussiansOf, SH_C0 } from './coded.ts';
import { checkFinite, column, type Element, type PlyFile } from './ply.ts';

export const CHUNK = 256; // Gaussians
const ENDS = ['min', 'max'];
const [AXES, SCALES, COLOURS] = [['x', 'y', 'z'], ['scale_x', 'scale_y', 'scale_z'], ['r', 'g', 'b']];

/** Least and largest numbers of each chunk: [axis][min, max][C]. */
export type Bounds = Float64Array[][];

/** The values of a file, without harmonics. */
export interface CompressedPlyCodes {
  readonly kind: 'compressed-ply';
  readonly count: number;
  readonly shDegree: number;
  readonly placeBounds: Bounds;
  readonly scaleBounds: Bounds; // bounds of log scales
  readonly colourBounds: Bounds;
  readonly positions: Float64Array; // [N] 11, 10 and 11 bits between the bounds
  readonly scales: Float64Array; // [N] 11, 10 and 11 bits
  readonly rotations: Float64Array; // [N] index of the component left out (2 bits), then three components (10 bits each)
  readonly colours: Float64Array; // [N] three colours and opacity, 8 bits each
}

export const VECTOR = [2047, 1023, 2047]; // largest x, y and z

/** x, y or z of a packed vector. */
export function vectorPart(packed: number, axis: number): number {
  return (packed >>> [21, 11, 0][axis]) & VECTOR[axis];
}

/** A stored component of a packed rotation, 0 to 1023. */
export function rotationPart(packed: number, part: number): number {
  return (packed >>> (20 - 10 * part)) & 1023;
}

export function isCompressed(file: PlyFile): boolean {
  return file.elements.some((each) => each.properties.some(({ name }) => name === 'packed_position'));
}

export function readCompressedPly(file: PlyFile): Gaussians & { readonly codes: CompressedPlyCodes } {
  const element = (name: string) => file.elements.find((each) => each.name === name);
  const [vertex, chunk, sh] = [element('vertex'), element('chunk'), element('sh')];
  if (!vertex?.count || !chunk || chunk.count !== Math.ceil(vertex.count / CHUNK)) throw damaged();
  const shDegree = [0, 9, 24, 45].indexOf(sh?.properties.length ?? 0);
  if (shDegree < 0 || (sh && sh.count !== vertex.count)) throw damaged();
  const columnOf = (of: Element, name: string): Float64Array => {
    const values = column(file, of, name);
    if (values === null) throw damaged();
    return values;
  };
  const bounds = (names: string[]): Bounds => names.map((name) => ENDS.map((end) => columnOf(chunk, `${end}_${name}`)));
  const hasColours = chunk.properties.some(({ name }) => name === 'min_r');
  const unit = COLOURS.map(() => [0, 1].map((end) => new Float64Array(chunk.count).fill(end)));
  const [positions, rotations, scales, colours] = ['position', 'rotation', 'scale', 'color'].map((name) => {
    return columnOf(vertex, `packed_${name}`);
  });
  const codes: CompressedPlyCodes = {
    kind: 'compressed-ply', count: vertex.count, shDegree, positions, rotations, scales, colours,
    placeBounds: bounds(AXES), scaleBounds: bounds(SCALES), colourBounds: hasColours ? bounds(COLOURS) : unit,
  };
  const model = dequantiseCompressedPly(codes);
  const k = coefficients(shDegree);
  for (let index = 0; sh && index < 3 * (k - 1); index++) {
    const [channel, each] = [Math.floor(index / (k - 1)), (index % (k - 1)) + 1];
    columnOf(sh, `f_rest_${index}`).forEach((code, row) => {
      const level = code === 0 ? 0 : code === 255 ? 256 : code + 0.5;
      model.sh[3 * (k * row + each) + channel] = level / 32 - 4;
    });
  }
  return { ...checkFinite(model), codes };
}

/** The Gaussians, with harmonics of zero. */
export function dequantiseCompressedPly(codes: CompressedPlyCodes): Gaussians {
  const { count, shDegree, positions, scales, rotations, colours } = codes;
  const between = (bounds: Bounds, row: number, axis: number, share: number): number => {
    const [low, high] = bounds[axis].map((each) => each[Math.floor(row / CHUNK)]);
    return low * (1 - share) + high * share;
  };
  return gaussiansOf(count, shDegree, {
    mean: (row, axis) => between(codes.placeBounds, row, axis, vectorPart(positions[row], axis) / VECTOR[axis]),
    logScale: (row, axis) => between(codes.scaleBounds, row, axis, vectorPart(scales[row], axis) / VECTOR[axis]),
    quat: (row) => {
      const others = [0, 1, 2].map((part) => (rotationPart(rotations[row], part) / 1023 - 0.5) * Math.sqrt(2));
      return fromSmallestThree(rotations[row] >>> 30, others);
    },
    opacity: (row) => colours[row] & 255,
    sh: (row, index, channel) => {
      const share = ((colours[row] >>> (24 - 8 * channel)) & 255) / 255;
      return index ? 0 : (between(codes.colourBounds, row, channel, share) - 0.5) / SH_C0;
    },
  });
}
