/** Least-squares fit of similarity transforms. */
import { fittedRotation, movedPoint, rotationOf, type Similarity } from '../../core/similarity.ts';

/**
 * The similarity from `source` [P, 3] to `target` with least squared error; null if degenerate. The scale is
 * the value of the rotation's fit divided by the spread of `source` (Umeyama 1991).
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
  const { value, vector } = fittedRotation(m);
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
