// SPDX-License-Identifier: Apache-2.0
// Depth sort against a plain sort.
import assert from 'node:assert/strict';
import { test } from 'node:test';

import { DepthSorter } from '../sort.mjs';
import { random } from './random.mjs';

/** The sorted depths and slots. */
function sorted(depths, sorter = new DepthSorter()) {
  const slots = Uint32Array.from(depths, (_, i) => 7 * i + 3);
  const out = new Uint32Array(depths.length);
  sorter.sort(depths, slots, depths.length, out);
  return [...out].map((slot) => (slot - 3) / 7);
}

/** Farthest first; of equal depths, the later slot first. */
const plain = (depths) => [...depths.keys()].sort((a, b) => depths[b] - depths[a] || b - a);

test('a few distinct depths have exactly the order of a plain sort, equal ones in reverse', () => {
  const next = random(1);
  const depths = Float32Array.from({ length: 5000 }, () => 0.25 + Math.floor(next() * 300) / 256);
  assert.deepEqual(sorted(depths), plain(depths));
});

for (const [name, low, high] of [
  ['a room', 0.2, 30],
  ['a landscape', 0.2, 1e5],
  ['all that float32 has', 1e-30, 1e30],
  ['a wall', 5, 5.0001],
]) {
  test(`${name}: neighbours are out of order by at most one key`, () => {
    const next = random(2);
    const depths = Float32Array.from({ length: 20_000 }, () => low * (high / low) ** next());
    const order = sorted(depths);
    assert.deepEqual(
      [...order].sort((a, b) => a - b),
      [...depths.keys()],
    );
    const octaves = Math.max(1, Math.log2(high / low) + 1);
    const most = 2 * octaves * 2 ** -22;
    for (let i = 1; i < order.length; i++) {
      assert.ok(depths[order[i]] <= depths[order[i - 1]] * (1 + most), `${depths[order[i - 1]]} ${depths[order[i]]}`);
    }
  });
}

test('no splat, one splat, and fewer than before', () => {
  const sorter = new DepthSorter();
  assert.deepEqual(
    sorted(
      Float32Array.from({ length: 100 }, (_, i) => 1 + i),
      sorter,
    )[0],
    99,
  );
  assert.deepEqual(sorted(new Float32Array(0), sorter), []);
  assert.deepEqual(sorted(new Float32Array([3]), sorter), [0]);
  assert.deepEqual(sorted(new Float32Array([3, Infinity, 1]), sorter), [1, 0, 2]);
});
