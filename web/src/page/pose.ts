/** Camera poses: eye, target and up vector. */
import type { Gaussians } from '../core/gaussians.ts';
import { add, combined, cross, difference, distance, dot, length, unit, type Vector } from '../core/vectors.ts';
import { type Frame, frameOf, quantile } from './framing.ts';

export interface Pose {
  readonly eye: Vector;
  readonly target: Vector;
  readonly up: Vector; // of length 1
  readonly fov?: readonly [number, number]; // degrees of width and height that the picture shows at least
}

/** -y in captures by COLMAP, z in Blender's. */
export const UPS: Record<string, Vector> = {
  '-y': [0, -1, 0], z: [0, 0, 1], y: [0, 1, 0], '-z': [0, 0, -1], x: [1, 0, 0], '-x': [-1, 0, 0],
};

const [HEIGHTS, DIRECTIONS] = [[0.25, 0.5], 12]; // of the first pose: sines of elevations, and a number around the model
const [UNUSUAL, HIGHER] = [0.1, 0.1]; // what these cost against a share of the subject that is hidden
export const FIELD_OF_VIEW = 50; // degrees, vertical, of poses without one
const [MOST, ALL] = [0.93, 0.995]; // shares of the subject in the first picture: at least, and at most LITTLE further away
const LITTLE = 1.15; // times the distance
const MARGIN = 0.9; // of half the picture
const STEEPEST = (85 * Math.PI) / 180;

/** Unit vectors of the camera: right, down (OpenCV's y) and forward. */
export function axes({ eye, target, up }: Pose): { right: Vector; down: Vector; forward: Vector } {
  const forward = unit(difference(target, eye));
  const right = unit(cross(forward, up));
  return { right, down: cross(forward, right), forward };
}

/**
 * A pose that frames the subject of a model from a little above, whence as little as possible hides it; if possible from
 * the front, -z, or -y where z is up. `aspect`: width / height of the picture.
 */
export function firstPose(model: Gaussians, aspect: number, up?: Vector): Pose {
  const frame = frameOf(model);
  const above = up ?? frame.up;
  const front = Math.abs(above[1]) > 0.5 ? [0, 0, Math.sign(above[1])] as Vector : [0, -1, 0] as Vector;
  const level = unit(add(front, above, -dot(front, above)));
  const side = cross(above, level);
  const candidates = HEIGHTS.flatMap((height, step) => Array.from({ length: DIRECTIONS }, (_, index) => {
    const turn = (2 * Math.PI * index) / DIRECTIONS;
    const flat = Math.sqrt(1 - height * height);
    const away = combined([flat * Math.cos(turn), flat * Math.sin(turn), height], [level, side, above]);
    return { away, cost: hidden(frame, away) + UNUSUAL * (1 - Math.cos(turn)) + HIGHER * step };
  }));
  return framing(frame, aspect, candidates.reduce((best, each) => (each.cost < best.cost ? each : best)).away, above);
}

/** The subject from the direction `away`, as large as it fits. */
function framing({ middle, radius, sample }: Frame, aspect: number, away: Vector, up: Vector): Pose {
  const { right, down, forward } = axes({ eye: away, target: [0, 0, 0], up });
  const basis = [right, down, forward];
  const rows = sample.means.flatMap((mean, row) => (distance(mean, middle) <= radius ? [row] : []));
  const weights = rows.map((row) => sample.weights[row]);
  const places = basis.map((axis) => rows.map((row) => dot(axis, sample.means[row])));
  const center = places.map((values) => (quantile(values, weights, 1 - ALL) + quantile(values, weights, ALL)) / 2);
  // Distances at which each Gaussian is at the edge of the picture.
  const half = MARGIN * Math.tan((FIELD_OF_VIEW * Math.PI) / 360);
  const distances = rows.map((_, at) => {
    const [x, y, z] = places.map((values, axis) => values[at] - center[axis]);
    return Math.max(Math.abs(x) / aspect, Math.abs(y)) / half - z;
  });
  const [most, all] = [MOST, ALL].map((share) => quantile(distances, weights, share));
  const target = combined(center, basis);
  return { eye: add(target, forward, -Math.max(1e-6, Math.min(all, LITTLE * most))), target, up };
}

