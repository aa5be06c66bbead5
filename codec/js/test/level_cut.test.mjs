// SPDX-License-Identifier: Apache-2.0
// Cuts of a scene of which only a part has arrived, and within a budget.
import assert from 'node:assert/strict';
import { test } from 'node:test';

import { viewOf } from '../../../tools/viewer/camera_maths.mjs';
import { chooseTiles, chooseWishes, looksOf } from '../levels/level_cut.mjs';

/** Two leaves of two tiles and one of one tile; a parent of the first two; a root. Tiles 0 to 4 are of level 0. */
const node = (index, level, parent, children, firstTile, tileCount, error, splatCount, min, max) => ({
  ...{ index, level, parent, children, firstTile, tileCount, error, splatCount, min, max },
});
const NODES = [
  node(0, 0, 3, [], 0, 2, 0, 1000, [-10, -1, -1], [-5, 1, 1]),
  node(1, 0, 3, [], 2, 2, 0, 1000, [-5, -1, -1], [0, 1, 1]),
  node(2, 0, 4, [], 4, 1, 0, 1000, [0, -1, -1], [10, 1, 1]),
  node(3, 1, 4, [0, 1], 5, 1, 0.1, 500, [-10, -1, -1], [0, 1, 1]),
  node(4, 2, null, [2, 3], 6, 1, 0.2, 100, [-10, -1, -1], [10, 1, 1]),
];
const cut = (...here) => {
  const { tiles, isWhole } = chooseTiles(NODES, (tile) => here.includes(tile), looksOf(NODES, null), Infinity);
  return { tiles, isWhole };
};

test('a node is drawn until all of its children are here', () => {
  assert.deepEqual(cut(6), { tiles: [6], isWhole: true });
  assert.deepEqual(cut(5, 6), { tiles: [6], isWhole: true }); // leaf 2 is missing
  assert.deepEqual(cut(4, 5, 6), { tiles: [4, 5], isWhole: true });
  assert.deepEqual(cut(0, 1, 2, 4, 5, 6), { tiles: [4, 5], isWhole: true }); // one tile of leaf 1 is missing
  assert.deepEqual(cut(0, 1, 2, 3, 4, 5, 6), { tiles: [0, 1, 2, 3, 4], isWhole: true });
});

test('a node that is missing is covered by those below it', () => {
  assert.deepEqual(cut(0, 1, 2, 3, 4, 6), { tiles: [0, 1, 2, 3, 4], isWhole: true });
  assert.deepEqual(cut(0, 1, 2, 3, 4), { tiles: [0, 1, 2, 3, 4], isWhole: true });
});

test('without the root, what is here is drawn', () => {
  assert.deepEqual(cut(), { tiles: [], isWhole: false });
  assert.deepEqual(cut(0, 5), { tiles: [5], isWhole: false });
  assert.deepEqual(cut(0, 4), { tiles: [0, 4], isWhole: false });
});

/** A camera at (x, 0, -20) that looks along +z. */
const from = (x) => {
  const viewmat = [1, 0, 0, -x, 0, 1, 0, 0, 0, 0, 1, 20, 0, 0, 0, 1];
  return viewOf({ viewmat, fx: 100, fy: 100, cx: 50, cy: 50 }, 100, 100);
};
const within = (budget, view) => chooseTiles(NODES, () => true, looksOf(NODES, view), budget).tiles;

test('over the budget, nodes of small errors in pixels stay', () => {
  assert.deepEqual(within(3000, from(0)), [0, 1, 2, 3, 4]);
  assert.deepEqual(within(2999, from(0)), [4, 5]); // the error of node 3 is smaller than that of the root
  assert.deepEqual(within(1499, from(0)), [6]);
  assert.deepEqual(within(10, from(0)), [6]); // there is nothing coarser
});

test('what is out of view is coarse', () => {
  const away = from(0);
  away.viewmat = [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, -50, 0, 0, 0, 1]; // behind the camera
  assert.deepEqual(within(1499, away), [6]);
  assert.deepEqual(within(2999, away), [4, 5]); // as far as it fits
  assert.deepEqual(within(3000, away), [0, 1, 2, 3, 4]); // all of it fits
  assert.deepEqual(within(2000, from(20)), [4, 5]); // only leaf 2 is in view, at the left
});

test('a small movement does not exchange what is drawn', () => {
  const choose = (view, refined) => chooseTiles(NODES, () => true, looksOf(NODES, view), 2500, refined);
  const near = choose(from(-4));
  assert.deepEqual([...near.refined], [4]);
  assert.deepEqual(choose(from(-4), near.refined).tiles, near.tiles);
});

const wishes = (view, aims) =>
  chooseWishes(NODES, looksOf(NODES, view), { budget: Infinity, pixels: 0, around: false, ...aims });
const numbers = (some) => some.map(({ node: { index } }) => index);

test('the roots are requested first, then children of the largest errors', () => {
  assert.deepEqual(numbers(wishes(null, { pixels: Infinity })), [4]); // without a camera
  const all = wishes(from(0));
  assert.deepEqual(numbers(all).slice(0, 3).sort(), [2, 3, 4]);
  assert.equal(numbers(all)[0], 4);
  assert.deepEqual(numbers(all).slice(3).sort(), [0, 1]);
  assert.deepEqual(numbers(all.filter(({ isDrawn }) => isDrawn)).sort(), [0, 1, 2]);
  assert.ok(all.every(({ isNeeded }) => isNeeded));
});

test('errors that are small enough are not refined', () => {
  assert.deepEqual(numbers(wishes(from(0), { pixels: 5 })), [4]);
  const pixels = (100 * 0.1) / 19; // of node 3
  assert.deepEqual(numbers(wishes(from(0), { pixels })).sort(), [2, 3, 4]);
});

test('what exceeds the budget is not requested', () => {
  assert.deepEqual(numbers(wishes(from(0), { budget: 2999 })).sort(), [2, 3, 4]);
  assert.deepEqual(numbers(wishes(from(0), { budget: 1499 })), [4]);
});

test('what is out of view comes last, or not at all', () => {
  assert.deepEqual(numbers(wishes(from(20))).sort(), [2, 3, 4]); // leaf 2 alone is in view
  const around = numbers(wishes(from(20), { around: true }));
  assert.equal(around[0], 4);
  assert.equal(around[1], 2);
  assert.deepEqual([...around].sort(), [0, 1, 2, 3, 4]);
});
