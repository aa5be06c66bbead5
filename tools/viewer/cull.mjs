// SPDX-License-Identifier: Apache-2.0
// Frustum culling: whole tiles first, then splats. Conservative compared with the shaders: no visible splat is lost.

import { slopeLimits } from '../../codec/js/levels/level_cut.mjs';
import { ALPHA_MIN, DILATION, REACH_MAX } from './camera_maths.mjs';

/**
 * @typedef {import('./types.d.ts').View} View
 *
 * Data of a tile for culling.
 *
 * @typedef {object} CullTile
 * @property {number} index of the tile
 * @property {number} count splats
 * @property {number} slot slot of the first splat
 * @property {Uint8Array | Uint16Array | Uint32Array | Float64Array} means [3 × count] integers, column after column
 * @property {number[]} corner offsets added to them
 * @property {number} step scene units
 * @property {number[]} extent largest integer per axis
 * @property {number} reach distance from the centre beyond which no splat of the tile is visible, scene units
 * @property {Uint8Array} reaches [count], the same per splat, see reachClass
 *
 * @typedef {{depths: Float32Array, slots: Uint32Array, count: number}} Visible depths and slots of the splats in view
 */

/** Reaches are quantised to an eighth of an octave, rounded up: 2^−15 … 2^16; larger ones are infinite. */
const CLASS_STEPS = 8;
const CLASS_ZERO = 121;
const CLASS_MAX = 255;

/** Distance by class; class 0 is never visible. */
const CLASS_REACH = Float64Array.from({ length: 256 }, (_, c) =>
  c === CLASS_MAX ? Infinity : c === 0 ? 0 : 2 ** ((c - CLASS_ZERO) / CLASS_STEPS),
);

/** Maximum number of pixels that the dilation adds to a splat's reach, plus one for rounding. */
const PAD = REACH_MAX * Math.sqrt(DILATION) + 1;

/**
 * Return the class of a splat's reach, rounded up.
 *
 * @param {number} alpha
 * @param {number} logScale natural logarithm of its largest standard deviation
 */
export function reachClass(alpha, logScale) {
  if (!(alpha >= ALPHA_MIN)) return 0;
  const sigmas = Math.sqrt(2 * Math.log(alpha / ALPHA_MIN)) + 1e-3;
  const octaves = logScale * Math.LOG2E + Math.log2(sigmas);
  return Math.min(CLASS_MAX, Math.max(1, Math.ceil(octaves * CLASS_STEPS) + CLASS_ZERO));
}

/**
 * Return the sides of the view frustum as linear functions of the world. A splat of reach r is out of view if one of them
 * is below −r × slack.
 *
 * @param {View} view
 * @returns {{planes: number[][], slack: number[]}} planes [4][4], each x, y, z and constant
 */
function sides(view) {
  const { viewmat: m, fx, fy, cx, cy, width, height } = view;
  const [x0, x1, y0, y1] = slopeLimits(view);
  const plane = (/** @type {number} */ row, /** @type {number} */ sign, /** @type {number} */ slope) =>
    [0, 1, 2, 3].map((k) => sign * (m[4 * row + k] - slope * m[8 + k]));
  // The half-width of a projected ellipse is at most fx / z × reach × √(1 + (x/z)²), x/z within the limits.
  const slackX = Math.sqrt(1 + Math.max(x0 * x0, x1 * x1));
  const slackY = Math.sqrt(1 + Math.max(y0 * y0, y1 * y1));
  return {
    planes: [
      plane(0, 1, (-cx - PAD) / fx),
      plane(0, -1, (width - cx + PAD) / fx),
      plane(1, 1, (-cy - PAD) / fy),
      plane(1, -1, (height - cy + PAD) / fy),
    ],
    slack: [slackX, slackX, slackY, slackY],
  };
}

/**
 * Return the minimum and maximum of a linear function over a tile's box.
 *
 * @param {number[]} plane
 * @param {CullTile} tile
 * @returns {[number, number]}
 */
