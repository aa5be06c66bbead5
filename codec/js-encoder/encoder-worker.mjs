// SPDX-License-Identifier: Apache-2.0
// The code that runs in a worker; encoder.mjs runs in the calling thread. A worker does one task.

import { CsplatError, TASKS } from './tasks.mjs';

/** @param {any} port source of the request and target of the answers */
function serve(port) {
  const listen = async (/** @type {{task: keyof typeof TASKS, input: any, count?: number}} */ request) => {
    const sourceIndex = request.count === undefined ? undefined : new Uint32Array(request.count);
    const onProgress = (/** @type {number} */ done) => port.postMessage({ done });
    try {
      const result = await TASKS[request.task]({ onProgress, sourceIndex }, request.input);
      const arrays = result instanceof Uint8Array ? [result] : Object.values(result).filter(ArrayBuffer.isView);
      port.postMessage(
        { result, index: sourceIndex },
        arrays.map(({ buffer }) => buffer),
      );
    } catch (error) {
      const { message } = /** @type {Error} */ (error);
      port.postMessage({ error: message, isCsplat: error instanceof CsplatError });
    }
  };
  if (port.on) port.on('message', listen);
  else port.addEventListener('message', (/** @type {MessageEvent} */ { data }) => listen(data));
}

// No top-level await: bundlers that turn a worker into a classic script do not support it.
const { process } = /** @type {{process?: {versions?: {node?: string}}}} */ (globalThis);
const name = 'node:worker_threads';
if (process?.versions?.node === undefined) serve(globalThis);
else import(/* webpackIgnore: true */ /* @vite-ignore */ name).then(({ parentPort }) => serve(parentPort));
