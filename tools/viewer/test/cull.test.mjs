// SPDX-License-Identifier: Apache-2.0
// The cull keeps all visible splats and drops most others.
import assert from 'node:assert/strict';
import { test } from 'node:test';

import { slopeLimits } from '../../../codec/js/levels/level_cut.mjs';
import { ALPHA_MIN, DILATION, toCamera, viewOf } from '../camera_maths.mjs';
import { cull, reachClass } from '../cull.mjs';
import { random } from './random.mjs';

const EXTENT = 4000;

/** A tile of random splats, and their parameters. */
function makeTile(next, slot, centre, size, count) {
  const step = size / EXTENT;
  const corner = centre.map((c) => Math.round((c - size / 2) / step));
  const means = Uint16Array.from({ length: 3 * count }, () => Math.floor(next() * (EXTENT + 1)));
  const logScales = Float64Array.from({ length: count }, () => -6 + 6 * next());
  const alphas = Float64Array.from({ length: count }, () => next() ** 3);
  const reaches = Uint8Array.from({ length: count }, (_, i) => reachClass(alphas[i], logScales[i]));
  const reach = 4 * Math.exp(Math.max(...logScales));
  const tile = { count, slot, means, corner, step, extent: [EXTENT, EXTENT, EXTENT], reach, reaches };
  const mean = (i) => [0, 1, 2].map((axis) => (corner[axis] + means[axis * count + i]) * step);
  return { tile, mean, logScales, alphas };
}

/** Whether a ball of that size could touch the picture, computed as in the rasteriser. */
function isSeen(view, mean, logScale, alpha) {
  const [x, y, z] = toCamera(view.viewmat, mean);
  if (!(z > view.near) || alpha < ALPHA_MIN) return false;
  const [x0, x1, y0, y1] = slopeLimits(view);
  const tx = Math.min(Math.max(x / z, x0), x1);
  const ty = Math.min(Math.max(y / z, y0), y1);
  const sigma = Math.exp(logScale);
  const reach = Math.sqrt(2 * Math.log(alpha / ALPHA_MIN));
  const rx = reach * Math.sqrt(((view.fx * sigma) / z) ** 2 * (1 + tx * tx) + DILATION);
  const ry = reach * Math.sqrt(((view.fy * sigma) / z) ** 2 * (1 + ty * ty) + DILATION);
  const px = (view.fx * x) / z + view.cx;
  const py = (view.fy * y) / z + view.cy;
  return px + rx > 0 && px - rx < view.width && py + ry > 0 && py - ry < view.height;
}

