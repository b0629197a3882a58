/** The decoder of a secret; `keyss.methods.keyss.decoder` in Python says why. */
import { damaged } from '../core/errors.ts';
import { coefficients, type Gaussians, opacity, withDegree } from '../core/gaussians.ts';
import { objectOf, type Tensor, type Tensors } from './safetensors.ts';

const COLUMNS = { op: 'opacityLogits', ro: 'quats', sc: 'logScales', xyz: 'means', sh: 'sh' } as const;
const MAX_WIDTH = 4096;
const MAX_SECRETS = 9;
const MAX_PRODUCTS = 1e11; // of all Gaussians: minutes

type Attribute = keyof typeof COLUMNS;

/** Kind and sizes of a decoder. */
export interface Shape {
  readonly kind: 'mlp' | 'latent';
  readonly mask: readonly Attribute[]; // what it changes: opacity, rotation, scale, position, harmonics
  readonly hidden: readonly [number, number];
  readonly branch: number;
  readonly shDegree: number;
  readonly keySize: number;
  readonly released: boolean; // inputs and residuals of the authors' program
  readonly secrets: number;
  readonly secret: number;
}

interface Layer {
  readonly weight: Tensor; // [outputs, inputs]
  readonly bias: Float32Array; // [outputs]
}

/** A tensor of the size that a shape needs. Raises InputError for another. */
export function tensorOf({ tensors }: Tensors, name: string, ...size: number[]): Tensor {
  const found = tensors.get(name);
  if (!found || found.shape.join() !== size.join()) throw damaged();
  return found;
}

/** What the paper's decoder makes of a model with the vector of its key. Raises InputError where that takes minutes. */
export function decodeNetwork(shape: Shape, read: Tensors, key: Float32Array, model: Gaussians): Gaussians {
  const layer = (name: string, outputs: number, inputs: number): Layer => ({
    weight: tensorOf(read, `decoder.${name}.weight`, outputs, inputs),
    bias: tensorOf(read, `decoder.${name}.bias`, outputs).values,
  });
  const [attributes, [wide, narrow]] = [11 + 3 * coefficients(shape.shDegree), shape.hidden];
  const widths = { op: 1, ro: 4, sc: 3, xyz: 3, sh: attributes - 11 };
  const first = layer('common.0', wide, attributes + key.length);
  const second = layer('common.2', narrow, wide);
  const branches = shape.mask.map((name) => [name,
    layer(`branches.${name}.0`, shape.branch, narrow), layer(`branches.${name}.2`, widths[name], shape.branch),
  ] as const);
  const layers = [first, second, ...branches.flatMap(([, ...both]) => both)];
  const products = layers.reduce((sum, each) => sum + each.weight.values.length, 0);
  if (products * model.count > MAX_PRODUCTS) throw damaged();
  const found = withDegree(model, shape.shDegree);
  const before = withDegree(found, shape.shDegree);
  const length = Math.sqrt(found.opacityLogits.reduce((sum, each) => sum + each * each, 0));
  const inputs = new Float32Array(attributes + key.length);
  inputs.set(key, attributes);
  scaled(inputs.subarray(attributes));
  for (let row = 0; row < model.count; row++) {
    const logit = before.opacityLogits[row];
    inputs[0] = shape.released ? logit / length : opacity(logit);
    let at = 1;
    for (const [name, width] of [['quats', 4], ['logScales', 3], ['means', 3], ['sh', widths.sh]] as const) {
      inputs.set(before[name].subarray(width * row, width * (row + 1)), at);
      scaled(inputs.subarray(at, (at += width)));
    }
    const hidden = positive(applied(second, positive(applied(first, inputs))));
    for (const [name, middle, last] of branches) {
      const residuals = applied(last, positive(applied(middle, hidden)));
      if (shape.released && name !== 'op') positive(residuals);
      const column = found[COLUMNS[name]];
      residuals.forEach((value, index) => (column[row * residuals.length + index] += value));
    }
  }
  return found;
}

/** Raises InputError for what no program writes. */
export function shapeOf(described: Record<string, unknown>): Shape {
  const integer = (value: unknown, least: number, most: number): number => {
    if (!Number.isInteger(value) || (value as number) < least || (value as number) > most) throw damaged();
    return value as number;
  };
  const { mask, hidden, kind, released } = objectOf(described);
  if (!Array.isArray(mask) || !mask.length || new Set(mask).size < mask.length) throw damaged();
  if (!mask.every((name) => Object.hasOwn(COLUMNS, name))) throw damaged();
  if (!Array.isArray(hidden) || hidden.length !== 2 || typeof released !== 'boolean') throw damaged();
  if (kind !== 'mlp' && kind !== 'latent') throw damaged();
  return {
    kind,
    mask,
    hidden: [integer(hidden[0], 1, MAX_WIDTH), integer(hidden[1], 1, MAX_WIDTH)],
    branch: integer(described.branch, 1, MAX_WIDTH),
    shDegree: integer(described.sh_degree, 0, 3),
    keySize: integer(described.key_size, 1, MAX_WIDTH),
    released,
    secrets: integer(described.secrets, 1, MAX_SECRETS),
    secret: integer(described.secret, 0, (described.secrets as number) - 1),
  };
}

/** Divides a vector by its length. */
function scaled(values: Float32Array): void {
  const length = Math.max(Math.hypot(...values), 1e-12);
  values.forEach((each, at) => (values[at] = each / length));
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
