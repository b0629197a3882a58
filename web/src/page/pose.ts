/** Where the camera is, what it looks at, and which way is up. */
import { type Gaussians, opacity } from '../core/gaussians.ts';
import { cross, dot } from '../core/similarity.ts';

export type Vector = readonly [number, number, number];

/** -y as captures made with COLMAP have it, z as those of Blender. */
export const UPS = ['-y', 'z', 'y'] as const;
export type Up = (typeof UPS)[number];

export interface Pose {
  readonly eye: Vector;
  readonly target: Vector;
  readonly up: Up;
}

// For each: two horizontal directions of which the cross product is up, the way up, and the side of the first pose.
const FRAMES: Record<Up, { a: Vector; b: Vector; up: Vector; front: Vector }> = {
  '-y': { a: [1, 0, 0], b: [0, 0, 1], up: [0, -1, 0], front: [0, 0, -1] },
  z: { a: [1, 0, 0], b: [0, 1, 0], up: [0, 0, 1], front: [0, -1, 0] },
  y: { a: [0, 0, 1], b: [1, 0, 0], up: [0, 1, 0], front: [0, 0, 1] },
};

export const FIELD_OF_VIEW = 50; // degrees, vertical
const SAMPLE = 20_000; // Gaussians that the first pose is found by
const AWAY = 3; // times the radius of the nearer half
const HEIGHT = 0.35; // of the first pose, as the sine of its elevation
export const STEEPEST = (85 * Math.PI) / 180;

export const add = (a: Vector, b: Vector, scale = 1): Vector => [
  a[0] + scale * b[0], a[1] + scale * b[1], a[2] + scale * b[2],
];
export const difference = (a: Vector, b: Vector): Vector => add(a, b, -1);
export const length = (a: Vector): number => Math.hypot(...a);
export const unit = (a: Vector): Vector => add([0, 0, 0], a, 1 / Math.max(length(a), 1e-12));

/** Unit vectors of the camera: right, down (OpenCV's y) and forward. */
export function axes({ eye, target, up }: Pose): { right: Vector; down: Vector; forward: Vector } {
  const forward = unit(difference(target, eye));
  const right = unit(cross(forward, FRAMES[up].up));
  return { right, down: cross(forward, right), forward };
}

/**
 * From where the detail of a model is in view: inside of the background that captures have around them, and
 * further away where the picture is higher than wide. `aspect`: its width by its height.
 */
export function firstPose(model: Gaussians, up: Up, aspect = 1): Pose {
  const { middle, radius } = framing(model);
  const flat = Math.sqrt(1 - HEIGHT * HEIGHT);
  const away = add(add([0, 0, 0], FRAMES[up].up, HEIGHT), FRAMES[up].front, flat);
  return { eye: add(middle, away, (AWAY * radius) / Math.min(1, aspect)), target: middle, up };
}

const framings = new WeakMap<Gaussians, ReturnType<typeof middleAndRadius>>();

function framing(model: Gaussians): ReturnType<typeof middleAndRadius> {
  const known = framings.get(model) ?? middleAndRadius(model);
  framings.set(model, known);
  return known;
}

/** The pose that shows the second model as `pose` shows the first, which has coordinates of its own. */
export function alike(pose: Pose, from: Gaussians, to: Gaussians): Pose {
  const [a, b] = [framing(from), framing(to)];
  const scale = b.radius / a.radius;
  const place = (point: Vector): Vector => add(b.middle, difference(point, a.middle), scale);
  return { eye: place(pose.eye), target: place(pose.target), up: pose.up };
}

/** Where half of the Gaussians lie, of a sample; each counts by its opacity, since large ones are background. */
function middleAndRadius(model: Gaussians): { middle: Vector; radius: number } {
  const step = Math.max(1, Math.ceil(model.count / SAMPLE));
  const rows: number[] = [];
  for (let row = 0; row < model.count; row += step) rows.push(row);
  const weights = rows.map((row) => opacity(model.opacityLogits[row]));
  const means = rows.map((row): Vector => [model.means[3 * row], model.means[3 * row + 1], model.means[3 * row + 2]]);
  const middle = [0, 1, 2].map((axis) => quantile(means.map((each) => each[axis]), weights, 0.5)) as unknown as Vector;
  const radius = quantile(means.map((each) => length(difference(each, middle))), weights, 0.5);
  return { middle, radius: Math.max(radius, 1e-6) };
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

/** An offset turned about the vertical axis, and towards it as far as it may; angles in radians. */
export function turned(offset: Vector, up: Up, azimuth: number, elevation: number): Vector {
  const distance = length(offset);
  const frame = FRAMES[up];
  const around = Math.atan2(dot(offset, frame.b), dot(offset, frame.a)) + azimuth;
  const height = Math.asin(Math.max(-1, Math.min(1, dot(offset, frame.up) / distance))) + elevation;
  const bounded = Math.max(-STEEPEST, Math.min(STEEPEST, height));
  const flat = add(add([0, 0, 0], frame.a, Math.cos(around)), frame.b, Math.sin(around));
  return add(add([0, 0, 0], flat, Math.cos(bounded) * distance), frame.up, Math.sin(bounded) * distance);
}

/** `#eye=x,y,z&target=x,y,z`, with `&up=z` where up is not -y, and back; null for anything else. */
export function poseToHash(pose: Pose): string {
  const text = (values: Vector): string => values.map((each) => Number(each.toPrecision(6))).join(',');
  return `#eye=${text(pose.eye)}&target=${text(pose.target)}${pose.up === '-y' ? '' : `&up=${pose.up}`}`;
}

export function poseOfHash(hash: string): Pose | null {
  const found = new URLSearchParams(hash.replace(/^#/, ''));
  const vector = (name: string): Vector | null => {
    const numbers = (found.get(name) ?? '').split(',').map((each) => (each.trim() ? Number(each) : NaN));
    return numbers.length === 3 && numbers.every((each) => Math.abs(each) < 1e6) ? (numbers as unknown as Vector) : null;
  };
  const [eye, target] = [vector('eye'), vector('target')];
  const up = upOf(found.get('up'));
  return eye && target && length(difference(eye, target)) > 1e-9 ? { eye, target, up } : null;
}

/** -y for whatever is no way up. */
export function upOf(text: string | null | undefined): Up {
  return UPS.find((each) => each === text) ?? '-y';
}
