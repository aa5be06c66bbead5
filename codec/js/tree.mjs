// SPDX-License-Identifier: Apache-2.0
// The nodes of the levels of detail and cuts through them (spec 5.7).

import { LimitError, fault } from './errors.mjs';
import { checkedSelection } from './options.mjs';
import { checkResourceLevel } from './resource_level.mjs';
import * as spec from './spec.mjs';
import { allTiles } from './tile_records.mjs';

const { ERROR_INDEX, ERROR_LIMIT, ERROR_STREAM, ERROR_VALUE, NODE_RECORD_OFFSETS: AT } = spec;

/**
 * @typedef {import('./decoder.d.ts').Header} Header
 * @typedef {import('./decoder.d.ts').CutOptions} CutOptions
 * @typedef {import('./decoder.d.ts').TileRecord} TileRecord
 * @typedef {import('./decoder.d.ts').TreeNode} TreeNode
 * @typedef {import('./payload.mjs').Payload} Payload
 */

/**
 * Read and check the payload of TREE, and with it the resource level.
 *
 * @param {Payload | null} payload null: the file has no TREE
 * @param {Header} header
 * @returns {TreeNode[]} children before their parents
 */
export function readNodes(payload, header) {
  const tiles = allTiles(header);
  if (payload === null) return tiles.length ? [makeNode(0, tiles, null, 0)] : [];
  const excess = payload.left % spec.NODE_RECORD_SIZE;
  if (excess) {
    const what = `a payload of ${payload.left} bytes, node records have ${spec.NODE_RECORD_SIZE}`;
    throw fault(ERROR_STREAM, payload.base + payload.left - excess, 'TRE-2', what);
  }
  const nodes = readRecords(payload, tiles);
  const recordOf = (/** @type {TreeNode} */ { index }) => payload.base + spec.NODE_RECORD_SIZE * index;
  for (const node of nodes) addToParent(node, nodes, recordOf(node));
  for (const node of nodes) {
    checkNode(node, nodes, recordOf(node));
    for (const child of node.children) extendBox(node, nodes[child]); // whose box is complete: it comes first
  }
  const roots = nodes.filter(({ parent }) => parent === null);
  checkResourceLevel(
    header,
    roots.flatMap(({ firstTile, tileCount }) => tiles.slice(firstTile, firstTile + tileCount)),
  );
  return nodes;
}

/**
 * Read the records and give each node its tiles (TRE-3, TRE-4).
 *
 * @param {Payload} payload
 * @param {TileRecord[]} tiles
 */
function readRecords(payload, tiles) {
  /** @type {TreeNode[]} */
  const nodes = [];
  let first = 0;
  while (payload.left) {
    const { fields, offset } = payload.read(spec.unpackNodeRecord, spec.NODE_RECORD_SIZE, {}, 'a node record');
    const { parent, tile_count: count, error } = fields;
    const left = tiles.length - first;
    if (count < 1 || count > left)
      throw fault(ERROR_INDEX, offset + AT.tile_count, 'TRE-3', `a node of ${count} tiles, ${left} are left`);
    const own = tiles.slice(first, first + count);
    const [least, most] = [own[0].level, own[count - 1].level]; // TIL-12: levels do not descend
    if (least !== most)
      throw fault(ERROR_INDEX, offset + AT.tile_count, 'TRE-4', `a node with tiles of the levels ${least} to ${most}`);
    nodes.push(makeNode(nodes.length, own, parent === spec.NO_PARENT ? null : parent, error));
    first += count;
  }
  if (first !== tiles.length)
    throw fault(ERROR_INDEX, payload.base, 'TRE-3', `nodes with ${first} tiles, the file has ${tiles.length}`);
  return nodes;
}

/**
 * @param {number} index
 * @param {TileRecord[]} tiles at least one
 * @param {number | null} parent
 * @param {number} error
 * @returns {TreeNode}
 */
function makeNode(index, tiles, parent, error) {
  const [{ index: firstTile, level, min, max }] = tiles;
  const splatCount = tiles.reduce((sum, tile) => sum + tile.splatCount, 0);
  /** @type {TreeNode} */
  const node = {
    index,
    level,
    parent,
    children: [],
    firstTile,
    tileCount: tiles.length,
    splatCount,
    error,
    min: [...min],
    max: [...max],
  };
  for (const tile of tiles) extendBox(node, tile);
  return node;
}

/**
 * @param {TreeNode} node
 * @param {{min: number[], max: number[]}} box
 */
function extendBox(node, { min, max }) {
  for (let axis = 0; axis < 3; axis++) {
    node.min[axis] = Math.min(node.min[axis], min[axis]);
    node.max[axis] = Math.max(node.max[axis], max[axis]);
  }
}

/**
 * TRE-5: "`parent` MUST be NO_PARENT or the number of a node of a higher level".
 *
 * @param {TreeNode} node
 * @param {TreeNode[]} nodes
 * @param {number} offset offset of the record
 */
function addToParent({ index, level, parent }, nodes, offset) {
  if (parent === null) return;
  if (parent >= nodes.length || nodes[parent].level <= level) {
    const what = `node ${index} of level ${level} with the parent ${parent}`;
    throw fault(ERROR_INDEX, offset + AT.parent, 'TRE-5', `${what}, expected a node of a higher level`);
  }
  nodes[parent].children.push(index);
}

