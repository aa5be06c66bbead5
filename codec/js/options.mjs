// SPDX-License-Identifier: Apache-2.0
// Checks of the caller's arguments. Every error here is E_INPUT.

import { InputError } from './errors.mjs';
import { HIGHEST_LEVEL, LEVEL_MAX } from './registry.mjs';
import { BUDGET_BYTES_JS, BUDGET_JSON_BYTES } from './spec.mjs';

/**
 * @typedef {import('./decoder.d.ts').Header} Header
 * @typedef {import('./decoder.d.ts').Limits} Limits
 * @typedef {import('./decoder.d.ts').CutOptions} CutOptions
 */

const CUTS = ['level', 'pixelSize', 'maxSplats']; // options of `cut` that exclude each other

/**
 * @param {unknown} data
 * @returns {Uint8Array<ArrayBuffer>}
 */
export function toBytes(data) {
  if (data instanceof ArrayBuffer) return new Uint8Array(data);
  if (ArrayBuffer.isView(data)) {
    const bytes = new Uint8Array(data.buffer, data.byteOffset, data.byteLength);
    // Another thread could change shared memory between a check and its use.
    return bytes.buffer instanceof ArrayBuffer ? /** @type {Uint8Array<ArrayBuffer>} */ (bytes) : bytes.slice();
  }
  throw new InputError('the data is neither an ArrayBuffer nor a view of one');
}

/**
 * @param {Limits} [limits]
 * @returns {Required<Limits>}
 */
export function checkedLimits(limits = {}) {
  /** @type {Required<Limits>} */
  const complete = {
    splats: Infinity,
    bytes: BUDGET_BYTES_JS,
    jsonBytes: BUDGET_JSON_BYTES,
    resourceLevel: HIGHEST_LEVEL,
  };
  for (const [name, value] of Object.entries(limits)) {
    if (!Object.hasOwn(complete, name)) throw new InputError(`no limit is called ${name}`);
    if (value === undefined) continue;
    const isLevel = name === 'resourceLevel';
    const isValid = isLevel ? ['A', 'B', 'C'].includes(String(value)) : typeof value === 'number' && value >= 0;
    if (!isValid) throw new InputError(`limits.${name} is ${value}, expected ${isLevel ? 'A, B or C' : '0 or more'}`);
    Object.assign(complete, { [name]: value });
  }
  return complete;
}

/**
 * @param {number | undefined} shDegree
 * @param {Header} header
 * @returns {number} at most the degree of the file
 */
export function checkedDegree(shDegree, header) {
  if (shDegree === undefined) return header.shDegree;
  if (!Number.isInteger(shDegree) || shDegree < 0) throw new InputError(`shDegree is ${shDegree}`);
  return Math.min(shDegree, header.shDegree);
}

/**
 * @param {Iterable<number> | undefined} tiles
 * @param {Header} header
 * @returns {Header['tiles']} of any level; by default those of level 0
 */
export function checkedTiles(tiles, header) {
  if (tiles === undefined) return header.tiles;
  const chosen = [...new Set(tiles)].map((index) => checkedTile(index, header));
  return chosen;
}

/**
 * @param {number} index
 * @param {Header} header
 */
export function checkedTile(index, header) {
  const { tiles, coarseTiles } = header;
  const tile = Number.isInteger(index) ? (tiles[index] ?? coarseTiles[index - tiles.length]) : undefined;
  if (tile === undefined) throw new InputError(`tile ${index}: the file has ${tiles.length + coarseTiles.length}`);
  return tile;
}

/**
 * @param {CutOptions} options
 * @param {number} nodeCount
 * @returns {{level: number, pixelSizes?: number[], maxSplats?: number, box?: number[]}} a pixel size per node
 */
export function checkedSelection(options, nodeCount) {
  for (const name of Object.keys(options)) {
    if (!CUTS.includes(name) && name !== 'box') throw new InputError(`cut has no option ${name}`);
  }
  const given = CUTS.filter((name) => options[/** @type {keyof CutOptions} */ (name)] !== undefined);
  if (given.length > 1) throw new InputError(`${given.join(' and ')} exclude each other`);
  const { level = 0, pixelSize, maxSplats, box } = options;
  if (!(Number.isInteger(level) && level >= 0 && level <= LEVEL_MAX))
    throw new InputError(`level is ${level}, expected 0 to ${LEVEL_MAX}`);
  if (maxSplats !== undefined) checkAmount('maxSplats', maxSplats);
  return { level, pixelSizes: checkedSizes(pixelSize, nodeCount), maxSplats, box: checkedBox(box) };
}

/**
 * @param {CutOptions['pixelSize']} size
 * @param {number} nodeCount
 */
function checkedSizes(size, nodeCount) {
  if (size === undefined) return undefined;
  const sizes = typeof size === 'number' ? Array(nodeCount).fill(size) : Array.from(size ?? []);
  if (sizes.length !== nodeCount)
    throw new InputError(`pixelSize has ${sizes.length} numbers, expected one, or one for each of ${nodeCount} nodes`);
  for (const one of sizes) checkAmount('pixelSize', one);
  return sizes;
}

/**
 * @param {string} name
 * @param {unknown} value
 */
function checkAmount(name, value) {
  if (typeof value !== 'number' || !(value >= 0)) throw new InputError(`${name} is ${value}, expected 0 or more`);
}

/** @param {CutOptions['box']} box */
function checkedBox(box) {
  if (box === undefined) return undefined;
  const corners = Array.from(box ?? []);
  if (corners.length !== 6 || !corners.every((value) => typeof value === 'number' && !Number.isNaN(value)))
    throw new InputError(`box is ${corners}, expected six numbers other than NaN: two corners, x, y, z each`);
  const [one, other] = [corners.slice(0, 3), corners.slice(3)];
  const ends = (/** @type {'min' | 'max'} */ end) => one.map((value, axis) => Math[end](value, other[axis]));
  return [...ends('min'), ...ends('max')];
}

/**
 * @param {unknown} form
 * @returns {boolean} true for integers
 */
export function checkedForm(form) {
  if (form === undefined || form === 'floats') return false;
  if (form === 'integers') return true;
  throw new InputError(`form is ${JSON.stringify(form)}, expected 'floats' or 'integers'`);
}
