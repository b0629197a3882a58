/** Similarity transforms, found by least squares. */
import type { Similarity } from '../../core/similarity.ts';

/** Where it takes the point at `at` of points [P, 3]. */
export function movedPoint({ scale, rotation, translation }: Similarity, points: ArrayLike<number>, at: number): number[] {
  const [x, y, z] = [points[3 * at], points[3 * at + 1], points[3 * at + 2]];
  return [0, 1, 2].map((row) => {
    return scale * (rotation[3 * row] * x + rotation[3 * row + 1] * y + rotation[3 * row + 2] * z) + translation[row];
  });
}

/**
 * From points of `source` [P, 3] to those of `target` with the least squares; null where there is none. The rotation is
 * the eigenvector of the largest eigenvalue of a symmetric matrix of four rows (Horn 1987), and the scale is that value
 * by the spread of `source`, as in Umeyama (1991).
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
  const rotation = matrixOf(vector);
  const translation = goal.map((each, row) => {
    return each - scale * (rotation[3 * row] * centre[0] + rotation[3 * row + 1] * centre[1] + rotation[3 * row + 2] * centre[2]);
  });
  return { scale, rotation, translation };
}

function middle(points: ArrayLike<number>, rows: ArrayLike<number>): number[] {
  return [0, 1, 2].map((axis) => {
    let sum = 0;
    for (let index = 0; index < rows.length; index++) sum += points[3 * rows[index] + axis];
    return sum / rows.length;
  });
}

/** The largest eigenvalue of a symmetric matrix [4, 4], which is changed, and its unit vector (Jacobi's method). */
function largestEigen(matrix: number[][]): { value: number; vector: number[] } {
  const vectors = [0, 1, 2, 3].map((row) => [0, 1, 2, 3].map((column) => Number(row === column)));
  for (let sweep = 0; sweep < 20; sweep++) {
    for (let p = 0; p < 3; p++) {
      for (let q = p + 1; q < 4; q++) {
        if (!matrix[p][q]) continue;
        const angle = (matrix[q][q] - matrix[p][p]) / (2 * matrix[p][q]);
        const tangent = (angle < 0 ? -1 : 1) / (Math.abs(angle) + Math.hypot(angle, 1));
        const cosine = 1 / Math.hypot(tangent, 1);
        const sine = tangent * cosine;
        const turned = (row: number[]): void => {
          [row[p], row[q]] = [cosine * row[p] - sine * row[q], sine * row[p] + cosine * row[q]];
        };
        matrix.forEach(turned);
        for (let column = 0; column < 4; column++) {
          const [a, b] = [matrix[p][column], matrix[q][column]];
          [matrix[p][column], matrix[q][column]] = [cosine * a - sine * b, sine * a + cosine * b];
        }
        vectors.forEach(turned);
      }
    }
  }
  const best = [0, 1, 2, 3].reduce((a, b) => (matrix[b][b] > matrix[a][a] ? b : a));
  return { value: matrix[best][best], vector: vectors.map((row) => row[best]) };
}

function matrixOf([w, x, y, z]: readonly number[]): number[] {
  return [
    1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
    2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
    2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
  ];
}
