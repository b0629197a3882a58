import { expect, test } from 'vitest';
import { emptyGaussians, type Gaussians } from '../src/core/gaussians.ts';
import { add, difference, dot, length, type Vector } from '../src/core/vectors.ts';
import {
  transferPose, axes, FIELD_OF_VIEW, firstPose, poseOfHash, poseToHash, orbit, UPS, upName, verticalFov,
} from '../src/page/pose.ts';

/** 4,000 opaque Gaussians in a box around a middle, or on its floor across an axis. */
function box(middle: Vector, size: Vector, floor?: number): Gaussians {
  const model = emptyGaussians(4000, 0);
  model.opacityLogits.fill(3);
  model.logScales.fill(-4);
  for (let row = 0; row < model.count; row++) model.quats[4 * row] = 1;
  for (let row = 0; row < model.count; row++) {
    for (let axis = 0; axis < 3; axis++) {
      const share = ((row + 1) * [0.7548776662, 0.5698402909, 0.4301597090][axis]) % 1;
      const onFloor = axis === floor && row % 2 === 0;
      model.means[3 * row + axis] = middle[axis] + (onFloor ? -0.5 : share - 0.5) * size[axis];
      if (onFloor) model.logScales[3 * row + axis] = -8;
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

test('a floor is below the model, unless up is given', () => {
  const level = box([0, 0, 0], [1, 1, 1], 1);
  expect(upName(firstPose(level, 1).up)).toBe('y');
  level.means.forEach((value, at) => { level.means[at] = -value; });
  expect(upName(firstPose(level, 1).up)).toBe('-y');
  expect(upName(firstPose(box([0, 0, 0], [1, 1, 1], 2), 1).up)).toBe('z');
  for (const [name, up] of Object.entries(UPS)) expect(upName(firstPose(box([0, 0, 0], [1, 1, 1], 2), 1, up).up)).toBe(name);
});

/** A model and coarse Gaussians all around it, many times as far away. */
function inFog(model: Gaussians, reach: number): Gaussians {
  const shell = box([0, 0, 0], [1, 1, 1]);
  for (let row = 0; row < shell.count; row++) {
    const place = [...shell.means.subarray(3 * row, 3 * row + 3)] as unknown as Vector;
    shell.means.set(add([0, 0, 0], place, reach / Math.max(length(place), 1e-6)), 3 * row);
  }
  shell.logScales.fill(2);
  const both = emptyGaussians(model.count + shell.count, 0);
  for (const column of ['means', 'quats', 'logScales', 'opacityLogits', 'sh'] as const) {
    both[column].set(model[column]);
    both[column].set(shell[column], model[column].length);
  }
  return both;
}

test.each([[6], [20], [100]])('fog at a distance of %d does not decide the framing', (reach) => {
  const model = box([0, 0, 0], [1, 1, 1]);
  const pose = firstPose(inFog(model, reach), 1.3);
  expect(shareInView(model, pose, 1.3)).toBeGreaterThan(0.9);
  const alone = firstPose(model, 1.3);
  expect(length(difference(pose.eye, pose.target)) / length(difference(alone.eye, alone.target))).toBeLessThan(1.2);
  expect(length(difference(pose.target, alone.target))).toBeLessThan(0.1);
});

test('the subject is seen from where nothing hides it', () => {
  const model = box([0, 0, 0], [1, 1, 1]);
  const wall = inFog(model, 1);
  for (let row = model.count; row < wall.count; row++) { // before the usual first view
    const [x, y] = [0.7548776662, 0.5698402909].map((step) => ((row * step) % 1) - 0.5);
    wall.means.set([3 * x, 3 * y, -1.2], 3 * row);
  }
  wall.logScales.fill(-1.5, 3 * model.count);
  expect(firstPose(model, 1).eye[2]).toBeLessThan(-1);
  expect(firstPose(wall, 1).eye[2]).toBeGreaterThan(-1);
});

test('a photo is whole in every window', () => {
  const pose = poseOfHash('#eye=0,0,-2&target=0,0,0&fov=60,40')!;
  for (const aspect of [0.4, 1, 1.5, 3]) {
    const half = Math.tan((verticalFov(pose, aspect) * Math.PI) / 360);
    expect(half).toBeGreaterThanOrEqual(Math.tan(Math.PI / 9) - 1e-9);
    expect(half * aspect).toBeGreaterThanOrEqual(Math.tan(Math.PI / 6) - 1e-9);
    expect(Math.min(half / Math.tan(Math.PI / 9), (half * aspect) / Math.tan(Math.PI / 6))).toBeCloseTo(1);
  }
  expect(poseOfHash(poseToHash(pose))).toEqual(pose);
  expect(verticalFov({ ...pose, fov: undefined }, 0.5)).toBe(FIELD_OF_VIEW);
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
