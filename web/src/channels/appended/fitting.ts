/** Least-squares fit of similarity transforms. */
import { movedPoint, rotationOf, type Similarity } from '../../core/similarity.ts';

const SQUARINGS = 50;

/**
 * The similarity from `source` [P, 3] to `target` with least squared error; null if degenerate. The rotation is the
 * eigenvector of the largest eigenvalue of a symmetric 4 x 4 matrix (Horn 1987), the scale that eigenvalue divided by the
 * spread of `source` (Umeyama 1991).
 */
export function fittedSimilarity(
  source: ArrayLike<number>, target: ArrayLike<number>, rows: ArrayLike<number>,
): Similarity | null {
  const [centre, goal] = [middle(source, rows), middle(target, rows)];
  const m = new Float64Array(9); // [3, 3] sums of products of source and target
  let spread = 0;
  for (let index = 0; index < rows.length; index++) {
    for (let i = 0; i < 3; i++) {
      const a = source[3 * rows[index] + i] - centre[i];
      spread += a * a;
      for (let j = 0; j < 3; j++) m[3 * i + j] += a * (target[3 * rows[index] + j] - goal[j]);
    }
  }
  const [xx, xy, xz, yx, yy, yz, zx, zy, zz] = m;
  const { value, vector } = largestEigen([
    [xx + yy + zz, yz - zy, zx - xz, xy - yx],
    [yz - zy, xx - yy - zz, xy + yx, zx + xz],
    [zx - xz, xy + yx, yy - xx - zz, yz + zy],
    [xy - yx, zx + xz, yz + zy, zz - xx - yy],
  ]);
  const scale = value / spread;
  if (!(spread > 0 && scale > 0 && Number.isFinite(scale) && vector.every(Number.isFinite))) return null;
  const turned = { scale, rotation: rotationOf(vector), translation: [0, 0, 0] };
  const away = movedPoint(turned, centre);
  return { ...turned, translation: goal.map((each, axis) => each - away[axis]) };
}

function middle(points: ArrayLike<number>, rows: ArrayLike<number>): number[] {
  return [0, 1, 2].map((axis) => {
    let sum = 0;
    for (let index = 0; index < rows.length; index++) sum += points[3 * rows[index] + axis];
    return sum / rows.length;
  });
}

/** The largest eigenvalue of a symmetric matrix [4, 4] and its unit eigenvector, by repeated squaring. */
function largestEigen(matrix: number[][]): { value: number; vector: number[] } {
  const bound = Math.max(...matrix.map((row) => row.reduce((sum, each) => sum + Math.abs(each), 0)));
  const four = [0, 1, 2, 3];
  let power = matrix.map((row, i) => row.map((each, j) => each / bound + Number(i === j))); // shifted to non-negative eigenvalues
  for (let round = 0; round < SQUARINGS; round++) {
    const largest = Math.max(...power.flat().map(Math.abs));
    const scaled = power.map((row) => row.map((each) => each / largest));
    power = scaled.map((row) => four.map((j) => row.reduce((sum, each, k) => sum + each * scaled[k][j], 0)));
  }
  const column = power[four.reduce((a, b) => (power[b][b] > power[a][a] ? b : a))];
  const vector = column.map((each) => each / Math.hypot(...column));
  const value = vector.reduce((sum, a, i) => sum + vector.reduce((own, b, j) => own + a * b * matrix[i][j], 0), 0);
  return { value, vector };
}
