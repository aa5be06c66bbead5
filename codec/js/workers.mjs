// SPDX-License-Identifier: Apache-2.0
// Decodes tiles in workers. csplat-worker.mjs runs in the worker and does not import this module: bundlers would not end.

import { buffersOf } from './arrays.mjs';
import { abortable } from './transport.mjs';

/**
 * @typedef {import('./decoder.d.ts').TileRecord} TileRecord
 * @typedef {import('./reader.mjs').Reader} Reader
 * @typedef {import('./csplat-worker.mjs').Answer} Answer
 * @typedef {import('./csplat-worker.mjs').Request} Request
 * @typedef {import('./csplat-worker.mjs').Wanted} Wanted
 * @typedef {import('./decoder.d.ts').PackedColumns} PackedColumns
 */

const IDLE_MS = 5000; // an idle worker ends after this; starting one takes about as long as decoding 100,000 splats

/** A worker that answers requests one at a time. */
class Correspondent {
  /** @param {any} worker a worker of the browser or of Node */
  constructor(worker) {
    this.worker = worker;
    /** @type {(answer: Answer | null) => void} */
    this.answered = () => {};
    const message = (/** @type {Answer} */ answer) => this.answered(answer);
    const failed = (/** @type {Event | Error} */ event) => {
      if ('preventDefault' in event) event.preventDefault(); // not logged: decoding continues without it
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
   * @returns {Promise<Answer | null>} null if the worker has failed or never started
   */
  ask(request) {
    return new Promise((resolve) => {
      this.answered = resolve;
      this.worker.postMessage(request, buffersOf(request));
    });
  }
}

/** @type {Map<Correspondent, ReturnType<typeof setTimeout>>} idle workers, and the timers that end them */
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
  worker.worker.unref?.(); // Node may exit
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
  const [name, side, here] = ['node:worker_threads', './csplat-worker.mjs', import.meta.url]; // hides them from bundlers
  const threads = await import(/* webpackIgnore: true */ /* @vite-ignore */ name);
  return new Correspondent(new threads.Worker(new URL(side, here)));
}

/**
 * Decode a tile in a worker. If it refuses the tile, or has failed, the result has no fields.
 *
 * @param {Reader} reader
 * @param {Correspondent} worker
 * @param {TileRecord} tile
 * @param {Wanted} wanted
 * @param {boolean} isFirst
 * @param {any} spare fields of another tile, whose memory the worker may reuse
 * @param {AbortSignal} [signal]
 * @returns {Promise<{worker: Correspondent, tile: TileRecord, fields?: any}>} rejects if the tile cannot be fetched
 */
async function decodeTile(reader, worker, tile, wanted, isFirst, spare, signal) {
  const opening = isFirst ? await reader.partsOf(wanted) : null;
  const parts = await reader.partsOf(wanted, tile, signal);
  try {
    if (opening && (await worker.ask({ open: opening, wanted })) === null) return { worker, tile };
    const offsets = [...parts.keys()];
    const answer = await worker.ask({ tile: tile.index, parts, spare });
    if (answer?.fields) for (const offset of offsets) reader.checked.add(offset);
    return { worker, tile, fields: answer?.fields };
  } catch {
    return { worker, tile }; // decoding in this thread reports the error
  }
}

/**
 * Decode tiles in workers.
 *
 * @param {Reader} reader
 * @param {TileRecord[]} waiting tiles in reverse order; afterwards, the tiles that no worker could decode
 * @param {Wanted} wanted
 * @param {number} count maximum number of workers
 * @param {AbortSignal} [signal]
 * @param {any[]} [spares] fields that the caller has copied and no longer needs
 * @returns {AsyncGenerator<{tile: TileRecord, fields: any, worker: object}, void>} in the order of completion
 */
export async function* byWorkers(reader, waiting, wanted, count, signal, spares = []) {
  /** @type {Map<Correspondent, ReturnType<typeof decodeTile>>} */
  const jobs = new Map();
  const start = (/** @type {Correspondent} */ worker, /** @type {TileRecord} */ tile, isFirst = false) => {
    const job = decodeTile(reader, worker, tile, wanted, isFirst, isFirst ? undefined : spares.pop(), signal);
    job.catch(() => {}); // it is reported below, if nothing is before
    jobs.set(worker, job);
  };
  /** @type {Map<string, PackedColumns>} */
  const tables = new Map();
  try {
    for (const tile of waiting.splice(Math.max(0, waiting.length - count)).reverse()) {
      const worker = await take().catch(() => null);
      if (worker === null) waiting.push(tile);
      else start(worker, tile, true);
    }
    while (jobs.size) {
      const { worker, tile, fields } = await abortable(Promise.race(jobs.values()), signal);
      signal?.throwIfAborted();
      if (fields === undefined) {
        worker.worker.terminate();
        jobs.delete(worker);
        waiting.push(tile);
        continue;
      }
      const next = waiting.pop();
      if (next === undefined) {
        jobs.delete(worker);
        giveBack(worker);
      } else {
        start(worker, next);
      }
      restore(fields, tables);
      yield { tile, fields, worker };
    }
  } finally {
    for (const { worker } of jobs.keys()) worker.terminate();
  }
}

/** Workers that decode layers of one file. */
export class LayerWorkers {
  /** @param {Reader} reader */
  constructor(reader) {
    this.reader = reader;
    /** Idle workers, each with the offsets of the codebooks that it has. @type {{worker: Correspondent, known: Set<number>}[]} */
    this.free = [];
    /** @type {Map<string, PackedColumns>} */
    this.tables = new Map();
    this.isClosed = false;
  }