/**
 * Check TRE-6 to TRE-8.
 *
 * @param {TreeNode} node
 * @param {TreeNode[]} nodes
 * @param {number} offset offset of the record
 */
function checkNode({ index, level, children, splatCount, error }, nodes, offset) {
  if (level > 0 && children.length === 0)
    throw fault(ERROR_INDEX, offset, 'TRE-6', `node ${index} of level ${level} has no children`);
  const most = children.reduce((sum, child) => sum + nodes[child].splatCount, 0);
  if (level > 0 && splatCount > most)
    throw fault(ERROR_INDEX, offset, 'TRE-7', `node ${index} has ${splatCount} splats, its children have ${most}`);
  const least = children.reduce((largest, child) => Math.max(largest, nodes[child].error), 0);
  const isRight = level > 0 ? error >= least && error < Infinity : error === 0;
  if (!isRight) {
    const expected = level > 0 ? `finite and at least ${least}` : '0 at level 0';
    throw fault(ERROR_VALUE, offset + AT.error, 'TRE-8', `an error of ${error}, expected ${expected}`);
  }
}

/**
 * Select the tiles of a cut.
 *
 * @param {TreeNode[]} nodes
 * @param {Header} header
 * @param {CutOptions} options
 * @returns {number[]} indices of tiles, ascending
 */
export function selectTiles(nodes, header, options) {
  const { level, pixelSizes, maxSplats, box } = checkedSelection(options, nodes.length);
  let cut = [];
  if (pixelSizes !== undefined) cut = cutAtPixelSize(nodes, pixelSizes);
  else if (maxSplats !== undefined) cut = cutWithin(nodes, maxSplats);
  else cut = cutAtLevel(nodes, level);
  const tiles = allTiles(header);
  return cut.flatMap((n) => tilesOf(nodes[n], box, tiles));
}

/**
 * Return the first node from each root that is not coarser than a level.
 *
 * @param {TreeNode[]} nodes
 * @param {number} level
 * @returns {number[]} indices of nodes, ascending
 */
export const cutAtLevel = (nodes, level) => cutWhere(nodes, (node) => node.level > level);

/**
 * Return the first node from each root whose error is at most the size of a pixel there.
 *
 * @param {TreeNode[]} nodes
 * @param {number[]} sizes one for each node
 * @returns {number[]} indices of nodes, ascending
 */
export const cutAtPixelSize = (nodes, sizes) => cutWhere(nodes, ({ index, error }) => error > sizes[index]);

/**
 * Return a cut of at most `budget` splats, in which the nodes with the largest errors are replaced first.
 *
 * @param {TreeNode[]} nodes
 * @param {number} budget
 * @returns {number[]} indices of nodes, ascending
 */
export function cutWithin(nodes, budget) {
  let count = 0;
  for (const { parent, splatCount } of nodes) if (parent === null) count += splatCount;
  if (count > budget) {
    const what = `the coarsest nodes have ${count} splats, the budget is ${budget}`;
    throw new LimitError(ERROR_LIMIT, what, { clause: 'TRE-9' });
  }
  // A node comes before its children in this order, by TRE-5 and TRE-8. So the first node that has not been replaced is in
  // the cut, and has the largest error of those in the cut.
  const inner = nodes.filter(({ level }) => level > 0).sort((a, b) => b.error - a.error || b.index - a.index);
  const replaced = new Set();
  for (const node of inner) {
    count -= node.splatCount;
    for (const child of node.children) count += nodes[child].splatCount;
    if (count > budget) break;
    replaced.add(node);
  }
  return cutWhere(nodes, (node) => replaced.has(node));
}

/**
 * Return the first node from each root that is not replaced by its children.
 *
 * @param {TreeNode[]} nodes
 * @param {(node: TreeNode) => boolean} isReplaced
 */
function cutWhere(nodes, isReplaced) {
  const replaced = new Uint8Array(nodes.length);
  const cut = [];
  for (let n = nodes.length - 1; n >= 0; n--) {
    const { parent } = nodes[n];
    if (parent !== null && !replaced[parent]) continue;
    if (isReplaced(nodes[n])) replaced[n] = 1;
    else cut.push(n);
  }
  return cut.reverse();
}

/**
 * Return the tiles of a node; in a box, those of level 0 whose box touches it, or all of a coarser node whose region does.
 *
 * @param {TreeNode} node
 * @param {number[] | undefined} box
 * @param {TileRecord[]} tiles of all levels
 */
function tilesOf(node, box, tiles) {
  const all = Array.from({ length: node.tileCount }, (_, i) => node.firstTile + i);
  if (box === undefined) return all;
  if (node.level === 0) return all.filter((tile) => touches(tiles[tile], box));
  return touches(node, box) ? all : [];
}

/**
 * @param {{min: number[], max: number[]}} region
 * @param {number[]} box
 */
const touches = ({ min, max }, box) => min.every((low, axis) => low <= box[axis + 3] && max[axis] >= box[axis]);
