// SPDX-License-Identifier: Apache-2.0
// Choices in a file with levels of detail: the tiles that are drawn, of those that are here, and the tiles to request.

/**
 * @typedef {import('../decoder.d.ts').Header} Header
 * @typedef {import('../decoder.d.ts').TreeNode} TreeNode
 *
 * A pinhole camera: world → camera row by row, a rotation and a translation, with x right, y down, z forward (OpenCV); pixels;
 * distance along z from which on splats are drawn, scene units.
 *
 * @typedef {{viewmat: ArrayLike<number>, fx: number, fy: number, cx: number, cy: number, near: number, width: number,
 *   height: number}} View
 *
 * Nodes in a view.
 *
 * @typedef {object} Looks
 * @property {Float64Array} pixels error of each node where its box is nearest to the camera, pixels
 * @property {Float64Array} distance of its box from the camera, scene units
 * @property {boolean[]} isSeen whether it may be in view
 *
 * `isWhole`: the tiles cover the whole scene. `refined`: the nodes whose children, or nodes below them, are drawn.
 *
 * @typedef {{tiles: number[], isWhole: boolean, refined: Set<number>}} Cut
 *
 * A node to request. `isNeeded` for the picture: it is a root, or its parent is seen and to be refined. `isDrawn`: it is part of
 * the picture that is aimed at, not only drawn until finer ones are here, nor out of view. `urgency`: the error in pixels of
 * what it replaces, infinite for a root.
 *
 * @typedef {{node: TreeNode, isNeeded: boolean, isDrawn: boolean, urgency: number, distance: number}} Wish
 */

/** Maximum distance outside the picture at which the perspective is linearised, in half-widths of the picture. */
const FOV_MARGIN = 0.3;

/** Factor by which the error of a refined node counts more, so that small movements do not exchange it back and forth. */
const INERTIA = 1.25;

/**
 * Return the nodes of a file, or a root for each tile if it has no levels of detail.
 *
 * @param {Header} header
 * @param {TreeNode[]} nodes of the file
 * @returns {TreeNode[]}
 */
export function nodesOrTiles({ tiles, coarseTiles }, nodes) {
  if (coarseTiles.length > 0) return nodes;
  return tiles.map(({ index, splatCount, min, max }) => {
    const place = { index, level: 0, parent: null, children: [], firstTile: index, tileCount: 1 };
    return { ...place, splatCount, error: 0, min, max };
  });
}

/**
 * Choose the tiles to draw. A node is drawn until its children, or nodes below them, can be drawn in its place, all of them.
 * If these would be too many splats, the nodes of the smallest errors stay.
 *
 * @param {TreeNode[]} nodes children before parents
 * @param {(tile: number) => boolean} isHere
 * @param {Looks} looks
 * @param {number} budget maximum number of splats, unless the coarsest nodes have more
 * @param {Set<number>} [before] `refined` of the preceding cut
 * @param {number} [least] error, in pixels, up to which nodes stay as well
 * @returns {Cut} tiles ascending
 */
export function chooseTiles(nodes, isHere, looks, budget, before = new Set(), least = -1) {
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
  const errors = nodes.map(({ index }) => {
    if (!looks.isSeen[index]) return 0;
    return looks.pixels[index] * (before.has(index) ? INERTIA : 1);
  });
  const refined = refine(nodes, errors, budget, {
    must: (node) => node.children.length > 0 && !isLoaded[node.index],
    may: ({ index }) => canRefine[index] && errors[index] > least,
  });
  const tiles = nodes.flatMap(({ index, parent, firstTile, tileCount }) => {
    const isChosen = !refined.has(index) && (parent === null || refined.has(parent));
    return isChosen ? tilesOf(firstTile, tileCount).filter(isHere) : [];
  });
  const isWhole = nodes.every(({ index, parent }) => parent !== null || isCovered[index]);
  return { tiles: tiles.sort((a, b) => a - b), isWhole, refined };
}

/**
 * Choose the nodes to request for a view: what is in view until the errors are small or the budget is used up, and around
 * it what a turn of the camera would show.
 *
 * @param {TreeNode[]} nodes children before parents
 * @param {Looks} looks
 * @param {{budget: number, pixels: number, around: boolean}} aims maximum number of splats to draw; error that is small
 *   enough, pixels; whether to request what is out of view
 * @returns {Wish[]} the most urgent first
 */
export function chooseWishes(nodes, looks, { budget, pixels: least, around }) {
  const { pixels, distance, isSeen } = looks;
  const errors = nodes.map(({ index }) => (isSeen[index] ? pixels[index] : 0));
  const refined = refine(nodes, errors, budget, {
    must: () => false,
    may: ({ index, children }) => children.length > 0 && errors[index] > least,
  });
  const isRefined = (/** @type {TreeNode} */ { index, children }) => {
    return isSeen[index] ? refined.has(index) : around && children.length > 0 && pixels[index] > least;
  };
  /** @type {Wish[]} */
  const wishes = [];
  const pending = nodes
    .filter(({ parent }) => parent === null)
    .map((node) => ({ node, urgency: Infinity, isNeeded: true }));
  for (let one = pending.pop(); one; one = pending.pop()) {
    const { node, urgency, isNeeded } = one;
    const { index, children, parent } = node;
    const opens = isRefined(node);
    const isDrawn = !opens && (isSeen[index] || !isNeeded || parent === null);
    wishes.push({ node, isNeeded, isDrawn, urgency, distance: distance[index] });
    for (const child of opens ? children : []) {
      pending.push({ node: nodes[child], urgency: pixels[index], isNeeded: isSeen[index] });
    }
  }
  return wishes.sort(
    (a, b) =>
      Number(b.isNeeded) - Number(a.isNeeded) ||
      (a.urgency === b.urgency ? 0 : b.urgency - a.urgency) ||
      Number(isSeen[b.node.index]) - Number(isSeen[a.node.index]) ||
      a.distance - b.distance ||
      a.node.firstTile - b.node.firstTile,
  );
}

