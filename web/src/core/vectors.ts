/** Vectors and rotations in three dimensions. */
export type Vector = readonly [number, number, number];
export type Quaternion = readonly [number, number, number, number]; // wxyz

/** A row of a table [N, 3]. */
export const vectorAt = (table: ArrayLike<number>, row: number): Vector => [
  table[3 * row], table[3 * row + 1], table[3 * row + 2],
];
export const add = (a: Vector, b: Vector, scale = 1): Vector => [
  a[0] + scale * b[0], a[1] + scale * b[1], a[2] + scale * b[2],
];
export const scaled = (a: Vector, scale: number): Vector => [scale * a[0], scale * a[1], scale * a[2]];
export const difference = (a: Vector, b: Vector): Vector => add(a, b, -1);
export const length = (a: Vector): number => Math.hypot(...a);
export const distance = (a: Vector, b: Vector): number => length(difference(a, b));
export const unit = (a: Vector): Vector => scaled(a, 1 / Math.max(length(a), 1e-12));
export const dot = (a: Vector, b: Vector): number => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
export const cross = (a: Vector, b: Vector): Vector => [
  a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0],
];

/** The sum of three vectors times their factors. */
export const combined = (factors: ArrayLike<number>, [a, b, c]: readonly Vector[]): Vector =>
  add(add(scaled(a, factors[0]), b, factors[1]), c, factors[2]);

/** A vector rotated by a quaternion of length 1. */
export function rotated([w, x, y, z]: Quaternion, vector: Vector): Vector {
  const once = cross([x, y, z], vector);
  return add(add(vector, once, 2 * w), cross([x, y, z], once), 2);
}

/** The rotation by the second quaternion, and then by the first. */
export function quaternionProduct([w, x, y, z]: Quaternion, [a, b, c, d]: Quaternion): Quaternion {
  return [
    w * a - x * b - y * c - z * d, x * a + w * b - z * c + y * d,
    y * a + z * b + w * c - x * d, z * a - y * b + x * c + w * d,
  ];
}
