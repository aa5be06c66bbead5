// SPDX-License-Identifier: Apache-2.0
// The interface of the encoder, which encoder.d.ts documents. Tasks are done here or in a worker, which imports tasks.mjs and
// not this module: bundlers cannot build a worker that starts itself.

import { CsplatError, TASKS } from './tasks.mjs';

export { CsplatError };

/**
 * @typedef {import('./encoder.d.ts').Splats} Splats
 * @typedef {import('./encoder.d.ts').EncodeOptions} EncodeOptions
 */

/**
 * Start a worker.
 *
 * @returns {Promise<any>} a worker of the browser or of Node
 */
async function startWorker() {
  if (typeof Worker === 'function') {
    return new Worker(new URL('./encoder-worker.mjs', import.meta.url), { type: 'module' });
  }
  const [name, side] = ['node:worker_threads', './encoder-worker.mjs']; // bundlers need not find these
  const threads = await import(/* webpackIgnore: true */ /* @vite-ignore */ name);
  return new threads.Worker(new URL(side, import.meta.url));
}

/**
 * Do a task here, or in a worker of its own; here, too, if none starts.
 *
 * @param {keyof typeof TASKS} task
 * @param {any} input
 * @param {EncodeOptions} options
 * @returns {Promise<any>}
 */
async function run(task, input, options) {
  const { worker: isWanted = false, onProgress, signal, sourceIndex } = options;
  signal?.throwIfAborted();
  const worker = isWanted ? await startWorker().catch(() => null) : null;
  if (worker === null) return TASKS[task](options, input);
  const listen = (/** @type {string} */ type, /** @type {(event: any) => void} */ listener) =>
    worker.addEventListener ? worker.addEventListener(type, listener) : worker.on(type, listener);
  let hasStarted = false;
  let stop = () => {};
  try {
    const done = await new Promise((resolve, reject) => {
      stop = () => reject(signal?.reason);
      signal?.addEventListener('abort', stop, { once: true });
      for (const type of ['error', 'messageerror', 'exit']) {
        listen(type, (event) => {
          event.preventDefault?.();
          const reason = event.message ? `: ${event.message}` : '';
          if (hasStarted)
            reject(new CsplatError(`E_LIMIT: the worker has failed, perhaps for lack of memory${reason}`));
          else resolve(null);
        });
      }
      listen('message', (event) => {
        hasStarted = true;
        const { done, result, index, error, isCsplat } = worker.addEventListener ? event.data : event;
        if (done !== undefined) onProgress?.(done);
        else if (error !== undefined) reject(isCsplat ? new CsplatError(error) : new Error(error));
        else {
          if (index) sourceIndex?.set(index);
          resolve({ result });
        }
      });
      worker.postMessage({ task, input, count: sourceIndex?.length });
    });
    return done === null ? await TASKS[task](options, input) : done.result;
  } finally {
    signal?.removeEventListener('abort', stop);
    worker.terminate();
  }
}

/** @param {Splats} splats @param {EncodeOptions} [options] */
export function encode(splats, options = {}) {
  const { header = {}, ...stated } = splats;
  const { origin, axes, unitMetres, antialiased, flat, colourSpace } = header;
  return run('encode', { origin, axes, unitMetres, antialiased, flat, colourSpace, ...stated }, options);
}

/** @param {ArrayBuffer | Uint8Array} ply @param {EncodeOptions} [options] */
export const readPly = (ply, options = {}) => run('readPly', ply, options);

/** @param {ArrayBuffer | Uint8Array} ply @param {EncodeOptions} [options] */
export const encodePly = (ply, options = {}) => run('encodePly', ply, options);
