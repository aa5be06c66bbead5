// SPDX-License-Identifier: Apache-2.0
// The viewer's worker: reads and packs what the view requires and sorts the visible splats. engine.mjs sends it requests.

import { CsplatReader } from '../../codec/js/decoder.mjs';
import { STEP_MS, ShownTiles } from '../../codec/js/levels/shown_tiles.mjs';
import { cull } from './cull.mjs';
import { pageFunctions } from './fetch_port.mjs';
import { withMetadata } from './meta_writer.mjs';
import { DepthSorter } from './sort.mjs';
import { TexelStream } from './texel_stream.mjs';

/**
 * @typedef {import('./cull.mjs').CullTile} CullTile
 * @typedef {import('./types.d.ts').ErrorReport} ErrorReport
 * @typedef {import('./types.d.ts').View} View
 *
 * Messages to the worker: `scene` counts the calls of `open`, `id` the cameras.
 *
 * @typedef {{type: 'open', scene: number, source: string | Blob | ArrayBuffer, sort: boolean,
 *      aims: import('../../codec/js/levels/tile_stream.mjs').Aims, fetching: Fetching}
 *   | {type: 'view', id: number, view: View}
 *   | {type: 'recycle', order: Uint32Array<ArrayBuffer>}
 *   | {type: 'placed', scene: number}
 *   | {type: 'pause', isPaused: boolean}
 *   | {type: 'rewrite', changes: import('./types.d.ts').MetadataChanges, port: MessagePort}
 *   | {type: 'stop'}} Request
 *
 * How to fetch: options of the engine that can be sent, and whether the page has functions for the others.
 *
 * @typedef {Pick<import('./types.d.ts').FetchOptions, 'request' | 'retries' | 'retryMs' | 'timeoutMs'>
 *   & {hasFetch: boolean, hasRenew: boolean}} Fetching
 *
 * The answer to `rewrite`, sent to its port.
 *
 * @typedef {{bytes?: Uint8Array<ArrayBuffer>, error?: ErrorReport}} Rewritten
 *
 * Messages of the worker; all carry `scene`.
 *
 * @typedef {{scene: number} & (
 *   | {type: 'header', opened: import('./texel_stream.mjs').Opened}
 *   | {type: 'progress', progress: import('./types.d.ts').Progress, decodeMs: number}
 *   | {type: 'geometry', tile: number, slot: number, texels: import('./texels.mjs').GeometryTexels,
 *      samples: import('./texel_stream.mjs').Samples}
 *   | {type: 'evict', tile: number}
 *   | {type: 'table', codebook: number, layer: number, rows: import('./texels.mjs').Rows}
 *   | {type: 'band', tile: number, layer: number, band: import('./texels.mjs').BandTexels}
 *   | {type: 'order', id: number, isComplete: boolean, isWhole: boolean, shares: Map<number, number> | null,
 *      order: Uint32Array<ArrayBuffer>, count: number, cullMs: number, sortMs: number}
 *   | {type: 'done'}
 *   | {type: 'ask', question: import('./fetch_port.mjs').Question, port: MessagePort}
 *   | {type: 'error', error: ErrorReport})} Reply
 *
 * `order`: `isWhole` if it covers the scene, at any level, `isComplete` if everything that the view requires is drawn, and
 * nothing fades; `shares` of the tiles that are drawn, null if they have not changed. `done`: everything that a view requires was
 * here for the first time.
 */

/** Parts on their way to the page beyond which no others are decoded. */
const UNPLACED = 8;

/** Minimum interval between sorts while tiles arrive. */
const SORT_INTERVAL_MS = 100;

/**
 * The part of DedicatedWorkerGlobalScope that is used.
 *
 * @typedef {{onmessage: ((event: {data: Request}) => void) | null, postMessage: (message: Reply, transfer?: Transferable[]) => void}} Scope
 */