/**
 * Return how nodes look in a view. Without one, all are seen, with infinite errors.
 *
 * @param {TreeNode[]} nodes
 * @param {View | null} view
 * @returns {Looks}
 */
export function looksOf(nodes, view) {
  /** @type {Looks} */
  const looks = { pixels: new Float64Array(nodes.length), distance: new Float64Array(nodes.length), isSeen: [] };
  if (view === null) {
    looks.pixels.fill(Infinity);
    looks.isSeen = nodes.map(() => true);
    return looks;
  }
  const { viewmat: m, fx, fy, near } = view;
  const rows = [0, 4, 8].map((at) => [m[at], m[at + 1], m[at + 2], m[at + 3]]);
  const [x0, x1, y0, y1] = slopeLimits(view);
  const [right, down, forward] = rows;
  const sides = [
    { row: right, sign: 1, slope: x0 },
    { row: right, sign: -1, slope: x1 },
    { row: down, sign: 1, slope: y0 },
    { row: down, sign: -1, slope: y1 },
  ].map(({ row, sign, slope }) => row.map((value, k) => sign * (value - slope * forward[k])));
  for (const { index, error, min, max } of nodes) {
    const farthest = reach(forward, min, max)[1];
    looks.isSeen[index] = farthest > near && sides.every((side) => reach(side, min, max)[1] >= 0);
    const away = rows.map((row) => {
      const [low, high] = reach(row, min, max);
      return Math.max(low, -high, 0);
    });
    looks.distance[index] = Math.hypot(away[0], away[1], away[2]);
    looks.pixels[index] = (error * Math.max(fx, fy)) / Math.max(near, looks.distance[index]);
  }
  return looks;
}

/**
 * Return the smallest and largest x/z and y/z at which the perspective is linearised.
 *
 * @param {View} view
 * @returns {[number, number, number, number]}
 */
export function slopeLimits({ fx, fy, cx, cy, width, height }) {
  const marginX = (FOV_MARGIN * 0.5 * width) / fx;
  const marginY = (FOV_MARGIN * 0.5 * height) / fy;
  return [-cx / fx - marginX, (width - cx) / fx + marginX, -cy / fy - marginY, (height - cy) / fy + marginY];
}

/**
 * Return the smallest and largest value of a linear function in a box.
 *
 * @param {number[]} row
 * @param {number[]} min
 * @param {number[]} max
 */
function reach(row, min, max) {
  let low = row[3];
  let high = row[3];
  for (let axis = 0; axis < 3; axis++) {
    const a = row[axis] * min[axis];
    const b = row[axis] * max[axis];
    low += Math.min(a, b);
    high += Math.max(a, b);
  }
  return [low, high];
}

/**
 * Cut a tree: from its roots on, refine the node of the largest error, again and again, until the next one would exceed a
 * budget.
 *
 * @param {TreeNode[]} nodes children before parents
 * @param {number[]} errors not above those of the parents
 * @param {number} budget splats
 * @param {{must: (node: TreeNode) => boolean, may: (node: TreeNode) => boolean}} rules whether a node has to be refined, and
 *   whether it can be
 * @returns {Set<number>} the nodes that are refined
 */
function refine(nodes, errors, budget, { must, may }) {
  /** @type {Set<number>} */
  const refined = new Set();
  let count = 0;
  const take = (/** @type {TreeNode} */ node) => {
    count += node.splatCount;
    if (must(node)) open(node);
  };
  const open = (/** @type {TreeNode} */ { index, splatCount, children }) => {
    refined.add(index);
    count -= splatCount;
    for (const child of children) take(nodes[child]);
  };
  /** @type {(node: TreeNode) => number} */
  const splatsOf = (node) =>
    must(node) ? node.children.reduce((sum, child) => sum + splatsOf(nodes[child]), 0) : node.splatCount;
  for (const node of nodes) if (node.parent === null) take(node);
  for (const node of [...nodes].sort((a, b) => errors[b.index] - errors[a.index] || b.index - a.index)) {
    const isInCut = !refined.has(node.index) && (node.parent === null || refined.has(node.parent));
    if (!isInCut || !may(node)) continue;
    const added = node.children.reduce((sum, child) => sum + splatsOf(nodes[child]), -node.splatCount);
    if (count + added > budget) break;
    open(node);
  }
  return refined;
}

/**
 * @param {number} first
 * @param {number} count
 */
export const tilesOf = (first, count) => Array.from({ length: count }, (_, i) => first + i);
