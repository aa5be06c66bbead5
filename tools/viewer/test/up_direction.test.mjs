// SPDX-License-Identifier: Apache-2.0
// Up directions of scenes that do not specify theirs.
import assert from 'node:assert/strict';
import { test } from 'node:test';

import { upOfCameras, waysUp } from '../up_direction.mjs';
import { lookAlong } from '../vectors.mjs';

const UP = [0, -1, 0];

test('six up directions are offered, each once, the current one first', () => {
  for (const first of [UP, [0, 0, 1]]) {
    const ways = waysUp(first);
    assert.equal(ways.length, 6);
    assert.deepEqual(ways[0], first);
    assert.equal(new Set(ways.map(String)).size, 6);
  }
});

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
