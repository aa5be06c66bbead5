// SPDX-License-Identifier: Apache-2.0
// The point of a scene under the pointer.
import assert from 'node:assert/strict';
import { test } from 'node:test';

import { pick } from '../pick.mjs';

/** Reproducible random numbers between 0 and 1 (a linear congruential generator). */
function numbers(seed = 1) {
  let state = seed;
  return () => (state = (1664525 * state + 1013904223) % 2 ** 32) / 2 ** 32;
}

function scene(points, weight = 1e-3) {
  return { samples: Float32Array.from(points.flat()), weights: new Float32Array(points.length).fill(weight) };
}

test('the nearest surface is picked, not the background or floaters', () => {
  const next = numbers(9);
  const wall = (z) => Array.from({ length: 4000 }, () => [4 * next() - 2, 4 * next() - 2, z]);
  const samples = scene([...wall(1), ...wall(6), [0, 0, -3.5]], 0.01);
  const camera = {
    viewmat: [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 4, 0, 0, 0, 1],
    fx: 500,
    fy: 500,
    cx: 320,
    cy: 240,
    near: 0.2,
  };
  const point = pick(samples, camera, 420, 240);
  assert.ok(Math.abs(point[2] - 1) < 0.01 && Math.abs(point[0] - 1) < 0.05, `${point}`);
  assert.equal(pick(scene([[0, 0, -10]]), camera, 320, 240), null);
});
