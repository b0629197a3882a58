/** Reader of PlayCanvas's compressed .ply; counterpart of `keyss.files.formats.compressed_ply`. */
import { damaged } from '../core/errors.ts';
import { coefficients, emptyGaussians, type Gaussians } from '../core/gaussians.ts';
import { fromSmallestThree, logit, SH_C0 } from './coded.ts';
import { checkFinite, column, type PlyHeader } from './ply.ts';

export const CHUNK = 256; // Gaussians
const ENDS = ['min', 'max'];
const AXES = ['x', 'y', 'z'].map((axis) => ENDS.map((end) => `${end}_${axis}`));
const SCALES = ['x', 'y', 'z'].map((axis) => ENDS.map((end) => `${end}_scale_${axis}`));
const COLOURS = ['r', 'g', 'b'].map((colour) => ENDS.map((end) => `${end}_${colour}`));

/** The codes that can carry secrets. */
export interface CompressedPlyCodes {
  readonly kind: 'compressed-ply';
  readonly count: number;
  readonly scaleBounds: Float64Array[][]; // [axis][min, max][C] log scales; a chunk is 256 Gaussians
  readonly scales: Float64Array; // [N] 11, 10 and 11 bits between the bounds
  readonly rotations: Float64Array; // [N] index of the component left out (2 bits), then the others (10 bits each)
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

export function isCompressed(header: PlyHeader): boolean {
  return header.elements.some((each) => each.properties.some(({ name }) => name === 'packed_position'));
}

export function readCompressedPly(
  bytes: Uint8Array, header: PlyHeader,
): Gaussians & { readonly codes: CompressedPlyCodes } {
  const element = (name: string) => header.elements.find((each) => each.name === name);
  const [vertex, chunk, sh] = [element('vertex'), element('chunk'), element('sh')];
  if (!vertex?.count || !chunk || chunk.count !== Math.ceil(vertex.count / CHUNK)) throw damaged();
  const shDegree = [0, 9, 24, 45].indexOf(sh?.properties.length ?? 0);
  if (shDegree < 0 || (sh && sh.count !== vertex.count)) throw damaged();
  const ends = (names: string[][], missing?: number[]): Float64Array[][] =>
    names.map((pair) => pair.map((name, end) => {
      const values = column(bytes, header, chunk, name);
      if (values === null && !missing) throw damaged();
      return values ?? new Float64Array(chunk.count).fill(missing![end]);
    }));
  const hasColours = chunk.properties.some(({ name }) => name === 'min_r');
  const [places, sizes, colours] = [ends(AXES), ends(SCALES), ends(COLOURS, hasColours ? undefined : [0, 1])];
  const [position, rotation, scale, colour] = ['position', 'rotation', 'scale', 'color'].map((name) => {
    const values = column(bytes, header, vertex, `packed_${name}`);
    if (values === null) throw damaged();
    return values;
  });
  const model = emptyGaussians(vertex.count, shDegree);
  const k = coefficients(shDegree);
  for (let row = 0; row < vertex.count; row++) {
    const own = Math.floor(row / CHUNK);
    const between = ([low, high]: Float64Array[], share: number): number =>
      low[own] * (1 - share) + high[own] * share;
    for (let axis = 0; axis < 3; axis++) {
      const share = (packed: number): number => vectorPart(packed, axis) / VECTOR[axis];
      model.means[3 * row + axis] = between(places[axis], share(position[row]));
      model.logScales[3 * row + axis] = between(sizes[axis], share(scale[row]));
    }
    const others = [0, 1, 2].map((part) => (rotationPart(rotation[row], part) / 1023 - 0.5) * Math.sqrt(2));
    model.quats.set(fromSmallestThree(rotation[row] >>> 30, others), 4 * row);
    [24, 16, 8].forEach((shift, channel) => {
      const value = between(colours[channel], ((colour[row] >>> shift) & 255) / 255);
      model.sh[3 * k * row + channel] = (value - 0.5) / SH_C0;
    });
    model.opacityLogits[row] = logit(colour[row] & 255);
  }
  for (let index = 0; sh && index < 3 * (k - 1); index++) {
    const values = column(bytes, header, sh, `f_rest_${index}`);
    if (values === null) throw damaged();
    const [channel, each] = [Math.floor(index / (k - 1)), (index % (k - 1)) + 1];
    values.forEach((code, row) => {
      const level = code === 0 ? 0 : code === 255 ? 256 : code + 0.5;
      model.sh[3 * (k * row + each) + channel] = level / 32 - 4;
    });
  }
  const packed = { scales: scale, rotations: rotation, colours: colour };
  return { ...checkFinite(model), codes: { kind: 'compressed-ply', count: vertex.count, scaleBounds: sizes, ...packed } };
}
