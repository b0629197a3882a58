/** Camera poses: eye, target and up vector. */
import { type Gaussians, opacity } from '../core/gaussians.ts';
import { cross, dot } from '../core/similarity.ts';

export type Vector = readonly [number, number, number];

export interface Pose {
  readonly eye: Vector;
  readonly target: Vector;
  readonly up: Vector; // of length 1
}

/** -y in captures by COLMAP, z in Blender's. */
export const UPS: Record<string, Vector> = {
  '-y': [0, -1, 0], z: [0, 0, 1], y: [0, 1, 0], '-z': [0, 0, -1], x: [1, 0, 0], '-x': [-1, 0, 0],
};

export const FIELD_OF_VIEW = 50; // degrees, vertical
const SAMPLE = 8_000; // Gaussians for the first pose
const HEIGHT = 0.2; // sine of the first pose's elevation
const [MOST, ALL] = [0.93, 0.995]; // shares of visible Gaussians in the first picture: at least, and at most LITTLE further away
const LITTLE = 1.15; // times the distance
const FURTHEST = 2.5; // times the distance of the training cameras
const MARGIN = 0.94; // of half the picture
const STEEPEST = (85 * Math.PI) / 180;

export const add = (a: Vector, b: Vector, scale = 1): Vector => [
  a[0] + scale * b[0], a[1] + scale * b[1], a[2] + scale * b[2],
];
export const difference = (a: Vector, b: Vector): Vector => add(a, b, -1);
export const length = (a: Vector): number => Math.hypot(...a);
const unit = (a: Vector): Vector => add([0, 0, 0], a, 1 / Math.max(length(a), 1e-12));
const combined = (shares: readonly number[], [a, b, c]: readonly Vector[]): Vector =>
  add(add(add([0, 0, 0], a, shares[0]), b, shares[1]), c, shares[2]);

/** Unit vectors of the camera: right, down (OpenCV's y) and forward. */
export function axes({ eye, target, up }: Pose): { right: Vector; down: Vector; forward: Vector } {
  const forward = unit(difference(target, eye));
  const right = unit(cross(forward, up));
  return { right, down: cross(forward, right), forward };
}

/**
 * A pose that frames nearly all visible Gaussians. `aspect`: width / height of the picture. `captured`: the pose of the
 * training cameras, which then gives direction and up vector, and bounds the distance: rooms are seen from inside.
 */
export function firstPose(model: Gaussians, aspect: number, up?: Vector, captured?: Pose | null): Pose {
  const step = Math.max(1, Math.ceil(model.count / SAMPLE));
  const rows = Array.from({ length: Math.ceil(model.count / step) }, (_, index) => index * step);
  const weights = rows.map((row) => opacity(model.opacityLogits[row]));
  const above = up ?? UPS[isZUp(model, rows, weights) ? 'z' : '-y'];
  const front: Vector = above[1] ? [0, 0, above[1]] : [0, -1, 0];
  const away = add(add([0, 0, 0], above, HEIGHT), front, Math.sqrt(1 - HEIGHT * HEIGHT));
  const pose = captured ?? { eye: away, target: [0, 0, 0] as Vector, up: above };
  const { right, down, forward } = axes(pose);
  const basis = [right, down, forward];
  const places = basis.map((axis) => rows.map((row) => dot(axis, [...model.means.subarray(3 * row, 3 * row + 3)])));
  const middle = places.map((values, axis) => captured ? dot(basis[axis], captured.target)
    : (quantile(values, weights, 1 - ALL) + quantile(values, weights, ALL)) / 2);
  // Distances at which each Gaussian is at the edge of the picture.
  const half = MARGIN * Math.tan((FIELD_OF_VIEW * Math.PI) / 360);
  const distances = rows.map((_, index) => {
    const [x, y, z] = places.map((values, axis) => values[index] - middle[axis]);
    return Math.max(Math.abs(x) / aspect, Math.abs(y)) / half - z;
  });
  const [most, all] = [MOST, ALL].map((share) => quantile(distances, weights, share));
  const captureDistance = captured ? length(difference(captured.eye, captured.target)) : Infinity;
  const furthest = (FURTHEST * captureDistance) / Math.min(1, aspect); // a narrow picture shows less from there
  const distance = Math.max(1e-6, Math.min(all, LITTLE * most, furthest));
  const target = combined(middle, basis);
  return { eye: add(target, forward, -distance), target, up: pose.up };
}

