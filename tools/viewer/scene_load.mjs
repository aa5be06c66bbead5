// One call of the engine's `open`: receives a scene from the worker and tracks its parts.

import { coarseBounds, fineBounds } from './bounds.mjs';
import { EngineError, E_LIMIT } from './engine_error.mjs';
import { expandedBytes } from './statistics.mjs';

/**
 * @typedef {import('./renderer.mjs').Renderer} Renderer
 * @typedef {import('./types.d.ts').Bounds} Bounds
 * @typedef {import('./types.d.ts').Header} Header
 * @typedef {import('./worker.mjs').Reply} Reply
 *
 * The callbacks of the promise that `open` returned.
 * @typedef {{resolve: () => void, reject: (error: EngineError) => void}} Settle
 */

export class SceneLoad {
  /**
   * @param {string | Blob | ArrayBuffer} source
   * @param {number} scene number that distinguishes the worker's messages from those for earlier scenes
   * @param {import('./types.d.ts').Stats} stats statistics of this scene; changed in place
   * @param {Pick<import('./types.d.ts').EngineOptions, 'onHeader' | 'onProgress'>} hooks
   * @param {Settle} settle
   */
  constructor(source, scene, stats, hooks, settle) {
    this.source = source;
    this.scene = scene;
    this.stats = stats;
    this.hooks = hooks;
    this.settle = settle;
    /** Start time, milliseconds. */
    this.begun = performance.now();
    /** @type {EngineError | null} */
    this.error = null;
    /** @type {Header | null} */
    this.header = null;
    /** @type {Bounds | null} */
    this.bounds = null;
    /** Whether everything is decoded. */
    this.isDone = false;
    /** Whether the GPU failed to draw it. */
    this.hasFailedToDraw = false;
    this.tilesHere = 0;
    /** The last sort: its camera, the number of tiles of level 0 that were here, and whether it covers the scene. */
    this.order = { id: 0, tiles: 0, isWhole: false };
    /** Number of tiles of the coarsest version that have not arrived. */
    this.rootsMissing = 0;
    /** Samples of splats of level 0, and of the coarsest version. */
    this.samples = { points: /** @type {number[]} */ ([]), weights: /** @type {number[]} */ ([]) };
    this.rootSamples = { points: /** @type {number[]} */ ([]), weights: /** @type {number[]} */ ([]) };
  }

  /** Whether layer 0 of all tiles of level 0 has arrived. */
  get isWhole() {
    return this.header !== null && this.tilesHere === this.header.tiles.length;
  }

  /**
   * Whether everything is decoded and sorted.
   *
   * @param {number} viewId id of the camera, 0 without one
   */
  isSorted(viewId) {
    return this.isDone && (viewId === 0 || (this.order.id === viewId && this.isOrderWhole));
  }

  /** Whether the last sort included all tiles of level 0. */
  get isOrderWhole() {
    return this.order.id > 0 && this.order.tiles === this.header?.tiles.length;
  }

  /**
   * @param {Reply} reply
   * @param {Renderer} renderer
   * @throws {EngineError} the worker's, or E_LIMIT for a scene that does not fit on the GPU
   */
  take(reply, renderer) {
    if (reply.type === 'header') this.#takeHeader(reply, renderer);
    else if (reply.type === 'progress') this.#takeProgress(reply);
    else if (reply.type === 'geometry') this.#takeGeometry(reply, renderer);
    else if (reply.type === 'table') renderer.uploadTable(reply.codebook, reply.layer, reply.rows);
    else if (reply.type === 'band') renderer.uploadBand(reply.tile, reply.layer, reply.band);
    else if (reply.type === 'cut') renderer.setCut(reply.tiles);
    else if (reply.type === 'order') this.#takeOrder(reply, renderer);
    else if (reply.type === 'error') throw new EngineError(reply.error);
    else {
      renderer.complete();
      this.isDone = true;
      this.settle.resolve();
    }
  }

  /** @param {EngineError} error */
  fail(error) {
    if (this.error || this.isDone) return;
    this.error = error;
    this.settle.reject(error);
  }

  /**
   * @param {Reply & {type: 'header'}} reply
   * @param {Renderer} renderer
   */
  #takeHeader({ header, description, roots }, renderer) {
    const { splatCount, fileSize, shDegree, tiles } = header;
    const [opacities, , quats] = header.attributes;
    try {
      renderer.allocate({
        tiles: [...tiles, ...header.coarseTiles],
        shDegree,
        antialiased: header.antialiased,
        opacityLevels: opacities.levels,
        opacitySquare: opacities.mapping === 'square',
        quatLevels: quats.levels,
      });
    } catch (error) {
      if (error instanceof RangeError) throw new EngineError({ code: E_LIMIT, message: error.message });
      throw error;
    }
    this.header = header;
    this.rootsMissing = roots;
    this.bounds = tiles.length ? coarseBounds(header) : this.#boundsOf(header, this.samples);
    Object.assign(this.stats, { splatCount, fileSize, expandedBytesPerSplat: expandedBytes(shDegree) });
    this.hooks.onHeader?.(header, description);
  }

  /** @param {Reply & {type: 'progress'}} reply */
  #takeProgress({ progress, decodeMs }) {
    Object.assign(this.stats, { received: progress.received, decodeMs });
    if (this.isWhole || this.order.isWhole) this.stats.firstPictureBytes ||= progress.received;
    this.hooks.onProgress?.(progress);
  }

  /**
   * @param {Reply & {type: 'geometry'}} reply
   * @param {Renderer} renderer
   */
  #takeGeometry({ tile, texels, samples }, renderer) {
    renderer.uploadGeometry(tile, texels);
    if (this.header && tile < this.header.tiles.length) {
      this.stats.splatsResident += texels.count;
      this.tilesHere++;
    }
    if (!this.header) return;
    const isCoarse = tile >= this.header.tiles.length;
    const { points, weights } = isCoarse ? this.rootSamples : this.samples;
    for (const value of samples.points) points.push(value);
    for (const weight of samples.weights) weights.push(weight);
    if (!isCoarse && this.isWhole) this.bounds = this.#boundsOf(this.header, this.samples);
    else if (isCoarse && samples.weights.length > 0 && --this.rootsMissing === 0) {
      this.bounds = { ...this.#boundsOf(this.header, this.rootSamples), coarse: true };
    }
  }

  /**
   * @param {Reply & {type: 'order'}} reply
   * @param {Renderer} renderer
   */
  #takeOrder({ id, tiles, isWhole, order, count, cullMs, sortMs }, renderer) {
    renderer.setOrder(order, count);
    this.order = { id, tiles, isWhole };
    Object.assign(this.stats, { splatsDrawn: count, cullMs, sortMs });
  }

  /**
   * @param {Header} header
   * @param {{points: number[], weights: number[]}} samples
   */
  #boundsOf(header, { points, weights }) {
    return fineBounds(header, Float32Array.from(points), Float32Array.from(weights));
  }
}
