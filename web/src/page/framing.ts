/** What a picture of a model should show: its subject, and which way is up. Counterpart of `keyss.rendering.framing`. */
import { type Gaussians, opacity } from '../core/gaussians.ts';
import {
  combined, cross, difference, distance, dot, type Quaternion, rotated, scaled, unit, type Vector, vectorAt,
} from '../core/vectors.ts';

const SAMPLE = 4_000; // Gaussians that are looked at
const [SHRINK, STEPS] = [0.87, 60]; // ratio of radii, and their number: down to 1/4,000
const LEAST = 0.08; // share of the weight in the smallest sphere
// Exponent of the radius in a sphere's weight: between 1, as of lines, and that of clutter around a subject.
const GROWTH = 0.87;
const OUTLIERS = 0.995; // share of the weight of a model without surroundings that its sphere holds
const COARSER = 1.25; // ratio of the sizes of Gaussians outside and inside, above which those outside are surroundings
const [SLABS, REACH] = [40, 1.2]; // slabs across 1.2 radii to both sides, which may hold a floor
const ALIGNED = 0.7; // minimum cosine of a floor's normal with the direction across it
// Degrees from -y, as captures leave it: the first camera looks down or up, and is hardly rolled.
const [LOWEST, HIGHEST, ROLLS] = [-10, 55, [-8, 0, 8]];
const [STEP, EXACT] = [5, 6]; // degrees between those directions; from the axes of other programs
const [TILTED_FLOOR, AXIS_FLOOR] = [0.095, 0.15]; // share of the Gaussians, by size, in a floor
const CLEARLY = 1.3; // ratio of the floor across an axis to that across a tilted direction
const AXES: readonly Vector[] = [[1, 0, 0], [0, 1, 0], [0, 0, 1]];
const BELOW = 0.05; // radii by which the middle of a model is below a floor across y where y is up

/** Gaussians of a model, sampled. */
export interface Sample {
  readonly means: readonly Vector[];
  readonly weights: readonly number[]; // opacities
  readonly sizes: readonly number[]; // of their largest cross-section
}

/** A sphere around the subject of a model, and the up direction, of length 1. */
export interface Frame {
  readonly middle: Vector;
  readonly radius: number;
  readonly up: Vector;
  readonly sample: Sample;
}

/**
 * The dense, opaque part of a model, without coarse surroundings, faint Gaussians and outliers.
 *
 * The subject is the sphere with the most opacity for its size; if what lies outside is as fine, all of it. Up is the
 * normal of the largest floor below most of the model, among the directions that captures have, and along z and y, as
 * other programs have it; -y without a floor.
 */
export function frameOf(model: Gaussians): Frame {
  const step = Math.max(1, Math.ceil(model.count / SAMPLE));
  const rows = Array.from({ length: Math.ceil(model.count / step) }, (_, index) => index * step);
  const means = rows.map((row) => vectorAt(model.means, row));
  let weights = rows.map((row) => opacity(model.opacityLogits[row]) || 0);
  if (!weights.some(Boolean)) weights = weights.map(() => 1);
  const ordered = rows.map((row) => vectorAt(model.logScales, row).map(Math.exp).sort((a, b) => a - b));
  const sizes = ordered.map(([, b, c]) => Math.sqrt(b * c));
  let { middle, radius } = densest(means, weights);
  let inside = within(means, middle, radius);
  const isInside = new Set(inside);
  const outside = means.flatMap((_, at) => (isInside.has(at) ? [] : [at]));
  if (!outside.length || median(sizes, weights, outside) < COARSER * median(sizes, weights, inside)) {
    middle = middleOf(means, weights);
    const distances = means.map((mean) => distance(mean, middle));
    radius = Math.max(quantile(distances, weights, OUTLIERS), 1e-6);
    inside = means.flatMap((_, at) => (distances[at] <= radius ? [at] : []));
  }
  const large = quantile(sizes, sizes.map(() => 1), 0.95);
  const extents = sizes.map((size, at) => weights[at] * Math.min(size, large));
  const floors = new Floors(
    inside.map((at) => scaled(difference(means[at], middle), 1 / radius)),
    inside.map((at) => normal(model, rows[at])),
    inside.map((at) => extents[at]),
  );
  return { middle, radius, up: floors.up(), sample: { means, weights, sizes } };
}

/** The sphere with the largest weight / radius ^ GROWTH. */
function densest(means: readonly Vector[], weights: readonly number[]): { middle: Vector; radius: number } {
  const total = sum(weights);
  let middle = middleOf(means, weights);
  let radius = Math.max(quantile(means.map((mean) => distance(mean, middle)), weights, 0.995), 1e-6) / SHRINK;
  let [best, found] = [-1, { middle, radius }];
  for (let step = 0; step < STEPS; step++) {
    radius *= SHRINK;
    let inside = within(means, middle, radius);
    if (sum(inside.map((at) => weights[at])) < LEAST * total) break;
    middle = middleOf(means, weights, inside);
    inside = within(means, middle, radius);
    const score = sum(inside.map((at) => weights[at])) / radius ** GROWTH;
    if (score > best) [best, found] = [score, { middle, radius }];
  }
  return found;
}

