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
const START_MS = 15000; // a worker that has not answered its first request by then has not started

/** Workers may start: none has failed before its first answer. Its script is then missing or forbidden. */
let mayStart = true;

/** A worker that answers requests one at a time. After it has failed, at whatever moment, each answer is null. */
class Correspondent {
  /** @param {any} worker a worker of the browser or of Node */
  constructor(worker) {
    this.worker = worker;
    this.hasAnswered = this.hasFailed = false;
    /** @type {(answer: Answer | null) => void} */
    this.answered = () => {};
    const listen = (/** @type {string} */ type, /** @type {(event: any) => void} */ listener) =>
      worker.addEventListener ? worker.addEventListener(type, listener) : worker.on(type, listener);
    listen('message', (event) => {
      this.hasAnswered = true;
      this.answered(worker.addEventListener ? event.data : event);
    });
    for (const type of ['error', 'messageerror', 'exit']) {
      listen(type, (event) => {
        event.preventDefault?.(); // not logged: decoding continues without it
        this.fail();
      });
    }
  }

  fail() {
    if (this.hasFailed) return;
    this.hasFailed = true;
    mayStart &&= this.hasAnswered;
    clearTimeout(idle.get(this));
    idle.delete(this);
    this.answered(null);
    this.end();
  }

  end() {
    this.hasFailed = true;
    this.worker.terminate();
  }

  /**
   * @param {Request} request its parts are copied
   * @returns {Promise<Answer | null>} null if the worker has failed or never started
   */
  async ask(request) {
    if (this.hasFailed) return null;
    const copy = (/** @type {import('./csplat-worker.mjs').Parts} */ parts) =>
      new Map([...parts].map(([offset, bytes]) => [offset, bytes.slice()])); // in buffers of their own, to transfer
    const sent =
      'open' in request ? { ...request, open: copy(request.open) } : { ...request, parts: copy(request.parts) };
    const start = this.hasAnswered ? undefined : setTimeout(() => this.fail(), START_MS);
    try {
      return await new Promise((resolve) => {
        this.answered = resolve;
        this.worker.postMessage(sent, buffersOf(sent));
      });
    } catch {
      return null; // decoding in this thread reports the error
    } finally {
      clearTimeout(start);
    }
  }
}

/** @type {Map<Correspondent, ReturnType<typeof setTimeout>>} idle workers, and the timers that end them */
const idle = new Map();

/** @returns {Promise<Correspondent | null>} null if none starts */
async function take() {
  const [known] = idle;
  if (known === undefined) {
    if (!mayStart) return null;
    return start().catch(() => {
      mayStart = false;
      return null;
    });
  }
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
    worker.end();
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
  const opened = opening === null || (await worker.ask({ open: opening, wanted })) !== null;
  const answer = opened ? await worker.ask({ tile: tile.index, parts, spare }) : null;
  if (answer?.fields) for (const offset of parts.keys()) reader.checked.add(offset);
  else reader.keep(parts);
  return { worker, tile, fields: answer?.fields };
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
      const worker = await take();
      if (worker === null) waiting.push(tile);
      else start(worker, tile, true);
    }
    while (jobs.size) {
      const { worker, tile, fields } = await abortable(Promise.race(jobs.values()), signal);
      signal?.throwIfAborted();
      if (fields === undefined) {
        worker.end();
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
    for (const worker of jobs.keys()) worker.end();
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
    const sent = new Map([...parts].filter(([at]) => !one?.known.has(at)));
    const answer = await one?.worker.ask({ tile: tile.index, layer, parts: sent });
    const chunks = tile.layers.map(({ offset }) => offset);
    if (!one || !answer?.fields) {
      one?.worker.end();
      reader.keep(new Map([...parts].filter(([offset]) => chunks.includes(offset))));
      return reader.readLayer(tile.index, layer, { form: 'packed', signal }); // reports the error
    }
    for (const offset of sent.keys()) {
      reader.checked.add(offset);
      if (!chunks.includes(offset)) one.known.add(offset);
    }
    restore(answer.fields, this.tables, layer - 1);
    if (this.isClosed) giveBack(one.worker);
    else this.free.push(one);
    return answer.fields;
  }

  async #start() {
    const worker = await take();
    const answer = await worker?.ask({ open: this.reader.opening, wanted: { shDegree: 0, extra: false } });
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