/** State of a worker: the open scene and the camera. */
class Job {
  /** @param {Scope} scope */
  constructor(scope) {
    this.scope = scope;
    this.scene = 0;
    /** @type {string | Blob | ArrayBuffer} */
    this.source = new ArrayBuffer(0);
    /** @type {import('./types.d.ts').FetchOptions} */
    this.fetching = {};
    this.abort = new AbortController();
    /** @type {TexelStream | null} */
    this.stream = null;
    /** Tiles that are drawn. @type {CullTile[]} */
    this.drawn = [];
    /** @type {ShownTiles | null} */
    this.shown = null;
    this.isDone = false; // everything that a view requires was here once
    this.isPaused = false;
    this.unplaced = 0; // parts that the page has not received
    this.resume = () => {};
    /** @type {{id: number, view: View} | null} */
    this.camera = null;
    this.sorts = true;
    this.sorter = new DepthSorter();
    this.visible = { depths: new Float32Array(0), slots: new Uint32Array(0), count: 0 };
    /** @type {Uint32Array<ArrayBuffer>[]} */
    this.spare = [];
    this.isWaiting = false; // a sort is scheduled
    this.sortedAt = -Infinity;
  }

  /** @param {Request} request */
  take(request) {
    if (request.type === 'open') this.open(request);
    else if (request.type === 'view') {
      this.camera = request;
      this.sortSoon(0);
    } else if (request.type === 'pause') {
      this.isPaused = request.isPaused;
      this.stream?.tiles.pause(this.isPaused);
    } else if (request.type === 'rewrite') this.rewrite(request.changes, request.port);
    else if (request.type === 'stop') this.reset();
    else if (request.type === 'placed') {
      if (request.scene === this.scene && --this.unplaced < UNPLACED) this.resume();
    } else if (this.spare.length < 2) this.spare.push(request.order);
  }

  /** Close the scene. */
  reset() {
    this.scene = 0;
    this.abort.abort();
    this.abort = new AbortController();
    this.stream = null;
    this.drawn = [];
    this.shown = null;
    this.isDone = false;
    this.unplaced = 0;
    this.spare = [];
    this.visible = { depths: new Float32Array(0), slots: new Uint32Array(0), count: 0 };
    this.sorter = new DepthSorter();
  }

  /** @param {Request & {type: 'open'}} request `sort`: the renderer needs an order */
  async open({ scene, source, sort, aims, fetching: { hasFetch, hasRenew, ...fetching } }) {
    this.reset();
    this.scene = scene;
    this.sorts = sort;
    this.source = source;
    const { abort } = this;
    const { signal } = abort;
    /** @type {(message: any, transfer?: Transferable[]) => void} */
    const post = (message, transfer = []) => {
      if (!signal.aborted) this.scope.postMessage({ ...message, scene }, transfer);
    };
    const { fetch, renew } = pageFunctions((question, port) => post({ type: 'ask', question, port }, [port]));
    this.fetching = { ...fetching, ...(hasFetch && { fetch }), ...(hasRenew && { renew }) };
    try {
      const stream = await TexelStream.open(source, this.sink(post), aims, signal, this.fetching);
      this.stream = stream;
      this.shown = new ShownTiles(stream.tiles);
      stream.tiles.pause(this.isPaused);
      stream.tiles.setView(this.camera?.view ?? null);
      await stream.tiles.failed;
    } catch (error) {
      post({ type: 'error', error: reportOf(error, true) });
      abort.abort(); // ends what is left of the reading
    }
  }

  /** Resolves when the page has received most of what was sent, after another part. */
  async room() {
    if (++this.unplaced >= UNPLACED) await new Promise((/** @type {(value: void) => void} */ go) => (this.resume = go));
  }

  /**
   * Send the scene's file with other metadata.
   *
   * @param {import('./types.d.ts').MetadataChanges} changes
   * @param {MessagePort} port
   */
  async rewrite(changes, port) {
    try {
      const bytes = await withMetadata(await whole(this.source, this.fetching), changes);
      port.postMessage({ bytes }, [bytes.buffer]);
    } catch (error) {
      port.postMessage({ error: reportOf(error, true) });
    }
  }

