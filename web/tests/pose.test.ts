import { expect, test } from 'vitest';
import { emptyGaussians, type Gaussians } from '../src/core/gaussians.ts';
import { dot } from '../src/core/similarity.ts';
import {
  add, transferPose, axes, difference, FIELD_OF_VIEW, firstPose, length, poseOfHash, poseToHash, orbit, UPS, upName,
  type Vector,
} from '../src/page/pose.ts';

/** 4,000 opaque Gaussians in a box around a middle, or on its floor across an axis. */
function box(middle: Vector, size: Vector, floor?: number): Gaussians {
  const model = emptyGaussians(4000, 0);
  model.opacityLogits.fill(3);
  for (let row = 0; row < model.count; row++) {
    for (let axis = 0; axis < 3; axis++) {
      const share = ((row + 1) * [0.7548776662, 0.5698402909, 0.4301597090][axis]) % 1;
      const onFloor = axis === floor && row % 2 === 0;
      model.means[3 * row + axis] = middle[axis] + (onFloor ? -0.5 : share - 0.5) * size[axis];
    }
  }
  return model;
}

function shareInView(model: Gaussians, pose: ReturnType<typeof firstPose>, aspect: number): number {
  const { right, down, forward } = axes(pose);
  const half = Math.tan((FIELD_OF_VIEW * Math.PI) / 360);
  let inside = 0;
  for (let row = 0; row < model.count; row++) {
    const offset = difference([...model.means.subarray(3 * row, 3 * row + 3)] as unknown as Vector, pose.eye);
    const depth = dot(offset, forward);
    inside += Number(Math.abs(dot(offset, right)) < half * aspect * depth && Math.abs(dot(offset, down)) < half * depth);
  }
  return inside / model.count;
}

test.each([[0.5], [1], [1.6]])('the first pose frames a model at aspect %f', (aspect) => {
  for (const size of [[1, 1, 1], [9, 1, 1], [1, 9, 1], [1, 1, 9]] as Vector[]) {
    const model = box([5, -3, 8], size);
    const pose = firstPose(model, aspect);
    expect(shareInView(model, pose, aspect)).toBeGreaterThan(0.97);
    expect(length(difference(pose.target, [5, -3, 8]))).toBeLessThan(0.3);
  }
});

test('a floor across z means z up, unless given', () => {
  expect(upName(firstPose(box([0, 0, 0], [1, 1, 1], 2), 1).up)).toBe('z');
  expect(upName(firstPose(box([0, 0, 0], [1, 1, 1], 1), 1).up)).toBe('-y');
  for (const [name, up] of Object.entries(UPS)) expect(upName(firstPose(box([0, 0, 0], [1, 1, 1], 2), 1, up).up)).toBe(name);
});

test('training cameras set direction and tilt, and bound the distance', () => {
  const up: Vector = [0.6, -0.8, 0];
  const captured = { eye: [0, 0, -2] as Vector, target: [0, 0, 0] as Vector, up };
  const pose = firstPose(box([0, 0, 0], [100, 100, 100]), 1, undefined, captured);
  expect(pose.up).toEqual(up);
  expect(length(difference(pose.eye, [0, 0, -5]))).toBeLessThan(1e-9);
  const portrait = firstPose(box([0, 0, 0], [100, 100, 100]), 0.5, undefined, captured);
  expect(length(difference(portrait.eye, [0, 0, -10]))).toBeLessThan(1e-9);
});

test('poses round trip through the address', () => {
  for (const up of [...Object.values(UPS), [0.6, -0.8, 0] as Vector]) {
    const pose = { eye: [1.5, -2.25, 1e-3] as Vector, target: [0.125, 3, -400] as Vector, up };
    expect(poseOfHash(poseToHash(pose))).toEqual(pose);
  }
  expect(poseToHash({ eye: [1, 2, 3], target: [0, 0, 0], up: UPS['-y'] })).toBe('#eye=1,2,3&target=0,0,0');
  expect(poseOfHash('#eye=1,2,3&target=0,0,0&up=sideways')?.up).toEqual(UPS['-y']);
  for (const wrong of ['', '#', '#eye=1,2,3', '#eye=1,2,3&target=1,2,3', '#eye=1,2&target=0,0,0', '#eye=1,2,1e9&target=0,0,0']) {
    expect(poseOfHash(wrong)).toBeNull();
  }
});

test('poses transfer between models', () => {
  const [from, to] = [firstPose(box([0, 0, 0], [1, 1, 1]), 1), firstPose(box([7, 7, 7], [3, 3, 3], 2), 1)];
  const same = transferPose(from, from, to);
  for (const part of ['eye', 'target', 'up'] as const) expect(length(difference(same[part], to[part]))).toBeLessThan(1e-6);
  const elsewhere = { ...from, eye: add(from.eye, [0.3, -0.2, 0.5]) };
  const back = transferPose(transferPose(elsewhere, from, to), to, from);
  for (const part of ['eye', 'target', 'up'] as const) expect(length(difference(back[part], elsewhere[part]))).toBeLessThan(1e-6);
});

test('orbiting keeps the distance and stops below the pole', () => {
  const offset = orbit([0, 0, -4], UPS['-y'], 1, 10);
  expect(length(offset)).toBeCloseTo(4);
  expect(dot(offset, UPS['-y'])).toBeLessThan(4);
});
