// SPDX-License-Identifier: Apache-2.0
// The initial view of several kinds of scenes, made of samples. It must not depend on a few far splats.
import assert from 'node:assert/strict';
import { test } from 'node:test';

import { automaticPose, cameraPose, directionOf, frontFor, readCamera, upOfCameras, waysUp } from '../autocamera.mjs';
import { evened, findFrame, quantiles } from '../bounding_frame.mjs';
import { OrbitCamera, pivotOf } from '../orbit_camera.mjs';
import { emptyPose } from '../camera_list.mjs';
import { ROUGH, detail, pick } from '../rough_view.mjs';
import { dot, length, lookAlong, sub } from '../vectors.mjs';

const UP = [0, -1, 0];
const WAYS = { up: UP, front: [0, 0, 1], isFrontKnown: true };

/** Reproducible random numbers between 0 and 1 (a linear congruential generator). */
function numbers(seed = 1) {
  let state = seed;
  return () => (state = (1664525 * state + 1013904223) % 2 ** 32) / 2 ** 32;
}

/** A random direction, uniform on the sphere. */
function direction(next) {
  const z = 2 * next() - 1;
  const angle = 2 * Math.PI * next();
  const r = Math.sqrt(1 - z * z);
  return [r * Math.cos(angle), z, r * Math.sin(angle)];
}

function scene(points, weight = 1e-3) {
  const weights = new Float32Array(points.length).fill(weight);
  return { samples: Float32Array.from(points.flat()), weights };
}

function ball(count, centre, radius, next = numbers()) {
  return Array.from({ length: count }, () => direction(next).map((value, k) => centre[k] + radius * value));
}

/** A box of 8 × 3 × 6 units, viewed from inside: floor, ceiling, walls, and a table in the middle. */
function room(next = numbers(7)) {
  const half = [4, 1.5, 3];
  const walls = Array.from({ length: 6000 }, (_, i) => {
    const point = half.map((value) => value * (2 * next() - 1));
    point[i % 3] = half[i % 3] * (i % 2 ? 1 : -1);
    return point;
  });
  return [...walls, ...ball(300, [0, 0.8, 0], 0.5, next)];
}

/** Share of the samples within the picture, and the distance of their centre from its middle, in half pictures. */
function seen({ samples }, pose, extent, width = 640, height = 480) {
  const { viewmat: m, fx, fy, cx, cy, near } = new OrbitCamera(pose, extent).camera(width, height);
  let inside = 0;
  const sum = [0, 0];
  for (let i = 0; i < samples.length; i += 3) {
    const point = samples.subarray(i, i + 3);
    const [a, b, c] = [0, 4, 8].map((row) => dot(m.slice(row, row + 3), point) + m[row + 3]);
    const [x, y] = [(fx * a) / c + cx, (fy * b) / c + cy];
    if (c <= near || x < 0 || y < 0 || x > width || y > height) continue;
    inside++;
    sum[0] += x / width - 0.5;
    sum[1] += y / height - 0.5;
  }
  return { share: inside / (samples.length / 3), aside: Math.hypot(sum[0], sum[1]) / (inside || 1) };
}

test('quantiles use weights', () => {
  assert.deepEqual(quantiles([5, 1, 3], [1, 1, 1], [0, 0.5, 1]), [1, 3, 5]);
  assert.deepEqual(quantiles([5, 1, 3], [8, 1, 1], [0.15, 0.5]), [3, 5]);
});

test('a splat as large as the sky weighs no more than others', () => {
  assert.deepEqual([...evened([0.5, 1, 1e9])], [0.5, 1, 1]);
  assert.deepEqual([...evened([0, 0])], [1, 1]);
});

for (const far of [0, 3, 12]) {
  test(`an object is shown whole and centred despite ${far} far splats`, () => {
    const next = numbers(3);
    const outliers = Array.from({ length: far }, () => direction(next).map((value) => 5000 * value));
    const samples = scene([...ball(3000, [10, -4, 7], 2), ...outliers]);
    const { pose, frame } = automaticPose(samples, 100_000, WAYS);
    assert.equal(frame.kind, 'object');
    assert.ok(length(sub(frame.centre, [10, -4, 7])) < 0.2);
    const { share, aside } = seen(samples, pose, frame.extent);
    assert.ok(share > 0.97, `${share} of the object is in the picture`);
    assert.ok(aside < 0.1);
    assert.ok(length(sub(pose.eye, [10, -4, 7])) < 7, 'near enough to fill the picture');
  });
}

