// SPDX-License-Identifier: Apache-2.0
// Sources of the up direction, and their order.
import assert from 'node:assert/strict';
import { test } from 'node:test';

import { CameraList, emptyPose } from '../camera_list.mjs';
import { OrbitCamera } from '../orbit_camera.mjs';

/** A camera of a file, level if +z is up. */
const LEVEL = {
  K: [
    [90, 0, 40],
    [0, 90, 30],
    [0, 0, 1],
  ],
  viewmat: [
    [1, 0, 0, 0],
    [0, 0, -1, 0],
    [0, 1, 0, 0],
    [0, 0, 0, 1],
  ],
  W: 80,
  H: 60,
};

function opened({ axes = '', metadata = null, cameras = null }, wanted = {}) {
  const view = new CameraList(null, { touched: false }, { up: null, axes: null, ...wanted });
  view.begin();
  view.read({ axes, tiles: [] }, { metadata, cameras });
  return view;
}

test('the up direction of the user comes first, then that of metadata, axes and cameras', () => {
  const said = { axes: 'LUF', metadata: { up: [0, 0.6, -0.8] }, cameras: [LEVEL] };
  assert.deepEqual(opened(said, { up: [1, 0, 0], axes: 'RFU' }).up, [1, 0, 0]);
  assert.deepEqual(opened(said, { axes: 'RFD' }).up, [0, 0, -1]);
  const [x, y, z] = opened(said).up;
  assert.ok(Math.hypot(x, y - 0.6, z + 0.8) < 1e-9);
  assert.deepEqual(opened({ ...said, metadata: null }).up, [0, 1, 0]);
  assert.deepEqual(opened({ cameras: [LEVEL] }).up, [0, 0, 1]);
  assert.deepEqual(opened({}).up, [0, -1, 0]);
});

test('no other up direction is offered if it is known', () => {
  for (const said of [{ axes: 'RFU' }, { metadata: { up: [0, 0, 1] } }, { cameras: [LEVEL] }]) {
    assert.ok(opened(said).knowsUp);
  }
  assert.ok(opened({}, { up: [0, 0, 1] }).knowsUp);
  assert.ok(!opened({}).knowsUp);
});

test('invalid metadata are ignored', () => {
  const behind = (background) => opened({ metadata: { training: { background } } }).facts.background;
  assert.deepEqual(behind([1, 0.5, 0]), [1, 0.5, 0]);
  for (const wrong of ['white', [1, 1], [1, 1, 1, 1], [1, 1, 2], [1, -1, 1], [1, null, 1], ['1', 1, 1]]) {
    assert.equal(behind(wrong), null);
  }
  assert.equal(opened({ metadata: { training: 'white' } }).facts.background, null);
  for (const up of ['z', [0, 1], [0, 0, 0], [0, null, 1], ['0', '0', '1'], [0, 0, 1, 0], { x: 1 }]) {
    assert.deepEqual(opened({ axes: 'RFU', metadata: { up } }).up, [0, 0, 1]);
    assert.ok(!opened({ metadata: { up } }).knowsUp);
  }
});

test('the first view is placed when the header is here, and stays when the splats arrive', () => {
  const rig = new OrbitCamera(emptyPose(), 1);
  const moves = [];
  const controls = { touched: false, glide: (pose) => moves.push((rig.pose = pose)) };
  for (const metadata of [null, { view: { ...LEVEL, from: 'author' } }]) {
    const view = new CameraList(rig, controls, { up: null, axes: null });
    const header = { axes: '', tiles: [{ min: [-1, 4, -1], max: [1, 6, 1], splatCount: 9 }] };
    view.read(header, { metadata, cameras: null });
    const corners = { samples: Float32Array.of(-1, 4, -1, 1, 6, 1), weights: Float32Array.of(9, 9) };
    assert.ok(view.place(corners));
    const first = rig.camera(80, 60);
    assert.ok(!view.place(corners));
    const wall = Float32Array.from({ length: 3000 }, (_, i) => (i % 3 === 1 ? 4.5 : Math.sin(i)));
    assert.ok(!view.place({ samples: wall, weights: new Float32Array(1000).fill(0.01) }));
    assert.deepEqual(rig.camera(80, 60), first);
    assert.equal(rig.home, rig.pose);
  }
  assert.equal(moves.length, 2);
  assert.equal(rig.pose.distance, 4.5); // the pivot lies on the surface
});

test('azimuths count from the view that a scene is loaded with, or that a turn of the scene gives', () => {
  const rig = new OrbitCamera(emptyPose(), 1);
  const controls = { touched: false, glide: (pose) => (rig.pose = pose) };
  const view = new CameraList(rig, controls, { up: null, axes: null });
  view.read({ axes: '', tiles: [] }, { metadata: { view: LEVEL }, cameras: null });
  view.place({ samples: new Float32Array(0), weights: new Float32Array(0) });
  const front = rig.home;
  assert.equal(rig.front, front);
  view.useCameras([{ ...LEVEL, viewmat: [[-1, 0, 0, 0], [0, 0, -1, 0], [0, -1, 0, 0], [0, 0, 0, 1]] }], 0); // prettier-ignore
  view.showFirst();
  assert.equal(rig.front, front);
  assert.notEqual(rig.home, front);
  view.turnUpright();
  assert.equal(rig.front, rig.home);
});
