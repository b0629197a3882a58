/** Similarity transforms of Gaussians; counterpart of `keyss.core.similarity`. */
import { coefficients, type Gaussians } from './gaussians.ts';

const SQUARINGS = 50;

/** x -> scale * rotation x + translation. */
export interface Similarity {
  readonly scale: number;
  readonly rotation: readonly number[]; // [9] row-major
  readonly translation: readonly number[]; // [3]
}

/** The transformed point [3]. */
export function movedPoint({ scale, rotation, translation }: Similarity, point: ArrayLike<number>): number[] {
  return times(rotation, point).map((each, axis) => scale * each + translation[axis]);
}

/** The transformed Gaussians, view-dependent colour included. */
export function moved(by: Similarity, model: Gaussians): Gaussians {
  const [w, x, y, z] = fittedRotation(transposed(by.rotation)).vector;
  const k = coefficients(model.shDegree);
  const turned = rotatedHarmonics(by.rotation, k - 1);
  const [means, quats, sh] = [model.means.slice(), model.quats.slice(), model.sh.slice()];
  for (let row = 0; row < model.count; row++) {
    means.set(movedPoint(by, model.means.subarray(3 * row, 3 * row + 3)), 3 * row);
    const [a, b, c, d] = model.quats.subarray(4 * row, 4 * row + 4);
    quats.set([
      w * a - x * b - y * c - z * d, x * a + w * b - z * c + y * d,
      y * a + z * b + w * c - x * d, z * a - y * b + x * c + w * d,
    ], 4 * row);
    for (let at = 3; at < 3 * k; at++) {
      const [own, colour] = [turned[Math.floor(at / 3) - 1], at % 3];
      sh[3 * k * row + at] = own.reduce((sum, each, j) => sum + each * model.sh[3 * (k * row + 1 + j) + colour], 0);
    }
  }
  const larger = Math.fround(Math.log(by.scale));
  return { ...model, means, quats, sh, logScales: model.logScales.map((each) => each + larger) };
}

function transposed(r: readonly number[]): number[] {
  return [r[0], r[3], r[6], r[1], r[4], r[7], r[2], r[5], r[8]];
}

function times(m: readonly number[], v: ArrayLike<number>): number[] {
  return [0, 3, 6].map((at) => m[at] * v[0] + m[at + 1] * v[1] + m[at + 2] * v[2]);
}

export function dot(a: readonly number[], b: readonly number[]): number {
  return a.reduce((sum, each, at) => sum + each * b[at], 0);
}

export function cross(a: readonly number[], b: readonly number[]): [number, number, number] {
  return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
}

/** Rotation matrix [9], row-major, of a unit quaternion wxyz. */
export function rotationOf([w, x, y, z]: readonly number[]): number[] {
  return [
    1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
    2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
    2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
  ];
}

/**
 * The rotation that fits sums of products best, a unit quaternion wxyz: `m` [3, 3], of coordinates before and after it. It is
 * the eigenvector of the largest eigenvalue, `value`, of a symmetric matrix (Horn 1987).
 */
export function fittedRotation(m: ArrayLike<number>): { value: number; vector: number[] } {
  const [xx, xy, xz, yx, yy, yz, zx, zy, zz] = Array.from(m);
  return largestEigen([
    [xx + yy + zz, yz - zy, zx - xz, xy - yx],
    [yz - zy, xx - yy - zz, xy + yx, zx + xz],
    [zx - xz, xy + yx, yy - xx - zz, yz + zy],
    [xy - yx, zx + xz, yz + zy, zz - xx - yy],
  ]);
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

// [32, 4] quadrature on the sphere, directions and weights, exact up to degree 7 (Gauss-Legendre by azimuth steps).
const GAUSS = [[0.3399810435848563, 0.6521451548625461], [0.8611363115940526, 0.3478548451374538]];
const SPHERE = GAUSS.flatMap(([z, weight]) => [z, -z].flatMap((height) =>
  Array.from({ length: 8 }, (_, step) => {
    const [radius, angle] = [Math.sqrt(1 - z * z), (step * Math.PI) / 4];
    return [radius * Math.cos(angle), radius * Math.sin(angle), height, (weight * Math.PI) / 4];
  })));

/** [count, count] rotation matrix for the SH coefficients after the constant one. */
function rotatedHarmonics(r: readonly number[], count: number): number[][] {
  const found = Array.from({ length: count }, () => new Array<number>(count).fill(0));
  const back = transposed(r);
  for (const [x, y, z, weight] of SPHERE) {
    const [there, here] = [harmonics([x, y, z]), harmonics(times(back, [x, y, z]))];
    found.forEach((row, i) => row.forEach((_, j) => (row[j] += weight * there[i] * here[j])));
  }
  return found;
}

/** The real SH basis of degrees 1 to 3, with the signs of 3DGS. */
function harmonics([x, y, z]: readonly number[]): number[] {
  const [xx, yy, zz] = [x * x, y * y, z * z];
  return [
    -0.4886025119029199 * y, 0.4886025119029199 * z, -0.4886025119029199 * x,
    1.0925484305920792 * x * y, -1.0925484305920792 * y * z, 0.31539156525252005 * (2 * zz - xx - yy),
    -1.0925484305920792 * x * z, 0.5462742152960396 * (xx - yy),
    -0.5900435899266435 * y * (3 * xx - yy), 2.890611442640554 * x * y * z, -0.4570457994644658 * y * (4 * zz - xx - yy),
    0.3731763325901154 * z * (2 * zz - 3 * xx - 3 * yy), -0.4570457994644658 * x * (4 * zz - xx - yy),
    1.445305721320277 * z * (xx - yy), -0.5900435899266435 * x * (xx - 3 * yy),
  ];
}
