// Checks of the caller's arguments. Every error here is E_INPUT.

import { InputError } from './errors.mjs';
import { BUDGET_BYTES_JS, BUDGET_JSON_BYTES } from './spec.mjs';

/**
 * @typedef {import('./decoder.d.ts').Header} Header
 * @typedef {import('./decoder.d.ts').Limits} Limits
 */

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
  const complete = { splats: Infinity, bytes: BUDGET_BYTES_JS, jsonBytes: BUDGET_JSON_BYTES };
  for (const [name, value] of Object.entries(limits)) {
    if (!Object.hasOwn(complete, name)) throw new InputError(`no limit is called ${name}`);
    if (value === undefined) continue;
    if (typeof value !== 'number' || !(value >= 0)) throw new InputError(`limits.${name} is ${value}`);
    complete[/** @type {keyof Limits} */ (name)] = value;
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
 * @returns {Header['tiles']}
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
  const tile = Number.isInteger(index) ? header.tiles[index] : undefined;
  if (tile === undefined) throw new InputError(`tile ${index}: the file has ${header.tiles.length}`);
  return tile;
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