/**
 * How much of the subject other Gaussians hide from the direction `away`: the sum of their opacities by their share of the
 * solid angle.
 */
function hidden({ middle, radius, sample }: Frame, away: Vector): number {
  const cone = Math.tan((FIELD_OF_VIEW * Math.PI) / 360); // that the subject fills
  const far = radius / cone;
  const eye = add(middle, away, far);
  return sample.means.reduce((total, mean, row) => {
    if (distance(mean, middle) <= radius) return total;
    const offset = difference(mean, eye);
    const depth = -dot(offset, away);
    const [reach, size] = [length(offset), sample.sizes[row]];
    const angle = size / Math.max(reach, size, 1e-9);
    const aside = Math.sqrt(Math.max(0, reach * reach - depth * depth)) / Math.max(depth, 1e-9);
    const covers = reach <= size || (depth > 0 && depth < far && aside < cone + angle);
    return covers ? total + sample.weights[row] * Math.min(1, (angle / cone) ** 2) : total;
  }, 0);
}

/** The pose relative to `to` as `pose` is to `from`: each model has its own coordinates. */
export function transferPose(pose: Pose, from: Pose, to: Pose): Pose {
  const basis = (each: Pose): Vector[] => [axes(each).right, each.up, cross(axes(each).right, each.up)];
  const [before, after] = [basis(from), basis(to)];
  const turn = (vector: Vector): Vector => combined(before.map((axis) => dot(axis, vector)), after);
  const [a, b] = [from, to].map(({ eye, target }) => length(difference(eye, target)));
  const place = (point: Vector): Vector => add(to.target, turn(difference(point, from.target)), b / a);
  return { eye: place(pose.eye), target: place(pose.target), up: turn(pose.up), fov: to.fov };
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

/** The vertical field of view in degrees for a picture of this width / height. */
export function verticalFov({ fov }: Pose, aspect: number): number {
  if (!fov) return FIELD_OF_VIEW;
  const [width, height] = fov.map((each) => Math.tan((each * Math.PI) / 360));
  return (360 / Math.PI) * Math.atan(Math.max(height, width / Math.max(aspect, 1e-3)));
}

/**
 * `#eye=x,y,z&target=x,y,z`, with `&up=z` or `&up=x,y,z` unless up is -y, and `&fov=width,height` if it is not the usual
 * one. `poseOfHash` is the inverse, null on errors.
 */
export function poseToHash(pose: Pose): string {
  const text = (values: Vector): string => values.map((each) => Number(each.toPrecision(6))).join(',');
  const up = upName(pose.up) ?? text(pose.up);
  const fov = pose.fov ? `&fov=${pose.fov.join(',')}` : '';
  return `#eye=${text(pose.eye)}&target=${text(pose.target)}${up === '-y' ? '' : `&up=${up}`}${fov}`;
}

export function poseOfHash(hash: string): Pose | null {
  const values = new URLSearchParams(hash.replace(/^#/, ''));
  const vector = (name: string): Vector | null => {
    const numbers = (values.get(name) ?? '').split(',').map((each) => (each.trim() ? Number(each) : NaN));
    return numbers.length === 3 && numbers.every((each) => Math.abs(each) < 1e6) ? (numbers as unknown as Vector) : null;
  };
  const [eye, target, asked] = [vector('eye'), vector('target'), vector('up')];
  const up = asked && length(asked) > 1e-3 ? unit(asked) : (UPS[values.get('up') ?? '-y'] ?? UPS['-y']);
  const fov = (values.get('fov') ?? '').split(',').map(Number);
  const wide = fov.length === 2 && fov.every((each) => each > 0 && each < 170) ? { fov: fov as [number, number] } : {};
  return eye && target && length(difference(eye, target)) > 1e-9 ? { eye, target, up, ...wide } : null;
}

/** The name of an up vector along a world axis; undefined for others. */
export function upName(up: Vector): string | undefined {
  return Object.keys(UPS).find((name) => dot(UPS[name], up) > 1 - 1e-9);
}
