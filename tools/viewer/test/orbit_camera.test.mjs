// SPDX-License-Identifier: Apache-2.0
// The interactive camera: the position of the pivot in the picture before and after each movement.
import assert from 'node:assert/strict';
import { test } from 'node:test';

import { OrbitCamera, between, defaultLens, pivotOf } from '../orbit_camera.mjs';
import { cross, dot, length, lookAlong, slerp, sub, toBasis, toQuat, turnBasis } from '../vectors.mjs';

const WIDTH = 800;
const HEIGHT = 600;

/** A camera three units in front of the origin, its pivot, looking along +z, y down. */
function rig(changes = {}) {
  const pose = {
    basis: lookAlong([0, 0, 1], [0, -1, 0]),
    eye: [0, 0, -3],
    distance: 3,
    up: [0, -1, 0],
    lens: defaultLens(),
    near: 0.2,
    ...changes,
  };
  return new OrbitCamera(pose, 1);
}

/** The position of a point in the picture, in pixels, and its depth. */
function project(some, [x, y, z], width = WIDTH, height = HEIGHT) {
  const { viewmat: m, fx, fy, cx, cy } = some.camera(width, height);
  const [a, b, c] = [0, 4, 8].map((row) => m[row] * x + m[row + 1] * y + m[row + 2] * z + m[row + 3]);
  return { x: (fx * a) / c + cx, y: (fy * b) / c + cy, z: c };
}

function close(actual, expected, tolerance = 1e-9) {
  const differs = [...actual].some((value, i) => Math.abs(value - expected[i]) > tolerance);
  assert.ok(!differs, `${[...actual]} instead of ${[...expected]}`);
}

function proper([right, down, forward]) {
  for (const axis of [right, down, forward]) close([length(axis)], [1]);
  close(cross(right, down), forward);
}

test('a camera that looks along +z with -y up has the axes of the world', () => {
  close(rig().camera(WIDTH, HEIGHT).viewmat, [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 3, 0, 0, 0, 1]);
});

test('looking straight up gives a valid basis', () => {
  proper(lookAlong([0, -1, 0], [0, -1, 0]));
});

test('orbiting keeps the pivot centred and at its distance', () => {
  const some = rig();
  some.orbit(0.7, -0.4);
  const { x, y, z } = project(some, [0, 0, 0]);
  close([x, y, z], [WIDTH / 2, HEIGHT / 2, 3]);
  proper(some.pose.basis);
});

test('points that face the camera follow the pointer', () => {
  const right = rig();
  right.orbit(0.3, 0);
  assert.ok(project(right, [0, 0, -0.5]).x > WIDTH / 2);
  const down = rig();
  down.orbit(0, 0.3);
  assert.ok(project(down, [0, 0, -0.5]).y > HEIGHT / 2);
  assert.ok(down.pose.eye[1] < 0, 'the camera rises');
});

test('orbiting stops before the poles and can turn back', () => {
  const some = rig();
  for (let i = 0; i < 100; i++) some.orbit(0, 0.3);
  assert.ok(dot(some.pose.basis[2], some.pose.up) > -1);
  proper(some.pose.basis);
  some.orbit(0, -Math.PI / 2);
  assert.ok(Math.abs(dot(some.pose.basis[2], some.pose.up)) < 0.05);
});

test('a full turn returns to the start', () => {
  const some = rig();
  for (let i = 0; i < 360; i++) some.orbit((2 * Math.PI) / 360, 0);
  close(some.pose.eye, [0, 0, -3]);
});

test('panning moves the pivot as far as the pointer', () => {
  const some = rig();
  some.pan(40, -25, WIDTH, HEIGHT);
  const { x, y } = project(some, [0, 0, 0]);
  close([x, y], [WIDTH / 2 + 40, HEIGHT / 2 - 25]);
});

test('zooming keeps the point under the pointer in place', () => {
  const some = rig();
  const point = [0.4, -0.3, 0]; // at the distance of the pivot
  const before = project(some, point);
  some.zoom(0.5, { x: before.x, y: before.y, width: WIDTH, height: HEIGHT });
  const after = project(some, point);
  close([after.x, after.y, after.z], [before.x, before.y, 1.5]);
});

test('zooming has limits that depend on the extent', () => {
  const some = rig();
  for (let i = 0; i < 200; i++) some.zoom(0.5);
  assert.ok(some.pose.distance > 0);
  assert.ok(some.camera(WIDTH, HEIGHT).near < some.pose.distance);
  for (let i = 0; i < 200; i++) some.zoom(2);
  assert.equal(some.pose.distance, 60);
});

