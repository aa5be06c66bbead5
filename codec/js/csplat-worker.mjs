// The side of the worker: see workers.mjs.

import { CsplatReader } from './reader.mjs';

/**
 * @typedef {Map<number, Uint8Array<ArrayBuffer>>} Parts of the file, by their offsets
 * @typedef {{form?: import('./decoder.d.ts').LayerForm, shDegree: number, extra: boolean}} Wanted of a tile
 * @typedef {{open: Parts, wanted: Wanted} | {tile: number, parts: Parts}} Request
 * @typedef {{fields?: any}} Answer the arrays of a tile; without them where it was refused
 */

/** @type {Parts} */
let parts = new Map();
/** @type {Wanted} */
let wanted;
/** @type {CsplatReader} */
let reader;
/** @type {Set<object>} tables of codebooks that were sent */
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
    reader = await CsplatReader.open({ read });
    sent = new Set();
    return {};
  }
  for (const [offset, bytes] of request.parts) parts.set(offset, bytes);
  /** @type {any} */
  const fields = await reader.readTile(request.tile, /** @type {{form: 'packed', shDegree: number}} */ (wanted));
  for (const offset of request.parts.keys()) parts.delete(offset);
  for (const { lookup } of (fields.sh ?? []).filter(Boolean)) {
    if (lookup && sent.has(lookup.table)) delete lookup.table;
    else if (lookup) sent.add(lookup.table);
  }
  return { fields };
}

/**
 * All arrays of an answer but tables of codebooks, which stay.
 *
 * @param {object} value
 * @returns {ArrayBuffer[]}
 */
const buffers = (value) =>
  Object.entries(value).flatMap(([name, one]) => {
    if (ArrayBuffer.isView(one)) return [/** @type {ArrayBuffer} */ (one.buffer)];
    return name !== 'table' && typeof one === 'object' && one !== null ? buffers(one) : [];
  });

/** @param {any} port that requests come from and answers go to */
function serve(port) {
  const listen = async (/** @type {Request} */ request) => {
    const given = await answer(request).catch(() => ({}));
    port.postMessage(given, [...new Set(buffers(given))]);
  };
  if (port.on) port.on('message', listen);
  else port.addEventListener('message', (/** @type {MessageEvent} */ { data }) => listen(data));
}

// No await out here: bundlers that make a classic script of a worker know none.
const { process } = /** @type {{process?: {versions?: {node?: string}}}} */ (globalThis);
const name = 'node:worker_threads';
if (process?.versions?.node === undefined) serve(globalThis);
else import(/* webpackIgnore: true */ /* @vite-ignore */ name).then(({ parentPort }) => serve(parentPort));