const [SLABS, DOMINANT] = [40, 0.1]; // across most of a model; minimum share in the slab of a floor

/** Whether there is a floor across z, as in Blender's scenes, rather than across y. */
function isZUp(model: Gaussians, rows: number[], weights: number[]): boolean {
  const [y, z] = [1, 2].map((axis) => {
    const places = rows.map((row) => model.means[3 * row + axis]);
    const [low, high] = [1 - MOST, MOST].map((share) => quantile(places, weights, share));
    const slabs = new Float64Array(2 * SLABS);
    places.forEach((place, index) => (slabs[Math.floor(((place - low) / (high - low || 1) + 0.5) * SLABS)] += weights[index]));
    return Math.max(...slabs) / weights.reduce((sum, each) => sum + each, 0);
  });
  return z > DOMINANT && z > 2 * y;
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

/** The pose relative to `to` as `pose` is to `from`: each model has its own coordinates. */
export function transferPose(pose: Pose, from: Pose, to: Pose): Pose {
  const basis = (each: Pose): Vector[] => [axes(each).right, each.up, cross(axes(each).right, each.up)];
  const [before, after] = [basis(from), basis(to)];
  const turn = (vector: Vector): Vector => combined(before.map((axis) => dot(axis, vector)), after);
  const [a, b] = [from, to].map(({ eye, target }) => length(difference(eye, target)));
  const place = (point: Vector): Vector => add(to.target, turn(difference(point, from.target)), b / a);
  return { eye: place(pose.eye), target: place(pose.target), up: turn(pose.up) };
}

/** An offset rotated about `up` and towards it, within limits; angles in radians. */
export function orbit(offset: Vector, up: Vector, azimuth: number, elevation: number): Vector {
  const distance = length(offset);
  const sine = dot(offset, up) / distance;
  const bounded = Math.max(-STEEPEST, Math.min(STEEPEST, Math.asin(Math.max(-1, Math.min(1, sine))) + elevation));
  const flat = unit(add(offset, up, -sine * distance));
  const [cosine, side] = [Math.cos(bounded) * distance, cross(up, flat)];
  return combined([cosine * Math.cos(azimuth), cosine * Math.sin(azimuth), Math.sin(bounded) * distance], [flat, side, up]);
}

/** `#eye=x,y,z&target=x,y,z`, with `&up=z` or `&up=x,y,z` unless up is -y. `poseOfHash` is the inverse, null on errors. */
export function poseToHash(pose: Pose): string {
  const text = (values: Vector): string => values.map((each) => Number(each.toPrecision(6))).join(',');
  const up = upName(pose.up) ?? text(pose.up);
  return `#eye=${text(pose.eye)}&target=${text(pose.target)}${up === '-y' ? '' : `&up=${up}`}`;
}

export function poseOfHash(hash: string): Pose | null {
  const found = new URLSearchParams(hash.replace(/^#/, ''));
  const vector = (name: string): Vector | null => {
    const numbers = (found.get(name) ?? '').split(',').map((each) => (each.trim() ? Number(each) : NaN));
    return numbers.length === 3 && numbers.every((each) => Math.abs(each) < 1e6) ? (numbers as unknown as Vector) : null;
  };
  const [eye, target, asked] = [vector('eye'), vector('target'), vector('up')];
  const up = asked && length(asked) > 1e-3 ? unit(asked) : (UPS[found.get('up') ?? '-y'] ?? UPS['-y']);
  return eye && target && length(difference(eye, target)) > 1e-9 ? { eye, target, up } : null;
}

/** The name of an up vector along a world axis; undefined for others. */
export function upName(up: Vector): string | undefined {
  return Object.keys(UPS).find((name) => dot(UPS[name], up) > 1 - 1e-9);
}
