/** The decoder of a secret; `keyss.methods.keyss.decoder` in Python says why. */
import { damaged } from '../core/errors.ts';
import { coefficients, type Gaussians, withDegree } from '../core/gaussians.ts';
import { objectOf, type Tensor, type Tensors } from './safetensors.ts';

const UNITS: Record<string, number> = { op: 5, ro: 1, sc: 1, xyz: 0.1, sh: 0.5 }; // of residuals
const COLUMNS = { op: 'opacityLogits', ro: 'quats', sc: 'logScales', xyz: 'means', sh: 'sh' } as const;
const KEY_GAIN = 3;
const KEY_NUMBERS = 64;
const MAX_WIDTH = 4096;
const MAX_OCTAVES = 16;
const MAX_PRODUCTS = 1e11; // of all Gaussians: minutes

type Attribute = keyof typeof COLUMNS;

/** Sizes of a decoder. */
interface Shape {
  readonly mask: readonly Attribute[]; // what it changes: opacity, rotation, scale, position, harmonics
  readonly byBias: boolean; // how the key enters
  readonly hidden: readonly [number, number];
  readonly branch: number;
  readonly octaves: number;
  readonly shDegree: number;
  readonly normalised: boolean; // the inputs of the paper's authors
  readonly oneSided: boolean;
}

interface Layer {
  readonly weight: Tensor; // [outputs, inputs]
  readonly bias: Float32Array; // [outputs]
}

export class Decoder {
  private constructor(
    private readonly shape: Shape,
    private readonly constants: Record<'center' | 'extent' | 'offset' | 'spread', Float32Array>,
    private readonly first: Layer, // with what the key adds
    private readonly second: Layer,
    private readonly branches: ReadonlyMap<Attribute, readonly [Layer, Layer]>,
  ) {}

  /** Raises InputError for other tensors than the shape needs. */
  static of(described: unknown, { tensors }: Tensors): Decoder {
    const shape = shapeOf(objectOf(described));
    const numbers = (name: string, ...size: number[]): Tensor => {
      const found = tensors.get(`decoder.${name}`);
      if (!found || found.shape.join() !== size.join()) throw damaged();
      return found;
    };
    const layer = (name: string, outputs: number, inputs: number): Layer => ({
      weight: numbers(`network.${name}.weight`, outputs, inputs),
      bias: numbers(`network.${name}.bias`, outputs).values,
    });
    const attributes = attributesOf(shape.shDegree);
    const [wide, narrow] = shape.hidden;
    const first = layer('first', wide, attributes + 6 * shape.octaves);
    if (shape.byBias) {
      const added = applied({ weight: numbers('network.first_key.weight', wide, KEY_NUMBERS), bias: new Float32Array(wide) },
        numbers('key', KEY_NUMBERS).values);
      added.forEach((value, at) => (first.bias[at] += (shape.normalised ? 1 : KEY_GAIN) * value));
    }
    const widths = { op: 1, ro: 4, sc: 3, xyz: 3, sh: 3 * coefficients(shape.shDegree) };
    const branches = shape.mask.map((name) => [name, [
      layer(`branches.${name}.0`, shape.branch, narrow),
      layer(`branches.${name}.2`, widths[name], shape.branch),
    ]] as const);
    const constants = {
      center: numbers('network.center', 3).values, extent: numbers('network.extent').values,
      offset: numbers('network.offset', attributes).values, spread: numbers('network.spread', attributes).values,
    };
    return new Decoder(shape, constants, first, layer('second', narrow, wide), new Map(branches));
  }

  /** What it makes of a model with its own key. Raises InputError where that would take minutes. */
  decode(model: Gaussians): Gaussians {
    const { shape, first, second, branches } = this;
    const products = [first, second, ...[...branches.values()].flat()].reduce((sum, each) => sum + each.weight.values.length, 0);
    if (products * model.count > MAX_PRODUCTS) throw damaged();
    const found = withDegree(model, shape.shDegree);
    const length = Math.sqrt(found.opacityLogits.reduce((sum, each) => sum + each * each, 0));
    const [before, extent] = [withDegree(found, shape.shDegree), this.constants.extent[0]];
    for (let row = 0; row < model.count; row++) {
      const described = shape.normalised ? normalised(before, row, length) : this.standardised(before, row);
      const hidden = positive(applied(second, positive(applied(first, described))));
      for (const [name, [narrow, last]] of branches) {
        const residuals = applied(last, positive(applied(narrow, hidden)));
        const unit = (shape.normalised ? 1 : UNITS[name]) * (name === 'xyz' ? extent : 1);
        if (shape.oneSided && name !== 'op') positive(residuals);
        const column = found[COLUMNS[name]];
        residuals.forEach((value, at) => (column[row * residuals.length + at] += value * unit));
      }
    }
    return found;
  }