/** Gaussians that may lie in a floor: offsets from the middle in radii, normals, and sizes, times opacities. */
class Floors {
  constructor(
    private readonly offsets: readonly Vector[], private readonly normals: readonly Vector[],
    private readonly extents: readonly number[],
  ) {}

  up(): Vector {
    const [down, z] = [[0, -1, 0], [0, 0, 1]] as Vector[];
    const tilted = this.largest(cap(this.largest(ofCaptures()).direction, STEP, 20));
    const level = this.largest(cap(down, EXACT, 20), -Infinity);
    if (this.largest(cap(z, EXACT, 20)).share > Math.max(AXIS_FLOOR, CLEARLY * tilted.share)) return z;
    if (level.share > AXIS_FLOOR && level.share * CLEARLY > tilted.share) return level.above > -BELOW ? down : [0, 1, 0];
    return tilted.share > TILTED_FLOOR ? tilted.direction : down;
  }

  /**
   * The largest floor across one of the directions: its share of the extents, how far in radii the model is above it on
   * average, at least `leastAbove`, and the direction.
   */
  private largest(directions: readonly Vector[], leastAbove = 0): Floor {
    const total = Math.max(sum(this.extents), 1e-30);
    let best: Floor = { share: 0, above: 0, direction: directions[0] };
    for (const direction of directions) {
      const slabs = new Float64Array(SLABS);
      let middle = 0;
      for (let at = 0; at < this.extents.length; at++) {
        const height = dot(direction, this.offsets[at]);
        middle += height * this.extents[at];
        if (Math.abs(dot(direction, this.normals[at])) <= ALIGNED) continue;
        slabs[Math.max(0, Math.min(SLABS - 1, Math.trunc(((height / REACH + 1) * SLABS) / 2)))] += this.extents[at];
      }
      const pairs = slabs.slice(1).map((area, at) => area + slabs[at]);
      const floor = pairs.indexOf(Math.max(...pairs));
      const share = pairs[floor] / total;
      const above = middle / total - ((2 * (floor + 1)) / SLABS - 1) * REACH;
      if (share > best.share && above > leastAbove) best = { share, above, direction };
    }
    return best;
  }
}

interface Floor {
  readonly share: number;
  readonly above: number;
  readonly direction: Vector;
}

/** Up directions in the frame of a first camera that is pitched, and hardly rolled. */
function ofCaptures(): Vector[] {
  const directions: Vector[] = [];
  for (let pitch = LOWEST; pitch <= HIGHEST; pitch += STEP) {
    for (const roll of ROLLS) {
      const [p, r] = [(pitch * Math.PI) / 180, (roll * Math.PI) / 180];
      directions.push([Math.sin(r), -Math.cos(r) * Math.cos(p), -Math.cos(r) * Math.sin(p)]);
    }
  }
  return directions;
}

/** Directions within `degrees` of an axis other than x, which is the first, evenly spread. */
function cap(axis: Vector, degrees: number, count: number): Vector[] {
  const side = unit(cross(axis, [1, 0, 0]));
  const basis = [axis, side, cross(axis, side)];
  return Array.from({ length: count }, (_, index) => {
    const along = 1 - ((1 - Math.cos((degrees * Math.PI) / 180)) * index) / count;
    const turn = index * Math.PI * (3 - Math.sqrt(5));
    const aside = Math.sqrt(1 - along * along);
    return combined([along, aside * Math.cos(turn), aside * Math.sin(turn)], basis);
  });
}

/** The shortest axis of a Gaussian. */
function normal(model: Gaussians, row: number): Vector {
  const quat = [...model.quats.subarray(4 * row, 4 * row + 4)];
  const rotation = quat.map((each) => each / Math.max(Math.hypot(...quat), 1e-12)) as unknown as Quaternion;
  const scales = vectorAt(model.logScales, row);
  return rotated(rotation, AXES[scales.indexOf(Math.min(...scales))]);
}

/** Rows of the places closer to `middle` than `radius`. */
function within(means: readonly Vector[], middle: Vector, radius: number): number[] {
  return means.flatMap((mean, at) => (distance(mean, middle) < radius ? [at] : []));
}

const sum = (values: readonly number[]): number => values.reduce((total, each) => total + each, 0);

function middleOf(means: readonly Vector[], weights: readonly number[], rows?: readonly number[]): Vector {
  return [0, 1, 2].map((axis) => median(means.map((mean) => mean[axis]), weights, rows)) as unknown as Vector;
}

function median(values: readonly number[], weights: readonly number[], rows?: readonly number[]): number {
  return quantile(values, weights, 0.5, rows);
}

/** Of the values in `rows`, by default of all. */
export function quantile(
  values: readonly number[], weights: readonly number[], share: number, rows: Iterable<number> = values.keys(),
): number {
  const order = [...rows].sort((a, b) => values[a] - values[b]);
  const bound = share * sum(order.map((row) => weights[row]));
  let total = 0;
  for (const row of order) {
    total += weights[row];
    if (total >= bound) return values[row];
  }
  return values[order.at(-1) ?? 0] ?? 0;
}