test('flying moves the pivot along', () => {
  const some = rig();
  some.fly([1, 0.5, 2]);
  close(some.pose.eye, [1, 0.5, -1]);
  close(some.pivot, [1, 0.5, 2]);
});

test('looking around keeps the position', () => {
  const some = rig();
  some.look(0.2, 0.1);
  close(some.pose.eye, [0, 0, -3]);
  assert.ok(some.pose.basis[2][0] > 0 && some.pose.basis[2][1] > 0);
});

test('turning towards a point centres it', () => {
  const some = rig();
  some.pose = some.towards([0.5, 0.2, 1]);
  const { x, y, z } = project(some, [0.5, 0.2, 1]);
  close([x, y, z], [WIDTH / 2, HEIGHT / 2, some.pose.distance]);
});

test('a lens of a file is fitted to the canvas', () => {
  const lens = { fx: 500, fy: 510, cx: 310, cy: 245, W: 640, H: 480 };
  const { fx, fy, cx, cy } = rig({ lens }).camera(640, 480);
  close([fx, fy, cx, cy], [500, 510, 310, 245]);
  const wide = rig({ lens }).camera(2000, 960);
  close([wide.fx, wide.fy, wide.cx, wide.cy], [1000, 1020, 620 + 360, 490]);
  const tall = rig({ lens }).camera(320, 700);
  close([tall.fx, tall.fy, tall.cx, tall.cy], [250, 255, 155, 122.5 + 230]);
});

test('the matrix of a file is used unchanged until the camera moves', () => {
  const viewmat = [1, 0, 0, 1e-17, 0, 1, 0, 0, 0, 0, 1, 3, 0, 0, 0, 1];
  const some = rig({ viewmat });
  assert.equal(some.camera(WIDTH, HEIGHT).viewmat, viewmat);
  some.orbit(0, 0);
  assert.notEqual(some.camera(WIDTH, HEIGHT).viewmat, viewmat);
});

test('the near plane is in front of the pivot', () => {
  assert.equal(rig().camera(WIDTH, HEIGHT).near, 0.2);
  assert.equal(rig({ distance: 0.5 }).camera(WIDTH, HEIGHT).near, 0.05);
});

for (const up of [
  [0, 1, 0],
  [0, 0, 1],
  [1, 0, 0],
]) {
  test(`turning ${up} up keeps the pivot centred`, () => {
    const some = rig();
    some.orbit(0.3, 0.2);
    some.pose = some.turnedUp(up);
    proper(some.pose.basis);
    const { x, y, z } = project(some, [0, 0, 0]);
    close([x, y, z], [WIDTH / 2, HEIGHT / 2, 3]);
    assert.ok(dot(some.pose.basis[1], up) < 0, 'up is not down');
  });
}

test('a camera moves around the pivot', () => {
  const from = rig().pose;
  const other = rig();
  other.orbit(Math.PI / 2, 0);
  const half = between(from, other.pose, 0.5);
  close([length(half.eye)], [3]);
  close(pivotOf(half), [0, 0, 0]);
  assert.equal(between(from, other.pose, 1), other.pose);
});

test('rotations are unchanged by conversion to quaternions', () => {
  let basis = lookAlong([0, 0, 1], [0, -1, 0]);
  for (let i = 0; i < 50; i++) {
    basis = turnBasis(basis, [0.6, 0, 0.8], 0.9);
    basis = turnBasis(basis, [0, 1, 0], 0.4);
    const again = toBasis(toQuat(basis));
    for (let row = 0; row < 3; row++) close(again[row], basis[row]);
    close(slerp(toQuat(basis), toQuat(basis), 0.3), toQuat(basis));
  }
});

test('the shorter rotation is taken', () => {
  const quat = toQuat(turnBasis(lookAlong([0, 0, 1], [0, -1, 0]), [0, 1, 0], 0.5));
  const half = slerp(
    quat,
    quat.map((value) => -value),
    0.5,
  );
  close([Math.abs(half.reduce((sum, value, i) => sum + value * quat[i], 0))], [1]);
  close(sub([1, 2, 3], [1, 2, 3]), [0, 0, 0]);
});