  /** [inputs] attributes in standard units, and sines and cosines of the position. */
  private standardised(model: Gaussians, row: number): Float32Array {
    const { center, extent, offset, spread } = this.constants;
    const own = attributesAt(model, row);
    const place = own.subarray(0, 3);
    place.forEach((each, axis) => (place[axis] = (each - center[axis]) / (2 * extent[0])));
    const distance = Math.max(Math.hypot(...place), 1e-9);
    if (distance > 1) place.forEach((each, axis) => (place[axis] = ((2 - 1 / distance) * each) / distance));
    const { octaves } = this.shape;
    const found = new Float32Array(own.length + 6 * octaves);
    own.forEach((each, at) => (found[at] = (each - offset[at]) / spread[at]));
    place.forEach((each, axis) => {
      for (let octave = 0; octave < octaves; octave++) {
        const at = own.length + axis * octaves + octave;
        const angle = Math.fround(each * Math.fround(2 ** octave * (Math.PI / 2)));
        [found[at], found[at + 3 * octaves]] = [Math.sin(angle), Math.cos(angle)];
      }
    });
    return found;
  }
}

function shapeOf(described: Record<string, unknown>): Shape {
  const integer = (value: unknown, least: number, most: number): number => {
    if (!Number.isInteger(value) || (value as number) < least || (value as number) > most) throw damaged();
    return value as number;
  };
  const oneOf = <T extends string>(value: unknown, ...names: T[]): T => {
    const found = names.find((name) => name === value);
    if (found === undefined) throw damaged();
    return found;
  };
  const { mask, hidden } = described;
  if (!Array.isArray(mask) || !mask.length || new Set(mask).size < mask.length) throw damaged();
  if (!Array.isArray(hidden) || hidden.length !== 2) throw damaged();
  return {
    mask: mask.map((name) => oneOf(name, ...(Object.keys(COLUMNS) as Attribute[]))),
    byBias: oneOf(described.conditioning, 'gate', 'bias') === 'bias',
    hidden: [integer(hidden[0], 1, MAX_WIDTH), integer(hidden[1], 1, MAX_WIDTH)],
    branch: integer(described.branch, 1, MAX_WIDTH),
    octaves: integer(described.frequencies, 0, MAX_OCTAVES),
    shDegree: integer(described.sh_degree, 0, 3),
    normalised: oneOf(described.inputs, 'standardised', 'normalised') === 'normalised',
    oneSided: oneOf(described.residuals, 'signed', 'one-sided') === 'one-sided',
  };
}

/** Numbers of a Gaussian. */
function attributesOf(shDegree: number): number {
  return 11 + 3 * coefficients(shDegree);
}

/** Position, opacity, rotation, scales, harmonics. */
function attributesAt({ means, opacityLogits, quats, logScales, sh, shDegree }: Gaussians, row: number): Float32Array {
  const [found, k] = [new Float32Array(attributesOf(shDegree)), 3 * coefficients(shDegree)];
  found.set(means.subarray(3 * row, 3 * row + 3));
  found[3] = opacityLogits[row];
  found.set(quats.subarray(4 * row, 4 * row + 4), 4);
  found.set(logScales.subarray(3 * row, 3 * row + 3), 8);
  found.set(sh.subarray(k * row, k * row + k), 11);
  return found;
}

/** Each attribute scaled to length 1, opacities over the whole model, as the paper's authors have it. */
function normalised(model: Gaussians, row: number, lengthOfLogits: number): Float32Array {
  const found = attributesAt(model, row);
  for (const [start, end] of [[0, 3], [4, 8], [8, 11], [11, found.length]]) {
    const part = found.subarray(start, end);
    const length = Math.max(Math.hypot(...part), 1e-12);
    part.forEach((each, at) => (part[at] = each / length));
  }
  found[3] /= lengthOfLogits;
  return found;
}

function applied({ weight, bias }: Layer, inputs: Float32Array): Float32Array {
  const [outputs, width] = weight.shape;
  const found = new Float32Array(outputs);
  for (let row = 0, at = 0; row < outputs; row++) {
    let sum = bias[row];
    for (let column = 0; column < width; column++, at++) sum += weight.values[at] * inputs[column];
    found[row] = sum;
  }
  return found;
}

function positive(values: Float32Array): Float32Array {
  for (let at = 0; at < values.length; at++) if (values[at] < 0) values[at] = 0;
  return values;
}
