// SPDX-License-Identifier: Apache-2.0
// One call of the engine's `open`: receives a scene from the worker and tracks its parts.

import { drawnOtherwise } from '../../codec/js/registry.mjs';
import { coarseBounds, fineBounds } from './bounds.mjs';
import { EngineError, E_LIMIT } from './engine_error.mjs';
import { expandedBytes } from './statistics.mjs';

/**
 * @typedef {import('./renderer.mjs').Renderer} Renderer
 * @typedef {import('./types.d.ts').Bounds} Bounds
 * @typedef {import('./types.d.ts').Header} Header
 * @typedef {import('./worker.mjs').Reply} Reply
 *
 * @typedef {string | Blob | ArrayBuffer | Promise<Blob>} Source
 *
 * The callbacks of the promise that `open` returned.
 * @typedef {{resolve: () => void, reject: (error: EngineError) => void}} Settle
 */

export class SceneLoad {
  /**
   * @param {Source} source
   * @param {number} scene number that distinguishes the worker's messages from those for earlier scenes
   * @param {import('./types.d.ts').Stats} stats statistics of this scene; changed in place
   * @param {number} budget splats to draw
   * @param {Pick<import('./types.d.ts').EngineOptions, 'onHeader' | 'onProgress' | 'onError'>} hooks
   * @param {Settle} settle
   */
  constructor(source, scene, stats, budget, hooks, settle) {
    this.source = source;
    this.scene = scene;
    this.stats = stats;
    this.budget = budget;
    this.hooks = hooks;
    this.settle = settle;
    /** How often its file was replaced on the server. */
    this.replacements = 0;
    /** Start time, milliseconds. */
    this.begun = performance.now();
    /** @type {EngineError | null} */
    this.error = null;
    /** @type {Header | null} */
    this.header = null;
    /** @type {Bounds | null} */
    this.bounds = null;
    /** Whether everything that a view requires was here once. */
    this.isDone = false;
    /** Whether the GPU failed to draw it. */
    this.hasFailedToDraw = false;
    /** The last sort: its camera, and whether all that the view requires was here, and all of the scene at any level. */
    this.order = { id: 0, isComplete: false, isWhole: false };
    /** Number of tiles of the coarsest version that have not arrived, and samples of their splats. */
    this.rootsMissing = 0;
    this.samples = { points: /** @type {number[]} */ ([]), weights: /** @type {number[]} */ ([]) };
    /** Splats of each tile that is here. @type {Map<number, number>} */
    this.resident = new Map();
  }

  /**
   * Whether everything that a view requires is decoded and sorted.
   *
   * @param {number} viewId id of the camera, 0 without one
   */
  isSorted(viewId) {
    return this.isDone && (viewId === 0 || (this.order.id === viewId && this.order.isComplete));
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
    else if (reply.type === 'evict') {
      renderer.scene?.evict(reply.tile);
      this.stats.splatsResident -= this.resident.get(reply.tile) ?? 0;
      this.resident.delete(reply.tile);
    } else if (reply.type === 'table') renderer.scene?.putTable(reply.codebook, reply.layer, reply.rows);
    else if (reply.type === 'band') renderer.scene?.putBand(reply.tile, reply.layer, reply.band);
    else if (reply.type === 'order') this.#takeOrder(reply, renderer);
    else if (reply.type === 'error') {
      if (reply.error.fatal) throw new EngineError(reply.error);
      this.hooks.onError?.(reply.error);
    } else {
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
  #takeHeader({ opened: { header, description, roots, pages } }, renderer) {
    const { splatCount, fileSize, shDegree, tiles } = header;
    const [opacities, , quats] = header.attributes;
    const otherwise = drawnOtherwise(header);
    if (otherwise) console.warn(`csplat: ${otherwise}`);
    try {
      renderer.allocate({
        tiles: [...tiles, ...header.coarseTiles],
        pages,
        drawn: header.coarseTiles.length > 0 ? this.budget : splatCount,
        shDegree,
        antialiased: header.antialiased,
        opacityLevels: opacities.levels,
        opacitySquare: opacities.mapping === 'square',
        quatLevels: quats.levels,
      });
      renderer.scene?.setShares(new Map());
    } catch (error) {
      if (error instanceof RangeError) throw new EngineError({ code: E_LIMIT, message: error.message });
      throw error;
    }
    this.header = header;
    this.rootsMissing = roots;
    this.bounds = tiles.length ? coarseBounds(header) : this.#boundsOf(header);
    Object.assign(this.stats, { splatCount, fileSize, expandedBytesPerSplat: expandedBytes(shDegree) });
    this.hooks.onHeader?.(header, description);
  }

  /** @param {Reply & {type: 'progress'}} reply */
  #takeProgress({ progress, decodeMs }) {
    Object.assign(this.stats, { received: progress.received, decodeMs });
    if (this.header && this.rootsMissing === 0) this.stats.firstPictureBytes ||= progress.received;
    this.hooks.onProgress?.(progress);
  }

  /**
   * @param {Reply & {type: 'geometry'}} reply
   * @param {Renderer} renderer
   */
  #takeGeometry({ tile, slot, texels, samples }, renderer) {
    renderer.scene?.putGeometry(tile, texels, slot);
    this.resident.set(tile, texels.count);
    this.stats.splatsResident += texels.count;
    if (!this.header || samples.weights.length === 0) return;
    for (const value of samples.points) this.samples.points.push(value);
    for (const weight of samples.weights) this.samples.weights.push(weight);
    if (--this.rootsMissing === 0) this.bounds = this.#boundsOf(this.header);
  }

  /**
   * @param {Reply & {type: 'order'}} reply
   * @param {Renderer} renderer
   */
  #takeOrder({ id, isComplete, isWhole, shares, order, count, cullMs, sortMs }, renderer) {
    if (shares) renderer.scene?.setShares(shares);
    renderer.scene?.putOrder(order, count);
    this.order = { id, isComplete, isWhole };
    Object.assign(this.stats, { splatsDrawn: count, cullMs, sortMs });
  }

  /** @param {Header} header */
  #boundsOf(header) {
    return fineBounds(header, Float32Array.from(this.samples.points), Float32Array.from(this.samples.weights));
  }
}
