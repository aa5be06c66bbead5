// Tiles decoded by workers, for `decode` with the option `workers`. csplat-worker.mjs is their side.

/**
 * @typedef {import('./assemble.mjs').Assembly} Assembly
 * @typedef {import('./decoder.d.ts').TileRecord} TileRecord
 * @typedef {import('./reader.mjs').CsplatReader} CsplatReader
 * @typedef {import('./csplat-worker.mjs').Answer} Answer
 * @typedef {import('./csplat-worker.mjs').Request} Request
 */

const IDLE_MS = 5000; // a worker without work ends after so long: to start one takes as long as to decode 100,000 splats

/** A worker that answers requests, one after the other. */
class Correspondent {
  /** @param {any} worker of a browser, or of Node */
  constructor(worker) {
    this.worker = worker;
    /** @type {(answer: Answer | null) => void} */
    this.answered = () => {};
    const message = (/** @type {Answer} */ answer) => this.answered(answer);
    const failed = (/** @type {Event | Error} */ event) => {
      if ('preventDefault' in event) event.preventDefault(); // the console needs no line: decode goes on without it
      this.answered(null);
    };
    if (worker.addEventListener) {
      worker.addEventListener('message', (/** @type {MessageEvent} */ { data }) => message(data));
      worker.addEventListener('error', failed);
    } else {
      worker.on('message', message);
      worker.on('error', failed);
    }
  }

  /**
   * @param {Request} request
   * @param {ArrayBuffer[]} transfer
   * @returns {Promise<Answer | null>} null where the worker has failed, or never started
   */
  ask(request, transfer) {
    return new Promise((resolve) => {
      this.answered = resolve;
      this.worker.postMessage(request, transfer);
    });
  }
}

/** @type {Map<Correspondent, ReturnType<typeof setTimeout>>} workers without work, and what will end them */
const idle = new Map();

/** @returns {Promise<Correspondent>} */
async function take() {
  const [known] = idle;
  if (known === undefined) return start();
  clearTimeout(known[1]);
  idle.delete(known[0]);
  known[0].worker.ref?.();
  return known[0];
}

/** @param {Correspondent} worker */
function giveBack(worker) {
  worker.worker.unref?.(); // Node may end
  const end = () => {
    idle.delete(worker);
    worker.worker.terminate();
  };
  const timer = setTimeout(end, IDLE_MS);
  /** @type {any} */ (timer).unref?.();
  idle.set(worker, timer);
}

/** @returns {Promise<Correspondent>} */
async function start() {
  const { process } = /** @type {{process?: {versions?: {node?: string}}}} */ (globalThis);
  if (process?.versions?.node === undefined) {
    return new Correspondent(new Worker(new URL('./csplat-worker.mjs', import.meta.url), { type: 'module' }));
  }
  const [name, side] = ['node:worker_threads', './csplat-worker.mjs']; // so that bundlers for browsers do not look for them
  const threads = await import(/* webpackIgnore: true */ /* @vite-ignore */ name);
  return new Correspondent(new threads.Worker(new URL(side, import.meta.url)));
}

/**
 * Decode tiles in workers.
 *
 * @param {CsplatReader} reader
 * @param {TileRecord[]} tiles
 * @param {Assembly} assembly
 * @param {number} count workers at most
 * @param {(splats: number) => void} done called with those of each tile when they are there
 * @param {AbortSignal} [signal]
 * @returns {Promise<number>} workers that took part; 0 where the platform starts none, or one has failed: then nothing counts
 */
export async function fillByWorkers(reader, tiles, assembly, count, done, signal) {
  const { wanted } = assembly;
  /** @type {Map<TileRecord, number>} */
  const places = new Map();
  let first = 0;
  for (const tile of tiles) {
    places.set(tile, first);
    first += tile.splatCount;
  }
  const waiting = [...tiles].reverse();
  /** @type {Correspondent[]} */
  const workers = [];
  const work = async () => {
    const worker = await take();
    workers.push(worker);
    const opening = { open: await reader.partsOf(wanted), wanted };
    if ((await worker.ask(opening, [])) === null) return false;
    for (let tile = waiting.pop(); tile !== undefined; tile = waiting.pop()) {
      signal?.throwIfAborted();
      const parts = await reader.partsOf(wanted, tile);
      const answer = await worker.ask({ tile: tile.index, parts }, [...parts.values()].map(({ buffer }) => buffer));
      if (!answer?.fields) return false;
      for (const offset of parts.keys()) reader.checked.add(offset);
      assembly.copy(answer.fields, places.get(tile) ?? 0);
      done(tile.splatCount);
    }
    return true;
  };
  try {
    const outcomes = await Promise.all(Array.from({ length: Math.min(count, tiles.length) }, work));
    const worked = outcomes.every(Boolean);
    for (const worker of workers.splice(0, worked ? workers.length : 0)) giveBack(worker);
    return worked ? outcomes.length : 0;
  } catch {
    signal?.throwIfAborted();
    return 0;
  } finally {
    for (const { worker } of workers) worker.terminate();
  }
}
