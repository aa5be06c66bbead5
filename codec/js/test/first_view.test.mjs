// SPDX-License-Identifier: Apache-2.0
// The first view of a scene: the one of the file, else an estimate from the boxes of its tiles.
import assert from 'node:assert/strict';
import { test } from 'node:test';

import { ballOf, directionOf, eyeOf, firstView, readCamera } from '../first_view.mjs';

const UP = [0, -1, 0];
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

const box = (/** @type {number[]} */ min, /** @type {number[]} */ max, splatCount = 1000) => ({ min, max, splatCount });
const BOX = box([9, -5, 5], [11, -3, 9]);
const header = (/** @type {object[]} */ tiles, axes = '') => /** @type {any} */ ({ tiles, axes });
const none = { metadata: null };
/** Where a camera sees a point: half pictures from the middle. */
function placeOf({ viewmat: m, lens }, point) {
  const [x, y, z] = [0, 4, 8].map(
    (row) => m[row] * point[0] + m[row + 1] * point[1] + m[row + 2] * point[2] + m[row + 3],
  );
  return [(2 * lens.fx * x) / z / lens.W, (2 * lens.fy * y) / z / lens.H, z];
}
const corners = ({ min, max }) =>
  Array.from({ length: 8 }, (_, i) => min.map((low, k) => ((i >> k) & 1 ? max[k] : low)));

test('the view of the metadata comes first, then the first camera, then an estimate', () => {
  const other = { ...FILE_CAMERA, W: 320 };
  const described = { metadata: { view: { ...FILE_CAMERA, from: 'author' } }, cameras: [other] };
  const found = firstView(header([BOX]), described, UP);
  assert.deepEqual([found.viewmat, found.lens.W, found.from], [FILE_CAMERA.viewmat.flat(), 640, 'author']);
  const ofCamera = firstView(header([BOX]), { metadata: { view: { K: 1 } }, cameras: [other] }, UP);
  assert.deepEqual([ofCamera.lens.W, ofCamera.from, ofCamera.isFound], [320, 'training', true]);
  const unread = firstView(header([BOX]), { metadata: { view: 'x' }, cameras: [{}] }, UP);
  assert.deepEqual([unread.from, unread.isFound], ['estimate', false]);
});

test('an estimate shows all boxes but those of few splats, from the front and from above', () => {
  const far = box([-5000, -5000, -5000], [5000, 5000, 5000], 10);
  for (const tiles of [[BOX], [BOX, far], [box([9, -5, 5], [10, -3, 9]), box([10, -5, 5], [11, -3, 9]), far]]) {
    const camera = firstView(header(tiles), none, UP);
    const places = corners(BOX).map((corner) => placeOf(camera, corner));
    assert.ok(
      places.every(([x, y, z]) => Math.abs(x) < 1 && Math.abs(y) < 1 && z > camera.near),
      `${places}`,
    );
    assert.ok(Math.max(...places.flatMap(([x, y]) => [Math.abs(x), Math.abs(y)])) > 0.4, 'near enough');
    const { eye } = eyeOf(camera, ballOf(header(tiles)));
    assert.ok(eye[2] < 5 && eye[1] < -4, `${eye}`);
  }
});

test('an estimate is level for any up direction, and sees the front that the axes name', () => {
  for (const [axes, up, front] of [
    ['', [0, 0, 1], 1],
    ['RFU', [0, 0, 1], 1],
    ['RUB', [0, 1, 0], 2],
    ['', [0.6, 0, 0.8], 1],
  ]) {
    const tiles = [box([-1, -1, -1], [1, 1, 1])];
    const camera = firstView(header(tiles, axes), none, up);
    const { viewmat: m } = readCamera({
      ...FILE_CAMERA,
      viewmat: [0, 4, 8, 12].map((at) => camera.viewmat.slice(at, at + 4)),
    });
    assert.ok(Math.abs(m[0] * up[0] + m[1] * up[1] + m[2] * up[2]) < 1e-9, 'the horizon is level');
    assert.ok(m[4] * up[0] + m[5] * up[1] + m[6] * up[2] < -0.9, 'not upside down');
    if (axes) assert.ok(eyeOf(camera, ballOf(header(tiles))).eye[front] * (axes === 'RUB' ? 1 : -1) > 2);
  }
});

test('scenes without splats or with one are shown', () => {
  for (const tiles of [[], [box([1, 2, 3], [1, 2, 3], 1)]]) {
    const camera = firstView(header(tiles), none, UP);
    assert.ok([...camera.viewmat, camera.near].every(Number.isFinite) && camera.near > 0);
  }
});

test('a camera without a near plane has the usual one, and its pivot is as far away as the scene', () => {
  const camera = readCamera(FILE_CAMERA);
  assert.equal(camera.near, 0.2);
  assert.deepEqual(eyeOf(camera, { centre: [1, 1, 0], radius: 1 }), { eye: [-0, -0, -4], distance: 4 });
  assert.equal(eyeOf(camera, { centre: [0, 0, -9], radius: 3 }).distance, 3); // it looks away from the scene
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

test('axes determine the up and front directions', () => {
  assert.deepEqual(directionOf('RDF', 'U'), [0, -1, 0]);
  assert.deepEqual(directionOf('RUB', 'U'), [0, 1, 0]);
  assert.deepEqual(directionOf('RUB', 'F'), [0, 0, -1]);
  assert.deepEqual(directionOf('RFU', 'U'), [0, 0, 1]);
  assert.throws(() => directionOf('RLF', 'U'), RangeError);
});