  /**
   * Read a layer as `readLayer` does in form 'packed', in an idle worker or a new one.
   *
   * @param {TileRecord} tile
   * @param {number} layer one that the tile has
   * @param {AbortSignal} [signal]
   * @returns {Promise<any>}
   */
  async read(tile, layer, signal) {
    const { reader } = this;
    const place = tile.layers.find((one) => one.layer === layer);
    const parts = place && !reader.inflates ? await reader.layerParts(tile, place, signal) : new Map();
    signal?.throwIfAborted();
    const one = parts.size > 0 ? (this.free.pop() ?? (await this.#start())) : null;
    const sent = new Map([...parts].filter(([at]) => !one?.known.has(at)).map(([at, bytes]) => [at, bytes.slice()]));
    const offsets = [...sent.keys()];
    const answer = await one?.worker.ask({ tile: tile.index, layer, parts: sent }).catch(() => null);
    if (!answer?.fields) one?.worker.worker.terminate();
    if (!one || !answer?.fields) return reader.readLayer(tile.index, layer, { form: 'packed', signal }); // reports the error
    const chunks = tile.layers.map(({ offset }) => offset);
    for (const offset of offsets) {
      reader.checked.add(offset);
      if (!chunks.includes(offset)) one.known.add(offset);
    }
    restore(answer.fields, this.tables, layer - 1);
    if (this.isClosed) giveBack(one.worker);
    else this.free.push(one);
    return answer.fields;
  }

  async #start() {
    const worker = await take().catch(() => null);
    const opening = new Map([...this.reader.opening].map(([offset, bytes]) => [offset, bytes.slice()]));
    const wanted = { shDegree: 0, extra: false };
    const answer = await worker?.ask({ open: opening, wanted }).catch(() => null);
    return worker && answer ? { worker, known: /** @type {Set<number>} */ (new Set()) } : null;
  }

  /** Let the workers end. */
  close() {
    this.isClosed = true;
    for (const { worker } of this.free.splice(0)) giveBack(worker);
  }
}

/**
 * Restore what messages do not carry: the prototype of the extra columns, and the identity of codebook tables, which a
 * worker sends once and which are the same objects for all tiles.
 *
 * @param {any} fields changed
 * @param {Map<string, PackedColumns>} tables
 * @param {number} [first] band of the first of the fields
 */
function restore(fields, tables, first = 0) {
  if (fields.extra) fields.extra = Object.assign(Object.create(null), fields.extra);
  for (const [i, packed] of [fields.sh ?? []].flat().entries()) {
    if (!packed?.lookup) continue;
    const key = `${packed.lookup.codebook}.${first + i}`;
    if (!tables.has(key)) tables.set(key, packed.lookup.table);
    packed.lookup.table = tables.get(key);
  }
}
