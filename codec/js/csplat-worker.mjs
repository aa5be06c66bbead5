// SPDX-License-Identifier: Apache-2.0
// The code that runs in a worker; workers.mjs runs in the calling thread.

import { buffersOf } from './arrays.mjs';
import { Reader } from './reader.mjs';

/**
 * @typedef {Map<number, Uint8Array<ArrayBuffer>>} Parts of the file, by their offsets
 * @typedef {{form?: import('./decoder.d.ts').LayerForm, shDegree: number, extra: boolean}} Wanted of a tile
 * @typedef {{open: Parts, wanted: Wanted} | {tile: number, layer?: number, parts: Parts, spare?: any}} Request `layer`: to read
 *   it alone, packed; `spare`: fields whose memory may be reused
 * @typedef {{fields?: any}} Answer the arrays of a tile or layer, or nothing if it was refused
 */

/** @type {Parts} */
let parts = new Map();
/** @type {Wanted} */
let wanted;
/** @type {Reader} */
let reader;
/** @type {Set<object>} codebook tables already sent */
let sent = new Set();

/**
 * @param {Request} request
 * @returns {Promise<Answer>}
 */
async function answer(request) {
  if ('open' in request) {
    parts = request.open;
    wanted = request.wanted;
    const read = async (/** @type {number} */ offset) => /** @type {Uint8Array<ArrayBuffer>} */ (parts.get(offset));
    reader = await Reader.open({ read });
    sent = new Set();
    return {};
  }
  for (const [offset, bytes] of request.parts) parts.set(offset, bytes);
  const { tile, layer, spare } = request;
  /** @type {any} */
  const fields = await (layer === undefined
    ? reader.readTile(tile, wanted, spare)
    : reader.readLayer(tile, layer, { form: 'packed' }));
  if (layer !== undefined) reader.forget(tile);
  for (const offset of request.parts.keys()) parts.delete(offset);
  for (const { lookup } of [fields.sh].flat().filter(Boolean)) {
    if (lookup && sent.has(lookup.table)) delete lookup.table;
    else if (lookup) sent.add(lookup.table);
  }
  return { fields };
}

/** @param {any} port source of requests and target of answers */
function serve(port) {
  const listen = async (/** @type {Request} */ request) => {
    const given = await answer(request).catch(() => ({}));
    port.postMessage(given, buffersOf(given));
  };
  if (port.on) port.on('message', listen);
  else port.addEventListener('message', (/** @type {MessageEvent} */ { data }) => listen(data));
}

// No top-level await: bundlers that turn a worker into a classic script do not support it.
const { process } = /** @type {{process?: {versions?: {node?: string}}}} */ (globalThis);
const name = 'node:worker_threads';
if (process?.versions?.node === undefined) serve(globalThis);
else import(/* webpackIgnore: true */ /* @vite-ignore */ name).then(({ parentPort }) => serve(parentPort));