function overBox(plane, { corner, extent, step }) {
  let low = plane[3];
  let high = plane[3];
  for (let axis = 0; axis < 3; axis++) {
    const one = plane[axis] * corner[axis] * step;
    const other = plane[axis] * (corner[axis] + extent[axis]) * step;
    low += Math.min(one, other);
    high += Math.max(one, other);
  }
  return [low, high];
}

/**
 * Collect depths and slots of the splats that a camera may see, in the order of the tiles.
 *
 * @param {CullTile[]} tiles
 * @param {View} view
 * @param {Visible} out arrays with room for all tiles; `count` is set
 */
export function cull(tiles, view, out) {
  const { viewmat: m, near } = view;
  const { planes, slack } = sides(view);
  const forward = [m[8], m[9], m[10], m[11]];
  let count = 0;
  for (const tile of tiles) {
    if (!(overBox(forward, tile)[1] > near)) continue;
    let isInside = true;
    let isOutside = false;
    for (let k = 0; k < 4; k++) {
      const [low, high] = overBox(planes[k], tile);
      if (high <= -tile.reach * slack[k]) isOutside = true;
      if (low <= 0) isInside = false;
    }
    if (isOutside) continue;
    count = isInside
      ? takeAll(tile, forward, near, out, count)
      : takeSome(tile, planes, slack, forward, near, out, count);
  }
  out.count = count;
}

/**
 * Convert a linear function of the world to one of a tile's integers.
 *
 * @param {number[]} plane
 * @param {CullTile} tile
 */
function onIntegers(plane, { corner, step }) {
  const constant = plane[3] + step * (plane[0] * corner[0] + plane[1] * corner[1] + plane[2] * corner[2]);
  return [plane[0] * step, plane[1] * step, plane[2] * step, constant];
}

/**
 * Add the splats of a tile inside all sides; only the near plane matters.
 *
 * @param {CullTile} tile
 * @param {number[]} forward
 * @param {number} near
 * @param {Visible} out
 * @param {number} at
 * @returns {number} the next position in `out`
 */
function takeAll(tile, forward, near, { depths, slots }, at) {
  const { count: n, means, reaches, slot } = tile;
  const [a, b, c, d] = onIntegers(forward, tile);
  for (let i = 0; i < n; i++) {
    const z = a * means[i] + b * means[n + i] + c * means[2 * n + i] + d;
    if (z > near && reaches[i] !== 0) {
      depths[at] = z;
      slots[at++] = slot + i;
    }
  }
  return at;
}

/**
 * Add the visible splats of a tile that intersects a side.
 *
 * @param {CullTile} tile
 * @param {number[][]} planes
 * @param {number[]} slack
 * @param {number[]} forward
 * @param {number} near
 * @param {Visible} out
 * @param {number} at
 * @returns {number} the next position in `out`
 */
function takeSome(tile, planes, slack, forward, near, { depths, slots }, at) {
  const { count: n, means, reaches, slot } = tile;
  const [a, b, c, d] = onIntegers(forward, tile);
  const [left, right, top, bottom] = planes.map((plane) => onIntegers(plane, tile));
  const [slackX, , slackY] = slack;
  for (let i = 0; i < n; i++) {
    const x = means[i],
      y = means[n + i],
      z = means[2 * n + i];
    const depth = a * x + b * y + c * z + d;
    if (!(depth > near) || reaches[i] === 0) continue;
    const reach = CLASS_REACH[reaches[i]];
    const reachX = -reach * slackX,
      reachY = -reach * slackY;
    if (left[0] * x + left[1] * y + left[2] * z + left[3] < reachX) continue;
    if (right[0] * x + right[1] * y + right[2] * z + right[3] < reachX) continue;
    if (top[0] * x + top[1] * y + top[2] * z + top[3] < reachY) continue;
    if (bottom[0] * x + bottom[1] * y + bottom[2] * z + bottom[3] < reachY) continue;
    depths[at] = depth;
    slots[at++] = slot + i;
  }
  return at;
}
