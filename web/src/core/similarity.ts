/** Moving, turning and scaling a model, its harmonics included; `keyss.core.similarity` on the other side. */
import { InputError } from './errors.ts';
import { coefficients, type Gaussians } from './gaussians.ts';

/** [4, 4] in rows, or [3, 3]. */
export type Matrix = readonly number[];

/** x -> scale * rotation @ x + translation. */
export interface Similarity {
  readonly scale: number;
  readonly rotation: Matrix; // [3, 3]
  readonly translation: readonly number[];
}

const TOLERANCE = 1e-6; // of what is a rotation
const DIRECTIONS = 64;
const GOLDEN_ANGLE = Math.PI * (3 - Math.sqrt(5));

export function product(a: Matrix, b: Matrix): Matrix {
  const at = (row: number, column: number): number =>
    [0, 1, 2, 3].reduce((sum, each) => sum + a[4 * row + each] * b[4 * each + column], 0);
  return Array.from({ length: 16 }, (_, index) => at(Math.floor(index / 4), index % 4));
}

/** Raises InputError for a transform [4, 4] that does more than move, turn and scale evenly. */
export function similarityOf(whole: Matrix): Similarity {
  const linear = [0, 1, 2].flatMap((row) => [0, 1, 2].map((column) => whole[4 * row + column]));
  const scale = Math.abs(determinant(linear)) ** (1 / 3);
  const rotation = linear.map((each) => each / scale);
  if (!isRotation(rotation) || !Number.isFinite(scale)) {
    throw new InputError('This .glb does more to its Gaussians than move, turn and scale them evenly.');
  }
  return { scale, rotation, translation: [whole[3], whole[7], whole[11]] };
}

/** The transform that undoes one. */
export function inverse({ scale, rotation: m, translation: [x, y, z] }: Similarity): Similarity {
  const rotation = [m[0], m[3], m[6], m[1], m[4], m[7], m[2], m[5], m[8]];
  const translation = [0, 3, 6].map((at) => -(rotation[at] * x + rotation[at + 1] * y + rotation[at + 2] * z) / scale);
  return { scale: 1 / scale, rotation, translation };
}

/** Whether [3, 3] is a rotation, to 1e-6. */
export function isRotation(matrix: Matrix): boolean {
  let off = 0;
  for (let row = 0; row < 3; row++) {
    for (let other = 0; other < 3; other++) {
      const dot = [0, 1, 2].reduce((sum, each) => sum + matrix[3 * row + each] * matrix[3 * other + each], 0);
      off = Math.max(off, Math.abs(dot - Number(row === other)));
    }
  }
  return off <= TOLERANCE && determinant(matrix) > 0;
}

function determinant([a, b, c, d, e, f, g, h, i]: Matrix): number {
  return a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g);
}

export function moved(model: Gaussians, { scale, rotation, translation }: Similarity): Gaussians {
  const { count, shDegree } = model;
  const means = new Float32Array(3 * count);
  const quats = new Float32Array(4 * count);
  const [a, b, c, d] = quaternionOf(rotation);
  for (let row = 0; row < count; row++) {
    const [px, py, pz] = model.means.subarray(3 * row, 3 * row + 3);
    for (let axis = 0; axis < 3; axis++) {
      const turned = px * rotation[3 * axis] + py * rotation[3 * axis + 1] + pz * rotation[3 * axis + 2];
      means[3 * row + axis] = scale * turned + translation[axis];
    }
    const [w, x, y, z] = model.quats.subarray(4 * row, 4 * row + 4);
    quats.set([
      a * w - b * x - c * y - d * z, b * w + a * x - d * y + c * z,
      c * w + d * x + a * y - b * z, d * w - c * x + b * y + a * z,
    ], 4 * row);
  }
  const larger = Math.fround(Math.log(scale));
  const logScales = model.logScales.map((each) => each + larger);
  return { ...model, means, quats, logScales, sh: turnedHarmonics(model.sh, shDegree, rotation) };
}

