/** Similarity transforms of Gaussians; counterpart of `keyss.core.similarity`. */
import type { Gaussians } from './gaussians.ts';
import { add, dot, type Quaternion, quaternionProduct, rotated, scaled, type Vector, vectorAt } from './vectors.ts';

const SQUARINGS = 50;

/** x -> scale * rotated x + translation. */
export interface Similarity {
  readonly scale: number;
  readonly rotation: Quaternion; // of length 1
  readonly translation: Vector;
}

export function movedPoint({ scale, rotation, translation }: Similarity, point: Vector): Vector {
  return add(scaled(rotated(rotation, point), scale), translation);
}

/** The transformed Gaussians, except for view-dependent colour, which stays. */
export function moved(by: Similarity, model: Gaussians): Gaussians {
  const [means, quats] = [model.means.slice(), model.quats.slice()];
  for (let row = 0; row < model.count; row++) {
    means.set(movedPoint(by, vectorAt(means, row)), 3 * row);
    const [w, x, y, z] = quats.subarray(4 * row, 4 * row + 4);
    quats.set(quaternionProduct(by.rotation, [w, x, y, z]), 4 * row);
  }
  const larger = Math.fround(Math.log(by.scale));
  return { ...model, means, quats, logScales: model.logScales.map((each) => each + larger) };
}

/**
 * The similarity from `source` [P, 3] to `target` with least squared error in these rows; null if degenerate. The scale is
 * the value of the rotation's fit divided by the spread of `source` (Umeyama 1991).
 */
export function fittedSimilarity(
  source: ArrayLike<number>, target: ArrayLike<number>, rows: readonly number[],
): Similarity | null {
  const [centre, goal] = [middle(source, rows), middle(target, rows)];
  const m = new Float64Array(9); // [3, 3] sums of products of source and target
  let spread = 0;
  for (const row of rows) {
    const [before, after] = [add(vectorAt(source, row), centre, -1), add(vectorAt(target, row), goal, -1)];
    spread += dot(before, before);
    for (let i = 0; i < 3; i++) for (let j = 0; j < 3; j++) m[3 * i + j] += before[i] * after[j];
  }
  const { value, rotation } = fittedRotation(m);
  const scale = value / spread;
  if (!(spread > 0 && scale > 0 && Number.isFinite(scale) && rotation.every(Number.isFinite))) return null;
  return { scale, rotation, translation: add(goal, rotated(rotation, centre), -scale) };
}

function middle(points: ArrayLike<number>, rows: readonly number[]): Vector {
  return scaled(rows.reduce<Vector>((sum, row) => add(sum, vectorAt(points, row)), [0, 0, 0]), 1 / rows.length);
}

/**
 * The rotation that fits sums of products best: `m` [3, 3], of coordinates before and after it. It is the eigenvector of the
 * largest eigenvalue, `value`, of a symmetric matrix (Horn 1987), by repeated squaring.
 */
function fittedRotation(m: ArrayLike<number>): { value: number; rotation: Quaternion } {
  const [xx, xy, xz, yx, yy, yz, zx, zy, zz] = Array.from(m);
  const matrix = [
    [xx + yy + zz, yz - zy, zx - xz, xy - yx],
    [yz - zy, xx - yy - zz, xy + yx, zx + xz],
    [zx - xz, xy + yx, yy - xx - zz, yz + zy],
    [xy - yx, zx + xz, yz + zy, zz - xx - yy],
  ];
  const bound = Math.max(...matrix.map((row) => row.reduce((sum, each) => sum + Math.abs(each), 0)));
  const four = [0, 1, 2, 3];
  let power = matrix.map((row, i) => row.map((each, j) => each / bound + Number(i === j))); // shifted to non-negative eigenvalues
  for (let round = 0; round < SQUARINGS; round++) {
    const largest = Math.max(...power.flat().map(Math.abs));
    const normal = power.map((row) => row.map((each) => each / largest));
    power = normal.map((row) => four.map((j) => row.reduce((sum, each, k) => sum + each * normal[k][j], 0)));
  }
  const column = power[four.reduce((a, b) => (power[b][b] > power[a][a] ? b : a))];
  const rotation = column.map((each) => each / Math.hypot(...column));
  const value = rotation.reduce((sum, a, i) => sum + rotation.reduce((own, b, j) => own + a * b * matrix[i][j], 0), 0);
  return { value, rotation: rotation as unknown as Quaternion };
}
