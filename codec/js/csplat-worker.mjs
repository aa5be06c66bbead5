// The side of the worker: see workers.mjs.

import { CsplatReader } from './reader.mjs';

/**
 * @typedef {Map<number, Uint8Array<ArrayBuffer>>} Parts of the file, by their offsets
 * @typedef {import('./assemble.mjs').Wanted} Wanted
 * @typedef {{open: Parts, wanted: Wanted} | {tile: number, parts: Parts}} Request
 * @typedef {{fields?: any}} Answer the arrays of a tile; without them where it was refused
 */

/** @type {Parts} */
let parts = new Map();
/** @type {Wanted} */
let wanted;
/** @type {CsplatReader | undefined} */
let reader;

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
    return {};
  }
  for (const [offset, bytes] of request.parts) parts.set(offset, bytes);
  const { shDegree, extra } = wanted;
  const fields = await /** @type {CsplatReader} */ (reader).readTile(request.tile, { shDegree, extra });
  for (const offset of request.parts.keys()) parts.delete(offset);
  return { fields };
}

/** @param {Answer} given */
const buffers = ({ fields = {} }) =>
  [...Object.values(fields), ...Object.values(fields.extra ?? {})].filter(ArrayBuffer.isView).map(({ buffer }) => buffer);

/** @param {any} port that requests come from and answers go to */
function serve(port) {
  const listen = async (/** @type {Request} */ request) => {
    const given = await answer(request).catch(() => ({}));
    port.postMessage(given, buffers(given));
  };
  if (port.on) port.on('message', listen);
  else port.addEventListener('message', (/** @type {MessageEvent} */ { data }) => listen(data));
}

// No await out here: bundlers that make a classic script of a worker know none.
const { process } = /** @type {{process?: {versions?: {node?: string}}}} */ (globalThis);
const name = 'node:worker_threads';
if (process?.versions?.node === undefined) serve(globalThis);
else import(/* webpackIgnore: true */ /* @vite-ignore */ name).then(({ parentPort }) => serve(parentPort));
