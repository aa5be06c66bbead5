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
 * @returns {Promise<{post: (message: unknown) => void, listen: (use: (message: any) => void) => void,
 *   onError: (use: (error: unknown) => void) => void, end: () => void}>}
 */
async function startWorker() {
  if (typeof Worker === 'function') {
    const worker = new Worker(new URL('./encoder-worker.mjs', import.meta.url), { type: 'module' });
    return {
      post: (message) => worker.postMessage(message),
      listen: (use) => worker.addEventListener('message', ({ data }) => use(data)),
      onError: (use) =>
        worker.addEventListener('error', ({ message }) => use(new Error(message || 'no worker starts'))),
      end: () => worker.terminate(),
    };
  }
  const [name, side] = ['node:worker_threads', './encoder-worker.mjs']; // bundlers need not find these
  const threads = await import(/* webpackIgnore: true */ /* @vite-ignore */ name);
  const worker = new threads.Worker(new URL(side, import.meta.url));
  return {
    post: (message) => worker.postMessage(message),
    listen: (use) => worker.on('message', use),
    onError: (use) => worker.on('error', use),
    end: () => worker.terminate(),
  };
}

/**
 * Do a task here, or in a worker of its own.
 *
 * @param {keyof typeof TASKS} task
 * @param {any} input
 * @param {EncodeOptions} options
 * @returns {Promise<any>}
 */
async function run(task, input, options) {
  const { worker = false, onProgress, signal, sourceIndex } = options;
  signal?.throwIfAborted();
  if (!worker) return TASKS[task](options, input);
  const thread = await startWorker();
  try {
    return await new Promise((resolve, reject) => {
      signal?.addEventListener('abort', () => reject(signal.reason), { once: true });
      thread.onError(reject);
      thread.listen(({ done, result, index, error, isCsplat }) => {
        if (done !== undefined) onProgress?.(done);
        else if (error !== undefined) reject(isCsplat ? new CsplatError(error) : new Error(error));
        else {
          if (index) sourceIndex?.set(index);
          resolve(result);
        }
      });
      thread.post({ task, input, count: sourceIndex?.length });
    });
  } finally {
    thread.end();
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
