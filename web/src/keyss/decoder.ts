/** The paper's decoder, a network; `keyss.methods.keyss.decoder` in Python says why. */
import { damaged } from '../core/errors.ts';
import { coefficients, type Gaussians, opacity } from '../core/gaussians.ts';
import { integerOf, numbersOf, objectOf, type Tensors } from './safetensors.ts';

const COLUMNS = { op: 'opacityLogits', ro: 'quats', sc: 'logScales', xyz: 'means', sh: 'sh' } as const;
const ATTRIBUTES = Object.keys(COLUMNS) as Attribute[];
const MAX_WIDTH = 4096;
const MAX_PRODUCTS = 1e11; // of all Gaussians: minutes

type Attribute = keyof typeof COLUMNS;

/** Kind and sizes of a decoder. */
export interface Shape {
  readonly kind: unknown;
  readonly mask: readonly Attribute[]; // what it changes: opacity, rotation, scale, position, harmonics
  readonly hidden: readonly number[]; // [2]
  readonly branch: number;
  readonly shDegree: number;
  readonly keySize: number;
  readonly released: boolean; // inputs and residuals as the paper's authors have them
  readonly secrets: number; // of the model
  readonly secret: number; // index of the secret
}

/** Maps a model, which it may change, to a secret's Gaussians. */
export type Decode = (model: Gaussians) => Gaussians;

interface Layer {
  readonly weight: Float32Array; // [outputs, inputs]
  readonly bias: Float32Array; // [outputs]
}

/** Raises InputError for what no decoder has. */
export function shapeOf(value: unknown): Shape {
  const found = objectOf(value, 'kind', 'mask', 'hidden', 'branch', 'sh_degree', 'key_size', 'released', 'secrets', 'secret');
  const { kind, mask, released } = found;
  if (!Array.isArray(mask) || !mask.length || typeof released !== 'boolean') throw damaged();
  if (ATTRIBUTES.filter((each) => mask.includes(each)).join() !== mask.join()) throw damaged();
  return {
    kind, mask, released,
    hidden: numbersOf(found.hidden, 2).map((each) => integerOf(each, 1, MAX_WIDTH)),
    branch: integerOf(found.branch, 1, MAX_WIDTH),
    shDegree: integerOf(found.sh_degree, 0, 3),
    keySize: integerOf(found.key_size, 1, MAX_WIDTH),
    secrets: integerOf(found.secrets, 1, 9),
    secret: integerOf(found.secret, 0, 8),
  };
}

/** Raises InputError for other tensors than the shape needs; decoding raises it where that would take minutes. */
export function networkOf(shape: Shape, tensors: Tensors, key: Float32Array): Decode {
  const layer = (name: string, outputs: number, inputs: number): Layer => ({
    weight: tensors.take(`decoder.${name}.weight`, outputs, inputs), bias: tensors.take(`decoder.${name}.bias`, outputs),
  });
  const { hidden: [wide, narrow], branch, released } = shape;
  const harmonics = 3 * coefficients(shape.shDegree);
  const [widths, inputs] = [{ op: 1, ro: 4, sc: 3, xyz: 3, sh: harmonics }, 11 + harmonics + shape.keySize];
  const [first, second] = [layer('common.0', wide, inputs), layer('common.2', narrow, wide)];
  const branches = shape.mask.map((name) => [
    name, layer(`branches.${name}.0`, branch, narrow), layer(`branches.${name}.2`, widths[name], branch),
  ] as const);
  const products = [first, second, ...branches.flatMap(([, ...layers]) => layers)]
    .reduce((sum, each) => sum + each.weight.length, 0);
  return (model) => {
    if (products * model.count > MAX_PRODUCTS) throw damaged();
    const alphas = released ? normalised(model.opacityLogits.slice()) : model.opacityLogits.map((each) => opacity(each));
    const described = new Float32Array(inputs);
    described.set(normalised(key.slice()), inputs - key.length);
    for (let row = 0; row < model.count; row++) {
      described[0] = alphas[row];
      let at = 1;
      for (const name of ['ro', 'sc', 'xyz', 'sh'] as const) {
        described.set(model[COLUMNS[name]].subarray(row * widths[name], (row + 1) * widths[name]), at);
        normalised(described.subarray(at, (at += widths[name])));
      }
      const common = positive(applied(second, positive(applied(first, described))));
      for (const [name, before, last] of branches) {
        const residuals = applied(last, positive(applied(before, common)));
        if (released && name !== 'op') positive(residuals);
        residuals.forEach((value, index) => (model[COLUMNS[name]][row * widths[name] + index] += value));
      }
    }
    return model;
  };
}

/** Scales them to length 1; returns them. */
function normalised(values: Float32Array): Float32Array {
  const length = Math.max(Math.sqrt(values.reduce((sum, each) => sum + each * each, 0)), 1e-12);
  for (let at = 0; at < values.length; at++) values[at] /= length;
  return values;
}

function applied({ weight, bias }: Layer, inputs: Float32Array): Float32Array {
  const found = new Float32Array(bias.length);
  for (let row = 0, at = 0; row < found.length; row++) {
    let sum = bias[row];
    for (let column = 0; column < inputs.length; column++, at++) sum += weight[at] * inputs[column];
    found[row] = sum;
  }
  return found;
}

function positive(values: Float32Array): Float32Array {
  for (let at = 0; at < values.length; at++) if (values[at] < 0) values[at] = 0;
  return values;
}