/** wxyz, of length 1. */
function quaternionOf(m: Matrix): number[] {
  const trace = m[0] + m[4] + m[8];
  const choices = [m[0], m[4], m[8], trace];
  const i = choices.indexOf(Math.max(...choices));
  const [j, k] = [(i + 1) % 3, (i + 2) % 3];
  const at = (row: number, column: number): number => m[3 * row + column];
  const xyzw = [0, 0, 0, 0];
  if (i === 3) {
    [xyzw[0], xyzw[1], xyzw[2], xyzw[3]] = [at(2, 1) - at(1, 2), at(0, 2) - at(2, 0), at(1, 0) - at(0, 1), 1 + trace];
  } else {
    [xyzw[i], xyzw[j]] = [1 - trace + 2 * at(i, i), at(j, i) + at(i, j)];
    [xyzw[k], xyzw[3]] = [at(k, i) + at(i, k), at(k, j) - at(j, k)];
  }
  const length = Math.hypot(...xyzw);
  return [xyzw[3], xyzw[0], xyzw[1], xyzw[2]].map((each) => each / length);
}

/**
 * Harmonics [N, K, 3] of the colour function d -> colour(rotation^T d).
 *
 * Each degree spans a space closed under rotation, so it is turned by the solution of basis(d) block =
 * basis(rotation^T d) over directions d, by least squares.
 */
function turnedHarmonics(sh: Float32Array, degree: number, rotation: Matrix): Float32Array {
  const k = coefficients(degree);
  const directions = Array.from({ length: DIRECTIONS }, (_, index): number[] => {
    const z = 1 - (2 * index + 1) / DIRECTIONS;
    const flat = Math.sqrt(1 - z * z);
    return [flat * Math.cos(index * GOLDEN_ANGLE), flat * Math.sin(index * GOLDEN_ANGLE), z];
  });
  const before = directions.map((each) => basis(each));
  const after = directions.map((d) =>
    basis([0, 1, 2].map((axis) => d[0] * rotation[axis] + d[1] * rotation[3 + axis] + d[2] * rotation[6 + axis])));
  const found = sh.slice();
  for (let band = 1; band <= degree; band++) {
    const [start, end] = [band * band, (band + 1) ** 2];
    const block = solution(before.map((each) => each.slice(start, end)), after.map((each) => each.slice(start, end)));
    for (let at = 0; at < sh.length; at += 3 * k) {
      for (let row = 0; row < end - start; row++) {
        for (let colour = 0; colour < 3; colour++) {
          let sum = 0;
          for (let column = 0; column < end - start; column++) {
            sum += block[row][column] * sh[at + 3 * (start + column) + colour];
          }
          found[at + 3 * (start + row) + colour] = sum;
        }
      }
    }
  }
  return found;
}

/** X of least squares in A X = B, by the normal equations: A is orthogonal but for rounding. */
function solution(a: number[][], b: number[][]): number[][] {
  const size = a[0].length;
  const inner = (p: number[][], i: number, q: number[][], j: number): number =>
    p.reduce((sum, row, index) => sum + row[i] * q[index][j], 0);
  const indices = [...Array(size).keys()];
  const rows = indices.map((i) => [...indices.map((j) => inner(a, i, a, j)), ...indices.map((j) => inner(a, i, b, j))]);
  for (const pivot of indices) {
    rows[pivot] = rows[pivot].map((each) => each / rows[pivot][pivot]);
    for (const other of indices) {
      if (other === pivot) continue;
      const factor = rows[other][pivot];
      rows[other] = rows[other].map((each, column) => each - factor * rows[pivot][column]);
    }
  }
  return rows.map((row) => row.slice(size));
}

/** The real SH basis with 3DGS's signs, degrees 0 to 3, at a unit vector. */
function basis([x, y, z]: readonly number[]): number[] {
  const [xx, yy, zz] = [x * x, y * y, z * z];
  return [
    0.28209479177387814,
    -0.4886025119029199 * y, 0.4886025119029199 * z, -0.4886025119029199 * x,
    1.0925484305920792 * x * y, -1.0925484305920792 * y * z, 0.31539156525252005 * (2 * zz - xx - yy),
    -1.0925484305920792 * x * z, 0.5462742152960396 * (xx - yy),
    -0.5900435899266435 * y * (3 * xx - yy), 2.890611442640554 * x * y * z, -0.4570457994644658 * y * (4 * zz - xx - yy),
    0.3731763325901154 * z * (2 * zz - 3 * xx - 3 * yy), -0.4570457994644658 * x * (4 * zz - xx - yy),
    1.445305721320277 * z * (xx - yy), -0.5900435899266435 * x * (xx - 3 * yy),
  ];
}