  /**
   * @param {(message: any, transfer?: Transferable[]) => void} post
   * @returns {import('./texel_stream.mjs').TexelSink}
   */
  sink(post) {
    return {
      header: (opened) => post({ type: 'header', opened }),
      geometry: (tile, texels, { slot }, samples) => {
        const transfer = [texels.first.buffer, samples.points.buffer, samples.weights.buffer];
        if (texels.more) transfer.push(texels.more.buffer);
        post({ type: 'geometry', tile, slot, texels, samples }, transfer);
        this.sortSoon(SORT_INTERVAL_MS);
        return this.room();
      },
      evict: (tile) => {
        if (this.drawn.some(({ index }) => index === tile)) this.sort(); // its slots are given to another
        post({ type: 'evict', tile });
      },
      table: (codebook, layer, rows) => post({ type: 'table', codebook, layer, rows }, [rows.texels.buffer]),
      band: (tile, layer, band) => {
        const arrays = [band.rows?.texels, band.codebook?.index].filter((array) => array !== undefined);
        post(
          { type: 'band', tile, layer, band },
          arrays.map(({ buffer }) => buffer),
        );
        return this.room();
      },
      progress: ({ decodeMs, ...progress }) => post({ type: 'progress', progress, decodeMs }),
      warn: (error) => post({ type: 'error', error: reportOf(error, false) }),
      complete: () => {
        this.sort(); // includes the last tiles in the order before `done` is sent
        if (!this.isDone) post({ type: 'done' });
        this.isDone = true;
      },
    };
  }

  /**
   * Sort after the messages that are already queued, so that only the latest camera is sorted for.
   *
   * @param {number} interval minimum time since the last sort, milliseconds
   */
  sortSoon(interval) {
    if (this.isWaiting) return;
    this.isWaiting = true;
    const wait = Math.max(0, this.sortedAt + interval - performance.now());
    setTimeout(() => {
      this.isWaiting = false;
      this.sort();
    }, wait);
  }

  sort() {
    const { scene, stream, shown, camera, visible } = this;
    if (camera === null || stream === null || shown === null) return;
    const { id, view } = camera;
    const { here, tiles } = stream;
    const { shares: before } = shown;
    if (tiles.view !== view) tiles.setView(view);
    shown.update((tile) => here.has(tile), performance.now());
    const { isFading, isWhole, splatCount } = shown;
    const shares = shown.shares === before ? null : shown.shares;
    if (shares) this.drawn = Array.from(shares.keys(), (tile) => /** @type {CullTile} */ (here.get(tile)));
    const isComplete = tiles.isComplete && !isFading;
    const reply = /** @type {const} */ ({ type: 'order', scene, id, isComplete, isWhole, shares });
    this.sortedAt = performance.now();
    if (isFading) this.sortSoon(STEP_MS);
    if (!this.sorts) {
      this.scope.postMessage({ ...reply, order: new Uint32Array(0), count: splatCount, cullMs: 0, sortMs: 0 });
      return;
    }
    if (visible.depths.length < splatCount) {
      visible.depths = new Float32Array(splatCount);
      visible.slots = new Uint32Array(splatCount);
    }
    const start = performance.now();
    cull(this.drawn, view, visible);
    const culled = performance.now();
    let order = this.spare.pop();
    if (order === undefined || order.length < visible.count) order = new Uint32Array(splatCount);
    this.sorter.sort(visible.depths, visible.slots, visible.count, order);
    this.sortedAt = performance.now();
    const times = { cullMs: culled - start, sortMs: this.sortedAt - culled };
    this.scope.postMessage({ ...reply, order, count: visible.count, ...times }, [order.buffer]);
  }
}

/**
 * Return all bytes of a file.
 *
 * @param {string | Blob | ArrayBuffer} source
 * @param {import('./types.d.ts').FetchOptions} fetching
 */
async function whole(source, fetching) {
  if (source instanceof ArrayBuffer) return source;
  if (source instanceof Blob) return source.arrayBuffer();
  const reader = /** @type {any} */ (await CsplatReader.open(source, fetching));
  const bytes = await reader.source.read(0, reader.header.fileSize);
  return bytes.slice().buffer;
}

/**
 * @param {unknown} error
 * @param {boolean} fatal whether the scene is given up
 * @returns {ErrorReport}
 */
function reportOf(error, fatal) {
  const problem = /** @type {any} */ (error instanceof Error ? error : { message: error });
  const { code, message, offset, clause, reason, status } = problem;
  const isOurs = typeof code === 'string';
  return {
    code: isOurs ? code : 'E_INPUT',
    message: String(message),
    ...(offset !== null && offset !== undefined && { offset }),
    ...(clause && { clause }),
    ...(reason && { reason }),
    ...(status && { status }),
    fatal,
  };
}

const scope = /** @type {Scope} */ (/** @type {unknown} */ (globalThis));
const job = new Job(scope);
scope.onmessage = (/** @type {{data: Request}} */ { data }) => job.take(data);
