// SPDX-License-Identifier: Apache-2.0
// What is drawn covers the scene once, whatever arrives, is evicted or comes into view, and while versions are exchanged.
import assert from 'node:assert/strict';
import { test } from 'node:test';

import { random } from '../../../tools/viewer/test/random.mjs';
import { looksOf, tilesOf } from '../levels/level_cut.mjs';
import { FADE_STEPS, STEP_MS, ShownTiles, fadedAlpha } from '../levels/shown_tiles.mjs';

/** Return a random tree over cells on a line, children before parents, each node with one to three tiles. */
function forest(draw) {
  const nodes = [];
  const add = (level, children, min, max, error) => {
    const index = nodes.length;
    const firstTile = index === 0 ? 0 : nodes[index - 1].firstTile + nodes[index - 1].tileCount;
    const tileCount = 1 + Math.floor(3 * draw());
    const splatCount = tileCount * (level === 0 ? 1000 : 200 + Math.floor(400 * draw()));
    for (const child of children) nodes[child].parent = index;
    nodes.push({ index, level, parent: null, children, firstTile, tileCount, splatCount, error, min, max });
    return index;
  };
  let row = Array.from({ length: 4 + Math.floor(20 * draw()) }, (_, x) => add(0, [], [x, -1, -1], [x + 1, 1, 1], 0));
  for (let level = 1; level < 5 && row.length > 1; level++) {
    const next = [];
    while (row.length > 0) {
      const children = row.splice(0, 1 + Math.floor(4 * draw()));
      const [a, b] = [nodes[children[0]], nodes[children.at(-1)]];
      next.push(add(level, children, a.min, b.max, 0.05 * 2 ** level));
    }
    row = next;
  }
  const all = nodes.flatMap(({ splatCount, tileCount }) =>
    new Array(tileCount).fill({ splatCount: splatCount / tileCount }),
  );
  return { nodes, all };
}

/** A camera somewhere that looks along z, or back. */
function camera(draw) {
  const [x, z, sign] = [24 * draw(), -40 * draw() ** 3, draw() < 0.8 ? 1 : -1];
  const viewmat = [sign, 0, 0, -sign * x, 0, 1, 0, 0, 0, 0, sign, -sign * z, 0, 0, 0, 1];
  return { viewmat, fx: 300, fy: 300, cx: 100, cy: 100, near: 0.01, width: 200, height: 200 };
}

test('every leaf is drawn once, within the budget, on random paths with random arrivals and evictions', () => {
  let fades = 0;
  for (let seed = 0; seed < 150; seed++) {
    const draw = random(seed);
    const { nodes, all } = forest(draw);
    const roots = nodes.filter(({ parent }) => parent === null);
    const least = roots.reduce((sum, { splatCount }) => sum + splatCount, 0);
    const most = all.reduce((sum, { splatCount }) => sum + splatCount, 0);
    const budget = least + draw() * (most - least);
    const here = new Set(roots.flatMap(({ firstTile, tileCount }) => tilesOf(firstTile, tileCount)));
    const fixed = new Set(here);
    const stream = { nodes, all, budget, hasLevels: true, looks: looksOf(nodes, camera(draw)) };
    const shown = new ShownTiles(stream);
    let seenThen = stream.looks.isSeen;
    for (let step = 0, now = 0; step < 60; step++, now += 2 * STEP_MS * draw()) {
      if (draw() < 0.3) stream.looks = looksOf(nodes, camera(draw));
      for (let count = Math.floor(6 * draw()); count > 0; count--) here.add(Math.floor(all.length * draw()));
      if (draw() < 0.1) for (const tile of here) if (!fixed.has(tile) && draw() < 0.3) here.delete(tile);
      const { refined: was } = shown;
      shown.update((tile) => here.has(tile), now, draw() < 0.5 ? -1 : 1);
      if (shown.refined !== was) seenThen = stream.looks.isSeen;
      fades += Number(shown.isFading);
      assert.ok([...shown.shares.keys()].every((tile) => here.has(tile)));
      assert.ok(shown.splatCount <= budget, `seed ${seed}: ${shown.splatCount} of ${budget}`);
      const sharesOf = ({ firstTile, tileCount }) => {
        const shares = new Set(tilesOf(firstTile, tileCount).map((tile) => shown.shares.get(tile) ?? 0));
        return shares.size === 1 ? [...shares][0] : NaN; // a node is drawn whole
      };
      for (const leaf of nodes.filter(({ level }) => level === 0)) {
        let [versions, sum] = [0, 0];
        for (let node = leaf; node; node = nodes[node.parent]) {
          const shares = sharesOf(node);
          assert.ok(shares >= 0);
          versions += Number(shares > 0);
          sum += shares;
        }
        assert.ok(versions >= 1, `seed ${seed}: a hole`);
        if (!shown.isFading) assert.deepEqual([versions, sum], [1, FADE_STEPS]);
        else if (seenThen[leaf.index]) assert.equal(sum, FADE_STEPS);
      }
    }
  }
  assert.ok(fades > 500, `${fades} steps of fades`);
});

test('versions that are exchanged are together about as opaque as each alone, averaged over their area', () => {
  for (const alpha of [0.01, 0.5, 0.9, 1]) {
    assert.equal(fadedAlpha(alpha, FADE_STEPS), alpha);
    for (let shares = 0; shares <= FADE_STEPS; shares++) {
      const [a, b] = [fadedAlpha(alpha, shares), fadedAlpha(alpha, FADE_STEPS - shares)];
      // The mean of g over the area is in proportion to 1, that of g² to 1/2.
      assert.ok(Math.abs(a + b - (a * b) / 2 - alpha) < 0.02 * alpha, `${alpha} ${shares}`);
    }
  }
});

test('a fade takes its time, however often it is asked for, and leaves out steps that are late', () => {
  const node = { level: 0, children: [], tileCount: 1, splatCount: 10, error: 0, min: [0, 0, 0], max: [1, 1, 1] };
  const nodes = [
    { ...node, index: 0, parent: 1, firstTile: 0 },
    { ...node, index: 1, parent: null, children: [0], firstTile: 1, level: 1, error: 1 },
  ];
  for (const [budget, expected] of [
    [
      20,
      [
        [
          [0, 1],
          [1, 7],
        ],
        [
          [0, 1],
          [1, 7],
        ],
        [
          [0, 2],
          [1, 6],
        ],
        [
          [0, 7],
          [1, 1],
        ],
        [[0, 8]],
      ],
    ],
    [19, new Array(5).fill([[0, 8]])], // no room for both
  ]) {
    const all = nodes.map(({ splatCount }) => ({ splatCount }));
    const shown = new ShownTiles({ nodes, all, budget, hasLevels: true, looks: looksOf(nodes, null) });
    shown.update((tile) => tile === 1, 0);
    assert.deepEqual([...shown.shares], [[1, FADE_STEPS]]); // the first picture does not fade in
    const times = [0, 0.4 * STEP_MS, STEP_MS, 6 * STEP_MS, 20 * STEP_MS];
    const steps = times.map((now) => (shown.update(() => true, now), [...shown.shares].sort()));
    assert.deepEqual(steps, expected);
    assert.ok(!shown.isFading);
  }
});