test('an object is shown from the front and from above', () => {
  const { pose } = automaticPose(scene(ball(2000, [0, 0, 0], 1)), 2000, WAYS);
  assert.ok(pose.eye[2] < 0, 'in front of it');
  assert.ok(pose.eye[1] < 0, 'above it');
  assert.ok(dot(pose.basis[1], UP) < -0.8, 'upright');
});

test('an object of unknown axes is shown from the side with most detail', () => {
  const next = numbers(11);
  const side = (z) => Array.from({ length: 1500 }, () => [2 * next() - 1, 2 * next() - 1, z]);
  const samples = scene([...side(0), ...side(0.3)], 1e-4);
  samples.weights.fill(0.3, 0, 1500); // the side that faces −z is smeared
  assert.ok(automaticPose(samples, 100_000, { ...WAYS, isFrontKnown: false }).pose.eye[2] > 0.3);
  assert.ok(automaticPose(samples, 100_000, WAYS).pose.eye[2] < 0);
});

test('a flat, round object is not a room', () => {
  const next = numbers(13);
  const torus = Array.from({ length: 8000 }, () => {
    const [a, b] = [2 * Math.PI * next(), 2 * Math.PI * next()];
    const r = 1 + 0.45 * Math.cos(b);
    return [r * Math.cos(a), 0.45 * Math.sin(b), r * Math.sin(a)];
  });
  assert.equal(findFrame(scene(torus), UP).kind, 'object');
});

test('surroundings are shown from near their middle', () => {
  const next = numbers(5);
  const middle = [0.3, 0.6, 1].flatMap((radius) => ball(1000, [0, 0, 0], radius, next));
  const background = Array.from({ length: 1500 }, () => direction(next).map((value) => (30 + 30 * next()) * value));
  const samples = scene([...middle, ...background], 0.01);
  samples.weights.fill(2, 3000); // far splats are large
  const { pose, frame } = automaticPose(samples, 500_000, WAYS);
  assert.equal(frame.kind, 'surroundings');
  assert.ok(length(pose.eye) < 4 * frame.extent, `at ${pose.eye}`);
  assert.ok(length(pivotOf(pose)) < 0.2 * frame.extent, 'looks at the middle');
  assert.ok(seen({ samples: samples.samples.subarray(0, 9000) }, pose, frame.extent).share > 0.3);
});

test('a wall of a few large splats occludes the splats behind it', () => {
  const things = ball(2000, [0, 0, 0], 0.5);
  const wall = [-1, 0, 1].flatMap((x) => [-1, 0, 1].map((y) => [x, y, 1.5]));
  const samples = scene([...things, ...wall], 1e-4);
  samples.weights.fill(4, things.length);
  const from = (z) => {
    const pose = { ...emptyPose(), eye: [0, 0, z], basis: lookAlong([0, 0, -z], UP) };
    return detail(samples, 1, new OrbitCamera(pose, 1).camera(ROUGH.width, ROUGH.height), 0);
  };
  assert.ok(from(3) < 0.5 * from(-3), `${from(3)} of ${from(-3)}`);
});

test('a closed room is shown from inside', () => {
  const { pose, frame } = automaticPose(scene(room(), 0.01), 300_000, WAYS);
  assert.equal(frame.kind, 'room');
  const [x, y, z] = pose.eye;
  assert.ok(Math.abs(x) < 4 && Math.abs(y) < 1.5 && Math.abs(z) < 3, `at ${pose.eye}`);
});

test('a solid box without a bottom is not a room', () => {
  const open = room().filter(([, y]) => y < 1.2);
  assert.equal(findFrame(scene(open), UP).kind, 'object');
});

test('scenes of no splat, one splat, or several at one position are shown', () => {
  for (const points of [[], [[1, 2, 3]], Array.from({ length: 9 }, () => [1, 2, 3])]) {
    const { pose, frame } = automaticPose(scene(points, 0.04), points.length, WAYS);
    assert.ok([...pose.eye, pose.distance, frame.extent].every(Number.isFinite));
    assert.ok(pose.distance > 0 && frame.extent > 0);
  }
});

