/** Where the camera is and what it looks at; up is -y, as captures made with COLMAP have it. */
import { type Gaussians, opacity } from '../core/gaussians.ts';

export type Vector = readonly [number, number, number];

export interface Pose {
  readonly eye: Vector;
  readonly target: Vector;
}

export const FIELD_OF_VIEW = 50; // degrees, vertical
const SAMPLE = 20_000; // Gaussians that the first pose is found by
const [LARGE, MOST] = [0.95, 10]; // a weight's quantile, and what the largest may be of it
const HEIGHT = 0.35; // of the first pose, as the sine of its elevation
export const STEEPEST = (85 * Math.PI) / 180;

export const add = (a: Vector, b: Vector, scale = 1): Vector => [
  a[0] + scale * b[0], a[1] + scale * b[1], a[2] + scale * b[2],
];
export const difference = (a: Vector, b: Vector): Vector => add(a, b, -1);
export const length = (a: Vector): number => Math.hypot(...a);
export const cross = (a: Vector, b: Vector): Vector => [
  a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0],
];
export const unit = (a: Vector): Vector => add([0, 0, 0], a, 1 / Math.max(length(a), 1e-12));

/** Unit vectors of the camera: right, down (OpenCV's y) and forward. */
export function axes({ eye, target }: Pose): { right: Vector; down: Vector; forward: Vector } {
  const forward = unit(difference(target, eye));
  const right = unit(cross([0, 1, 0], forward));
  return { right, down: cross(forward, right), forward };
}

/** From where most of what can be seen of a model is in view. */
export function firstPose(model: Gaussians): Pose {
  const { middle, radius } = middleAndRadius(model);
  const reach = (0.8 * radius) / Math.sin((FIELD_OF_VIEW / 2) * (Math.PI / 180));
  const flat = Math.sqrt(1 - HEIGHT * HEIGHT);
  return { eye: add(middle, [0, -HEIGHT, -flat], reach), target: middle };
}

/** As `keyss.rendering.orbit` finds them, of a sample: huge and faint Gaussians count little. */
export function middleAndRadius(model: Gaussians): { middle: Vector; radius: number } {
  const step = Math.max(1, Math.ceil(model.count / SAMPLE));
  const rows: number[] = [];
  for (let row = 0; row < model.count; row += step) rows.push(row);
  const weights = rows.map((row) => {
    const scales = Array.from(model.logScales.subarray(3 * row, 3 * row + 3)).sort((a, b) => a - b);
    const weight = opacity(model.opacityLogits[row]) * Math.exp(scales[1] + scales[2]);
    return Number.isFinite(weight) ? weight : 0;
  });
  const most = MOST * quantile(weights, weights.map(() => 1), LARGE);
  const bounded = weights.map((weight) => Math.min(weight, most));
  const means = rows.map((row): Vector => [model.means[3 * row], model.means[3 * row + 1], model.means[3 * row + 2]]);
  const middle = [0, 1, 2].map((axis) => quantile(means.map((each) => each[axis]), bounded, 0.5)) as unknown as Vector;
  const distances = means.map((each) => length(difference(each, middle)));
  const [half, nearly] = [0.5, 0.9].map((share) => quantile(distances, bounded, share));
  return { middle, radius: Math.max(Math.min(nearly, 3 * half), 1e-6) };
}

function quantile(values: number[], weights: number[], share: number): number {
  const order = [...values.keys()].sort((a, b) => values[a] - values[b]);
  const total = weights.reduce((sum, each) => sum + each, 0);
  let sum = 0;
  for (const row of order) {
    sum += weights[row];
    if (sum >= share * total) return values[row];
  }
  return values[order.at(-1) ?? 0] ?? 0;
}

/** `#eye=x,y,z&target=x,y,z`, and back; null for anything else. */
export function poseToHash(pose: Pose): string {
  const text = (values: Vector): string => values.map((each) => Number(each.toPrecision(6))).join(',');
  return `#eye=${text(pose.eye)}&target=${text(pose.target)}`;
}

export function poseOfHash(hash: string): Pose | null {
  const found = new URLSearchParams(hash.replace(/^#/, ''));
  const vector = (name: string): Vector | null => {
    const numbers = (found.get(name) ?? '').split(',').map((each) => (each.trim() ? Number(each) : NaN));
    return numbers.length === 3 && numbers.every((each) => Math.abs(each) < 1e6) ? (numbers as unknown as Vector) : null;
  };
  const [eye, target] = [vector('eye'), vector('target')];
  return eye && target && length(difference(eye, target)) > 1e-9 ? { eye, target } : null;
}
