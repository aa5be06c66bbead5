// One call of the engine's `open`: what has come of it so far.

import { coarseBounds, fineBounds } from './bounds.mjs';
import { EngineError, E_LIMIT } from './engine_error.mjs';

/**
 * @typedef {import('./renderer.mjs').Renderer} Renderer
 * @typedef {import('./types.d.ts').Bounds} Bounds
 * @typedef {import('./types.d.ts').Header} Header
 * @typedef {import('./worker.mjs').Reply} Reply
 */

export class Opening {
  /**
   * @param {string | Blob | ArrayBuffer} source
   * @param {number} scene number by which the worker's messages are told from those for earlier scenes
   * @param {() => void} resolve of the promise that `open` gave
   * @param {(error: EngineError) => void} reject
   */
  constructor(source, scene, resolve, reject) {
    this.source = source;
    this.scene = scene;
    this.resolve = resolve;
    this.reject = reject;
    /** Milliseconds. */
    this.begun = performance.now();
    /** @type {EngineError | null} */
    this.error = null;
    /** @type {Header | null} */
    this.header = null;
    /** @type {Bounds | null} */
    this.bounds = null;
    /** Whether everything is decoded. */
    this.isDone = false;
    this.tilesHere = 0;
    this.splatsHere = 0;
    /** The last sort: for which camera and how many tiles. */
    this.order = { id: 0, tiles: 0 };
    /** @type {number[]} samples of splats */
    this.points = [];
    /** @type {number[]} */
    this.weights = [];
  }

  /** Whether layer 0 of all tiles is here. */
  get isWhole() {
    return this.header !== null && this.tilesHere === this.header.tiles.length;
  }

  /**
   * Whether everything is decoded and sorted.
   *
   * @param {number} viewId of the camera, 0 where there is none
   */
  isSorted(viewId) {
    return this.isDone && (viewId === 0 || (this.order.id === viewId && this.isOrderWhole));
  }

  /** Whether the last sort had all tiles. */
  get isOrderWhole() {
    return this.order.id > 0 && this.order.tiles === this.header?.tiles.length;
  }

  /**
   * @param {Header} header
   * @param {Renderer} renderer
   */
  takeHeader(header, renderer) {
    const [opacities, , quats] = header.attributes;
    try {
      renderer.allocate({
        tiles: header.tiles,
        shDegree: header.shDegree,
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
    this.bounds = header.tiles.length ? coarseBounds(header) : this.boundsOfSamples(header);
  }

  /**
   * @param {Reply & {type: 'geometry'}} reply
   * @param {Renderer} renderer
   */
  takeGeometry({ tile, texels, samples }, renderer) {
    renderer.uploadGeometry(tile, texels);
    this.splatsHere += texels.count;
    this.tilesHere++;
    for (const value of samples.points) this.points.push(value);
    for (const weight of samples.weights) this.weights.push(weight);
    if (this.header && this.isWhole) this.bounds = this.boundsOfSamples(this.header);
  }

  /** @param {Header} header */
  boundsOfSamples(header) {
    return fineBounds(header, Float32Array.from(this.points), Float32Array.from(this.weights));
  }

  /** @param {EngineError} error */
  fail(error) {
    if (this.error || this.isDone) return;
    this.error = error;
    this.reject(error);
  }

  finish() {
    this.isDone = true;
    this.resolve();
  }
}