test('axes determine the up and front directions', () => {
  assert.deepEqual(directionOf('RDF', 'U'), [0, -1, 0]);
  assert.deepEqual(directionOf('RUB', 'U'), [0, 1, 0]);
  assert.deepEqual(directionOf('RUB', 'F'), [0, 0, -1]);
  assert.deepEqual(directionOf('RFU', 'U'), [0, 0, 1]);
  assert.throws(() => directionOf('RLF', 'U'), RangeError);
  assert.deepEqual(frontFor('RDF', UP), [0, 0, 1]);
  assert.equal(dot(frontFor('RDF', [0, 0, 1]), [0, 0, 1]), 0);
});

test('an object with its own axes is shown from the front', () => {
  const samples = scene(ball(2000, [0, 0, 0], 1));
  const [up, front] = ['U', 'F'].map((letter) => directionOf('RFU', letter));
  const { pose } = automaticPose(samples, 2000, { up, front, isFrontKnown: true });
  assert.ok(pose.eye[1] < 0 && pose.eye[2] > 0);
});

test('six up directions are offered, each once, the current one first', () => {
  for (const first of [UP, [0, 0, 1]]) {
    const ways = waysUp(first);
    assert.equal(ways.length, 6);
    assert.deepEqual(ways[0], first);
    assert.equal(new Set(ways.map(String)).size, 6);
  }
});

const FILE_CAMERA = {
  K: [
    [500, 0, 320],
    [0, 500, 240],
    [0, 0, 1],
  ],
  viewmat: [
    [1, 0, 0, 0],
    [0, 1, 0, 0],
    [0, 0, 1, 4],
    [0, 0, 0, 1],
  ],
  W: 640,
  H: 480,
};

test('a camera of a file orbits the surface it looks at', () => {
  const samples = scene(ball(3000, [0, 0, 0], 1), 0.01);
  const pose = cameraPose(readCamera(FILE_CAMERA), samples, findFrame(samples, UP), UP);
  assert.deepEqual(pose.viewmat, FILE_CAMERA.viewmat.flat());
  assert.deepEqual(
    pose.eye.map((value) => value + 0),
    [0, 0, -4],
  );
  assert.ok(pose.distance > 2.8 && pose.distance < 4, `${pose.distance}`);
  assert.equal(pose.near, 0.2);
});

for (const [what, change] of Object.entries({
  'no viewmat': { viewmat: undefined },
  'a scaled viewmat': { viewmat: FILE_CAMERA.viewmat.map((row) => row.map((value) => 2 * value)) },
  'a mirrored viewmat': { viewmat: [[-1, 0, 0, 0], ...FILE_CAMERA.viewmat.slice(1)] },
  'a transposed viewmat': { viewmat: [0, 1, 2, 3].map((k) => FILE_CAMERA.viewmat.map((row) => row[k])) },
  'NaN in K': {
    K: [
      [NaN, 0, 0],
      [0, 1, 0],
      [0, 0, 1],
    ],
  },
  'no size': { W: 0 },
})) {
  test(`a camera with ${what} is refused`, () => {
    assert.throws(() => readCamera({ ...FILE_CAMERA, ...change }), TypeError);
  });
}

test('the up direction is that of level cameras', () => {
  const looking = (forward, up) => {
    const [right, down, ahead] = lookAlong(forward, up);
    return { viewmat: [...right, 0, ...down, 0, ...ahead, 0, 0, 0, 0, 1] };
  };
  const around = [0, 1, 2, 3, 4].map((i) => looking([Math.cos(i), Math.sin(i), -0.3], [0, 0, 1]));
  assert.deepEqual(
    upOfCameras(around).map((value) => value + 0),
    [0, 0, 1],
  );
  const slanted = upOfCameras([looking([1, 0, 0], [0, 0.6, 0.8])]);
  assert.ok(Math.abs(slanted[1] - 0.6) < 1e-9);
});

test('the nearest surface is picked, not the background or floaters', () => {
  const next = numbers(9);
  const wall = (z) => Array.from({ length: 4000 }, () => [4 * next() - 2, 4 * next() - 2, z]);
  const samples = scene([...wall(1), ...wall(6), [0, 0, -3.5]], 0.01);
  const camera = { viewmat: FILE_CAMERA.viewmat.flat(), fx: 500, fy: 500, cx: 320, cy: 240, near: 0.2 };
  const point = pick(samples, camera, 420, 240);
  assert.ok(Math.abs(point[2] - 1) < 0.01 && Math.abs(point[0] - 1) < 0.05, `${point}`);
  assert.equal(pick(scene([[0, 0, -10]]), camera, 320, 240), null);
});
