// Which tiles of a file with levels of detail are drawn: the finest that are here, within a budget of splats.

import { slopeLimits } from './camera_maths.mjs';

/**
 * @typedef {import('./types.d.ts').TreeNode} TreeNode
 * @typedef {import('./types.d.ts').View} View
 * @typedef {{tiles: number[], isWhole: boolean}} Cut isWhole: it covers the whole scene
 */

/**
 * Choose the tiles to draw. A node is drawn until its children, or nodes below them, can be drawn in its place, all of them;
 * and as long as its error is below a number of pixels, the smallest for which the splats keep to the budget.
 *
 * @param {TreeNode[]} nodes children before parents
 * @param {(tile: number) => boolean} isHere
 * @param {View | null} view
 * @param {number} budget maximum number of splats, unless the coarsest nodes have more
 * @returns {Cut} tiles ascending
 */
export function chooseTiles(nodes, isHere, view, budget) {
  /** @type {boolean[]} whether a node's own tiles are all here */
  const isLoaded = [];
  /** @type {boolean[]} whether the node, or the nodes below it, cover its part of the scene */
  const isCovered = [];
  /** @type {boolean[]} whether they can be drawn in its place */
  const canRefine = [];
  for (const { index, firstTile, tileCount, children } of nodes) {
    isLoaded[index] = tilesOf(firstTile, tileCount).every(isHere);
    canRefine[index] = children.length > 0 && children.every((child) => isCovered[child]);
    isCovered[index] = isLoaded[index] || canRefine[index];
  }
  const roots = nodes.filter(({ parent }) => parent === null).map(({ index }) => index);
  const errors = nodes.map((node) => (view ? errorInPixels(node, view) : Infinity));
  const cutAt = (/** @type {number} */ pixels) => {
    const chosen = [];
    const pending = [...roots];
    while (pending.length) {
      const node = nodes[Number(pending.pop())];
      const { index, children } = node;
      const isFine = errors[index] <= pixels;
      if (children.length > 0 && (!isLoaded[index] || (canRefine[index] && !isFine))) pending.push(...children);
      else chosen.push(node);
    }
    return { chosen, count: chosen.reduce((sum, { splatCount }) => sum + splatCount, 0) };
  };
  let cut = cutAt(-1);
  if (cut.count > budget) {
    const sorted = Float64Array.from(errors).sort();
    let [low, high] = [0, sorted.length - 1];
    while (low < high) {
      const middle = (low + high) >> 1;
      if (cutAt(sorted[middle]).count > budget) low = middle + 1;
      else high = middle;
    }
    cut = cutAt(sorted[low]);
  }
  const tiles = cut.chosen.flatMap(({ firstTile, tileCount }) => tilesOf(firstTile, tileCount).filter(isHere));
  return { tiles: tiles.sort((a, b) => a - b), isWhole: roots.every((root) => isCovered[root]) };
}

/**
 * Return the error of a node in pixels where its box is nearest to the camera; 0 if it is out of view.
 *
 * @param {TreeNode} node
 * @param {View} view
 */
function errorInPixels({ error, min, max }, view) {
  const { viewmat: m, fx, fy, near } = view;
  const [x0, x1, y0, y1] = slopeLimits(view);
  const half = [0, 1, 2].map((axis) => (max[axis] - min[axis]) / 2);
  const along = (/** @type {number[]} */ row) => {
    const centre = row[3] + [0, 1, 2].reduce((sum, axis) => sum + row[axis] * (min[axis] + half[axis]), 0);
    const reach = [0, 1, 2].reduce((sum, axis) => sum + Math.abs(row[axis]) * half[axis], 0);
    return [centre - reach, centre + reach];
  };
  const rows = [0, 4, 8].map((at) => [m[at], m[at + 1], m[at + 2], m[at + 3]]);
  const beyond = (/** @type {number} */ axis, /** @type {number} */ sign, /** @type {number} */ slope) =>
    along(rows[axis].map((value, k) => sign * (value - slope * rows[2][k])))[1] < 0;
  const [x, y, z] = rows.map(along);
  if (z[1] <= near || beyond(0, 1, x0) || beyond(0, -1, x1) || beyond(1, 1, y0) || beyond(1, -1, y1)) return 0;
  const nearest = (/** @type {number[]} */ [low, high]) => Math.max(low, -high, 0);
  return (error * Math.max(fx, fy)) / Math.max(near, Math.hypot(nearest(x), nearest(y), nearest(z)));
}

/**
 * @param {number} first
 * @param {number} count
 */
const tilesOf = (first, count) => Array.from({ length: count }, (_, i) => first + i);