/** A camera at `from` with a random rotation. */
function randomView(next, from) {
  const q = [next(), next(), next(), next()].map((u) => 2 * u - 1);
  const length = Math.hypot(...q);
  const [w, x, y, z] = q.map((one) => one / length);
  const R = [
    [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
    [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
    [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
  ];
  const rows = R.map((row) => [...row, -row.reduce((sum, one, k) => sum + one * from[k], 0)]);
  const camera = {
    viewmat: [...rows.flat(), 0, 0, 0, 1],
    fx: 300 + 500 * next(),
    fy: 400,
    cx: 100 + 200 * next(),
    cy: 180,
  };
  return viewOf(camera, 400, 300);
}

test('no visible splat is lost for any camera, and most others are dropped', () => {
  const next = random(3);
  const scenes = Array.from({ length: 27 }, (_, k) =>
    makeTile(
      next,
      1000 * k,
      [k % 3, Math.floor(k / 3) % 3, Math.floor(k / 9)].map((n) => 3 * n - 3),
      3,
      200,
    ),
  );
  const out = { depths: new Float32Array(6000), slots: new Uint32Array(6000), count: 0 };
  let kept = 0;
  let seen = 0;
  let all = 0;
  for (let round = 0; round < 60; round++) {
    const view = randomView(next, [8 * next() - 4, 8 * next() - 4, 8 * next() - 4]);
    cull(
      scenes.map(({ tile }) => tile),
      view,
      out,
    );
    const slots = new Set(out.slots.subarray(0, out.count));
    assert.equal(slots.size, out.count);
    for (const { tile, mean, logScales, alphas } of scenes) {
      for (let i = 0; i < tile.count; i++) {
        const isVisible = isSeen(view, mean(i), logScales[i], alphas[i]);
        if (isVisible) assert.ok(slots.has(tile.slot + i), `splat ${i} of the tile at ${tile.slot}`);
        seen += Number(isVisible);
      }
    }
    kept += out.count;
    all += 27 * 200;
  }
  assert.ok(seen > 2000, `${seen} are seen`);
  assert.ok(kept < 1.5 * seen && kept < all / 3, `${kept} kept of ${all}, ${seen} are seen`);
});

test('depths are measured along the viewing direction', () => {
  const next = random(4);
  const { tile, mean } = makeTile(next, 64, [0, 0, 0], 2, 50);
  const view = viewOf(
    { viewmat: [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 9, 0, 0, 0, 1], fx: 99, fy: 99, cx: 50, cy: 50 },
    100,
    100,
  );
  const out = { depths: new Float32Array(50), slots: new Uint32Array(50), count: 0 };
  cull([tile], view, out);
  assert.ok(out.count > 40);
  for (let k = 0; k < out.count; k++) assert.ok(Math.abs(out.depths[k] - mean(out.slots[k] - 64)[2] - 9) < 1e-5);
});

test('depths are accurate far from the origin', () => {
  const next = random(5);
  const far = [1e6, -2e6, 3e6];
  const { tile, mean } = makeTile(next, 0, far, 2, 50);
  const view = viewOf(
    { viewmat: [1, 0, 0, -far[0], 0, 1, 0, -far[1], 0, 0, 1, 5 - far[2], 0, 0, 0, 1], fx: 99, fy: 99, cx: 50, cy: 50 },
    100,
    100,
  );
  const out = { depths: new Float32Array(50), slots: new Uint32Array(50), count: 0 };
  cull([tile], view, out);
  assert.ok(out.count > 40);
  for (let k = 0; k < out.count; k++) assert.ok(Math.abs(out.depths[k] - (mean(out.slots[k])[2] + 5 - far[2])) < 1e-6);
});

test('splats too faint to be drawn are dropped, huge ones are kept', () => {
  const one = (alpha, logScale) => ({
    count: 1,
    slot: 0,
    means: new Uint8Array([0, 0, 0]),
    corner: [500, 0, 5],
    step: 1,
    extent: [0, 0, 0],
    reach: 4 * Math.exp(logScale),
    reaches: Uint8Array.of(reachClass(alpha, logScale)),
  });
  const view = viewOf(
    { viewmat: [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1], fx: 99, fy: 99, cx: 50, cy: 50 },
    100,
    100,
  );
  const out = { depths: new Float32Array(1), slots: new Uint32Array(1), count: 0 };
  const keeps = (alpha, logScale) => (cull([one(alpha, logScale)], view, out), out.count === 1);
  assert.equal(keeps(1, -3), false); // outside the picture
  assert.equal(keeps(1, 6), true);
  assert.equal(keeps(1, 60), true);
  assert.equal(keeps(1, 88), true);
  assert.equal(keeps(0.0038, 60), false);
  assert.equal(keeps(0.004, 60), true);
});

test('classes of reaches are rounded up, by at most an eighth of an octave', () => {
  const next = random(6);
  for (let i = 0; i < 1000; i++) {
    const alpha = ALPHA_MIN + next() * (1 - ALPHA_MIN);
    const logScale = -8 + 16 * next();
    const reach = Math.exp(logScale) * (Math.sqrt(2 * Math.log(alpha / ALPHA_MIN)) + 1e-3);
    const above = 2 ** ((reachClass(alpha, logScale) - 121) / 8) / reach;
    assert.ok(above >= 1 - 1e-12 && above <= 2 ** 0.1251, `${above}`);
  }
});
