// SPDX-License-Identifier: Apache-2.0
// Ranges of memory that are taken and given back.
import assert from 'node:assert/strict';
import { test } from 'node:test';

import { Ranges } from '../levels/ranges.mjs';
import { random } from '../../../tools/viewer/test/random.mjs';

test('ranges never overlap, never cross pages, and leave nothing behind', () => {
  const sizes = [100, 40, 100];
  const ranges = new Ranges(sizes);
  const next = random(7);
  const taken = new Map();
  const owners = new Array(240).fill(null);
  for (let step = 0; step < 3000; step++) {
    if (next() < 0.55) {
      const size = 1 + Math.floor(30 * next());
      const start = ranges.take(size);
      if (start === null) continue;
      for (const bound of [100, 140]) assert.ok(start >= bound || start + size <= bound);
      for (let i = start; i < start + size; i++) {
        assert.equal(owners[i], null);
        owners[i] = step;
      }
      taken.set(step, { start, size });
    } else if (taken.size > 0) {
      const key = [...taken.keys()][Math.floor(taken.size * next())];
      const { start, size } = taken.get(key);
      ranges.give(start, size);
      owners.fill(null, start, start + size);
      taken.delete(key);
    }
  }
  for (const { start, size } of taken.values()) ranges.give(start, size);
  assert.deepEqual(
    ranges.free.map(({ size }) => size),
    sizes,
  );
});

test('without pages there is always room', () => {
  const ranges = new Ranges();
  assert.equal(ranges.take(10), 0);
  assert.equal(ranges.take(0), 0);
  assert.equal(ranges.take(5), 10);
  ranges.give(0, 10);
  assert.equal(ranges.take(12), 15);
  assert.equal(ranges.take(7), 0);
  assert.equal(ranges.end, 27);
});
