// The viewer's worker: reads and packs the file and sorts the visible splats. engine.mjs sends it requests.

import { cull } from './cull.mjs';
import { load } from './loader.mjs';
import { withUp } from './meta_writer.mjs';
import { DepthSorter } from './sort.mjs';

/**
 * @typedef {import('./cull.mjs').CullTile} CullTile
 * @typedef {import('./types.d.ts').ErrorReport} ErrorReport
 * @typedef {import('./types.d.ts').View} View
 *
 * Messages to the worker: `scene` counts the calls of `open`, `id` the cameras.
 *
 * @typedef {{type: 'open', scene: number, source: string | Blob | ArrayBuffer, sort: boolean}
 *   | {type: 'view', id: number, view: View}
 *   | {type: 'recycle', order: Uint32Array<ArrayBuffer>}
 *   | {type: 'rewrite', up: number[], port: MessagePort}
 *   | {type: 'stop'}} Request
 *
 * The answer to `rewrite`, sent to its port.
 *
 * @typedef {{bytes?: Uint8Array<ArrayBuffer>, error?: ErrorReport}} Rewritten
 *
 * Messages of the worker; all carry `scene`.
 *
 * @typedef {{scene: number} & (
 *   | {type: 'header', header: import('./types.d.ts').Header, description: import('./types.d.ts').Description}
 *   | {type: 'progress', progress: import('./types.d.ts').Progress, decodeMs: number}
 *   | {type: 'geometry', tile: number, texels: import('./texels.mjs').GeometryTexels, samples: import('./loader.mjs').Samples}
 *   | {type: 'table', codebook: number, layer: number, rows: import('./texels.mjs').Rows}
 *   | {type: 'band', tile: number, layer: number, band: import('./texels.mjs').BandTexels}
 *   | {type: 'order', id: number, tiles: number, order: Uint32Array<ArrayBuffer>, count: number, cullMs: number, sortMs: number}
 *   | {type: 'done'}
 *   | {type: 'error', error: ErrorReport})} Reply
 */

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
    this.abort = new AbortController();
    /** @type {CullTile[]} */
    this.tiles = [];
    this.splatCount = 0; // number of splats in `tiles`
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
    if (request.type === 'open') this.open(request.scene, request.source, request.sort);
    else if (request.type === 'view') {
      this.camera = request;
      this.sortSoon(0);
    } else if (request.type === 'rewrite') this.rewrite(request.up, request.port);
    else if (request.type === 'stop') this.reset();
    else if (this.spare.length < 2) this.spare.push(request.order);
  }

  /** Close the scene. */
  reset() {
    this.scene = 0;
    this.abort.abort();
    this.abort = new AbortController();
    this.tiles = [];
    this.splatCount = 0;
    this.spare = [];
    this.visible = { depths: new Float32Array(0), slots: new Uint32Array(0), count: 0 };
    this.sorter = new DepthSorter();
  }

  /**
   * @param {number} scene
   * @param {string | Blob | ArrayBuffer} source
   * @param {boolean} sorts whether the renderer needs an order
   */
  async open(scene, source, sorts) {
    this.reset();
    this.scene = scene;
    this.sorts = sorts;
    this.source = source;
    const { signal } = this.abort;
    /** @type {(message: any, transfer?: Transferable[]) => void} */
    const post = (message, transfer = []) => {
      if (!signal.aborted) this.scope.postMessage({ ...message, scene }, transfer);
    };
    try {
      await load(source, this.sink(post), signal);
      this.sort(); // includes the last tiles in the order before `done` is sent
      post({ type: 'done' });
    } catch (error) {
      post({ type: 'error', error: reportOf(error) });
    }
  }

  /**
   * Send the scene's file with another up direction.
   *
   * @param {number[]} up
   * @param {MessagePort} port
   */
  async rewrite(up, port) {
    try {
      const bytes = await withUp(await whole(this.source), up);
      port.postMessage({ bytes }, [bytes.buffer]);
    } catch (error) {
      port.postMessage({ error: reportOf(error) });
    }
  }

  /**
   * @param {(message: any, transfer?: Transferable[]) => void} post
   * @returns {import('./loader.mjs').Sink}
   */
  sink(post) {
    return {
      header: (header, description) => post({ type: 'header', header, description }),
      geometry: (tile, texels, culled, samples) => {
        this.tiles.push(culled);
        this.tiles.sort((a, b) => a.slot - b.slot); // keeps equal depths in the order of the file
        this.splatCount += culled.count;
        const transfer = [texels.first.buffer, samples.points.buffer, samples.weights.buffer];
        if (texels.more) transfer.push(texels.more.buffer);
        post({ type: 'geometry', tile, texels, samples }, transfer);
        this.sortSoon(SORT_INTERVAL_MS);
      },
      table: (codebook, layer, rows) => post({ type: 'table', codebook, layer, rows }, [rows.texels.buffer]),
      band: (tile, layer, band) => {
        const arrays = [band.rows?.texels, band.codebook?.index].filter((array) => array !== undefined);
        post(
          { type: 'band', tile, layer, band },
          arrays.map(({ buffer }) => buffer),
        );
      },
      progress: ({ decodeMs, ...progress }) => post({ type: 'progress', progress, decodeMs }),
      view: () => this.camera?.view ?? null,
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
    if (this.camera === null || this.scene === 0) return;
    const { id, view } = this.camera;
    const { splatCount, visible } = this;
    if (!this.sorts) {
      const { scene, tiles } = this;
      const nothing = { order: new Uint32Array(0), count: splatCount, cullMs: 0, sortMs: 0 };
      this.scope.postMessage({ type: 'order', scene, id, tiles: tiles.length, ...nothing });
      return;
    }
    if (visible.depths.length < splatCount) {
      visible.depths = new Float32Array(splatCount);
      visible.slots = new Uint32Array(splatCount);
    }
    const start = performance.now();
    cull(this.tiles, view, visible);
    const culled = performance.now();
    let order = this.spare.pop();
    if (order === undefined || order.length < visible.count) order = new Uint32Array(splatCount);
    this.sorter.sort(visible.depths, visible.slots, visible.count, order);
    this.sortedAt = performance.now();
    const times = { cullMs: culled - start, sortMs: this.sortedAt - culled };
    const { scene, tiles } = this;
    this.scope.postMessage({ type: 'order', scene, id, tiles: tiles.length, order, count: visible.count, ...times }, [
      order.buffer,
    ]);
  }
}

/**
 * Return all bytes of a file.
 *
 * @param {string | Blob | ArrayBuffer} source
 */
async function whole(source) {
  if (source instanceof ArrayBuffer) return source;
  if (source instanceof Blob) return source.arrayBuffer();
  const response = await fetch(source);
  if (!response.ok) throw new Error(`${source}: HTTP status ${response.status}`);
  return response.arrayBuffer();
}

/**
 * @param {unknown} error
 * @returns {ErrorReport}
 */
function reportOf(error) {
  const { code, message, offset, clause } = /** @type {any} */ (error instanceof Error ? error : { message: error });
  const isOurs = typeof code === 'string';
  return {
    code: isOurs ? code : 'E_INPUT',
    message: String(message),
    ...(offset !== null && offset !== undefined && { offset }),
    ...(clause && { clause }),
    fatal: true,
  };
}

const scope = /** @type {Scope} */ (/** @type {unknown} */ (globalThis));
const job = new Job(scope);
scope.onmessage = (/** @type {{data: Request}} */ { data }) => job.take(data);