test('limits hold for the distance to the pivot and for the angle from above', () => {
  const some = rig();
  some.limits = { kind: 'orbit', distance: [2, 5], polar: [Math.PI / 3, Math.PI / 2], azimuth: [-Math.PI, Math.PI] };
  const polar = () => Math.acos(-dot(some.pose.basis[2], some.pose.up));
  for (const [down, angle] of [
    [9, Math.PI / 3],
    [-9, Math.PI / 2],
  ]) {
    some.orbit(0.1, down);
    close([polar()], [angle]);
  }
  for (const [factor, distance] of [
    [0.01, 2],
    [100, 5],
  ]) {
    some.zoom(factor);
    close([some.pose.distance], [distance]);
  }
  close(pivotOf(some.pose), [0, 0, 0]);
  const { pose } = rig();
  close([some.limited({ ...pose, distance: 9, eye: [0, 0, -9] }).distance], [5]);
  assert.deepEqual(pivotOf(some.limited(pose)), [0, 0, 0]);
});

/** The angle around the up direction from the first view to the current one, above 0 to the right, in degrees. */
function azimuth({ pose, front: { eye } }) {
  const [x, y] = [dot(pose.eye, cross(pose.up, eye)), dot(pose.eye, eye) - dot(pose.eye, pose.up) * dot(eye, pose.up)];
  return (180 / Math.PI) * Math.atan2(x, y);
}

/** A rig whose first view looks at the origin along a direction, and the limits of its azimuth, in degrees. */
function facing(direction, up, [least, most]) {
  const basis = lookAlong(direction, up);
  const some = rig({ basis, up, eye: basis[2].map((value) => -3 * value) });
  some.limits = { ...some.limits, azimuth: [(least * Math.PI) / 180, (most * Math.PI) / 180] };
  return some;
}

for (const [direction, up] of [
  [
    [0, 0, 1],
    [0, -1, 0],
  ],
  [
    [0.6, 0.7, -0.3],
    [0, 0, 1],
  ],
  [
    [1, 2, 3],
    [0.48, 0.6, 0.64],
  ],
]) {
  test(`limits hold for the angle around ${up} from the first view`, () => {
    const some = facing(direction, up, [-40, 25]);
    const drags = [[-0.2, 11.4592], [-0.2, 22.9183], [-0.2, 25], [-9, 25], [0.1, 19.2704], [99, -40], [0, -40]]; // prettier-ignore
    for (const [right, angle] of drags) {
      some.orbit(right, 0.1);
      close([azimuth(some)], [angle], 1e-4);
    }
    some.zoom(0.5, { x: 0, y: 0, width: WIDTH, height: HEIGHT });
    some.orbit(0, 0);
    some.pose = some.front;
    some.orbit(0, 0);
    close(some.pose.eye, some.front.eye);
  });
}

test('one limit of the azimuth leaves the other side free to the back', () => {
  const some = facing([0, 0, 1], [0, -1, 0], [-180, 90]);
  some.orbit(6, 0);
  close([Math.abs(azimuth(some))], [180]);
  some.orbit(-0.1, 0);
  close([azimuth(some)], [-180 + 18 / Math.PI]);
});

test('a camera beyond the limits of the azimuth comes to the nearer one when it moves', () => {
  const some = facing([0, 0, 1], [0, -1, 0], [-120, 30]);
  for (const [direction, angle] of [[[-1, 0, 0.5], 30], [[-0.1, 0, -1], -120], [[-1, 0, -0.8], 30]]) {
    some.pose = facing(direction, [0, -1, 0], [0, 0]).pose;
    some.orbit(0, 0);
    close([azimuth(some)], [angle]);
  } // prettier-ignore
});

test('limits of the azimuth hold if the first view is rolled, or looks straight down', () => {
  const rolled = facing([0.2, 0.1, 1], [0, -1, 0], [-30, 30]);
  rolled.front = rolled.pose = { ...rolled.pose, basis: turnBasis(rolled.pose.basis, rolled.pose.basis[2], 1.2) };
  for (const [right, down] of [[0.3, 0.2], [2, -1], [-5, 0.7], [0, 0.9]]) {
    rolled.orbit(right, down);
    assert.ok(Math.abs(azimuth(rolled)) < 30 + 1e-6, `${azimuth(rolled)}`);
  } // prettier-ignore
  const above = facing([0, 1, 0], [0, -1, 0], [-30, 30]);
  const [before] = above.pose.basis;
  for (const down of [-0.5, 0.2]) above.orbit(9, down);
  close([dot(above.pose.basis[0], before)], [Math.cos(Math.PI / 6)]);
});
