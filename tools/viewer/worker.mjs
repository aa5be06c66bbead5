// The viewer's worker: reads and packs the file and sorts the visible splats. engine.mjs sends it requests.

import { cull } from './cull.mjs';
import { chooseTiles } from './level_cut.mjs';
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
 * @typedef {{type: 'open', scene: number, source: string | Blob | ArrayBuffer, sort: boolean, budget: number}
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
 *   | {type: 'header', header: import('./types.d.ts').Header, description: import('./types.d.ts').Description,
 *      roots: number}
 *   | {type: 'cut', tiles: Uint32Array<ArrayBuffer>}
 *   | {type: 'progress', progress: import('./types.d.ts').Progress, decodeMs: number}
 *   | {type: 'geometry', tile: number, texels: import('./texels.mjs').GeometryTexels, samples: import('./loader.mjs').Samples}
 *   | {type: 'table', codebook: number, layer: number, rows: import('./texels.mjs').Rows}
 *   | {type: 'band', tile: number, layer: number, band: import('./texels.mjs').BandTexels}
 *   | {type: 'order', id: number, tiles: number, isWhole: boolean, order: Uint32Array<ArrayBuffer>, count: number,
 *      cullMs: number, sortMs: number}
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
    /** @type {import('./types.d.ts').Header | null} */
    this.header = null;
    /** Nodes of the levels of detail. @type {import('./types.d.ts').TreeNode[]} */
    this.nodes = [];
    /** Tiles that are here. @type {CullTile[]} */
    this.tiles = [];
    /** Tiles that are drawn, of `tiles`. @type {CullTile[]} */
    this.drawn = [];
    this.isWhole = false; // `drawn` covers the whole scene
    this.splatCount = 0; // number of splats in `drawn`
    /** @type {{id: number, view: View} | null} */
    this.camera = null;
    this.sorts = true;
    this.budget = Infinity; // splats
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
    } else if (request.type === 'rewrite') this.rewrite(request.up, request.port);
    else if (request.type === 'stop') this.reset();
    else if (this.spare.length < 2) this.spare.push(request.order);
  }

  /** Close the scene. */
  reset() {
    this.scene = 0;
    this.abort.abort();
    this.abort = new AbortController();
    this.header = null;
    this.nodes = [];
    this.tiles = this.drawn = [];
    this.isWhole = false;
    this.splatCount = 0;
    this.spare = [];
    this.visible = { depths: new Float32Array(0), slots: new Uint32Array(0), count: 0 };
    this.sorter = new DepthSorter();
  }

  /** @param {Request & {type: 'open'}} request `sort`: the renderer needs an order; `budget` of splats */
  async open({ scene, source, sort, budget }) {
    this.reset();
    this.scene = scene;
    this.sorts = sort;
    this.budget = budget;
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
      header: (header, description, nodes, roots) => {
        this.header = header;
        this.nodes = nodes;
        post({ type: 'header', header, description, roots });
        if (nodes.length > 0 && !this.sorts) post({ type: 'cut', tiles: new Uint32Array(0) });
        this.choose();
      },
      geometry: (tile, texels, culled, samples) => {
        this.tiles.push(culled);
        this.tiles.sort((a, b) => a.slot - b.slot); // keeps equal depths in the order of the file
        const transfer = [texels.first.buffer, samples.points.buffer, samples.weights.buffer];
        if (texels.more) transfer.push(texels.more.buffer);
        post({ type: 'geometry', tile, texels, samples }, transfer);
        this.choose();
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

  /** Choose the tiles to draw, of those that are here. */
  choose() {
    const { header, nodes, tiles } = this;
    if (nodes.length === 0) {
      this.drawn = tiles;
      this.isWhole = tiles.length === header?.tiles.length;
    } else {
      const here = new Map(tiles.map((tile) => [tile.index, tile]));
      const cut = chooseTiles(nodes, (tile) => here.has(tile), this.camera?.view ?? null, this.budget);
      const before = this.drawn;
      this.drawn = cut.tiles.flatMap((tile) => here.get(tile) ?? []);
      this.isWhole = cut.isWhole;
      const isNew = this.drawn.length !== before.length || this.drawn.some((tile, i) => tile !== before[i]);
      if (isNew && !this.sorts) {
        this.scope.postMessage({ type: 'cut', scene: this.scene, tiles: Uint32Array.from(cut.tiles) });
      }
    }
    this.splatCount = this.drawn.reduce((sum, { count }) => sum + count, 0);
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
    if (this.nodes.length > 0) this.choose();
    const { id, view } = this.camera;
    const { scene, splatCount, visible, isWhole } = this;
    const tiles = this.tiles.filter(({ index }) => index < (this.header?.tiles.length ?? 0)).length;
    const reply = /** @type {const} */ ({ type: 'order', scene, id, tiles, isWhole });
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
