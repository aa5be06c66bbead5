// SPDX-License-Identifier: Apache-2.0
// Draws the levels of detail of a file in an engine: streams what a camera requires, and tells the engine which tiles to show.

import { LayerWorkers } from '../workers.mjs';
import { STEP_MS, ShownTiles } from './shown_tiles.mjs';
import { TileStream, nextTask } from './tile_stream.mjs';

/**
 * @typedef {import('../decoder.d.ts').Packed} Packed
 * @typedef {import('../decoder.d.ts').PackedGeometry} PackedGeometry
 * @typedef {import('../decoder.d.ts').TileRecord} TileRecord
 * @typedef {import('../reader.mjs').Reader} Reader
 * @typedef {import('./level_cut.mjs').View} View
 * @typedef {import('./tile_stream.mjs').Aims} Aims
 *
 * A tile in memory; `sh`: its bands that are here, by layer − 1.
 *
 * @typedef {PackedGeometry & {sh: (Packed | null)[]}} LoadedTile
 *
 * What draws tiles. All calls until `flush` are one change of the picture, which nothing of it may alter before: tiles are
 * hidden first, then shown, in tasks of their own.
 *
 * @typedef {object} TileTarget
 * @property {(index: number) => void} hide
 * @property {(index: number, tile: LoadedTile, shares: number) => void} show a tile, of which shares are drawn
 * @property {(index: number, shares: number) => void} fade changes these, see `fadedAlpha`
 * @property {(index: number, layer: number, band: Packed) => void} band adds a band to a tile that is shown
 * @property {() => void} flush
 *
 * How a packed tile or band is changed for the engine.
 *
 * @typedef {{geometry: (tile: PackedGeometry) => PackedGeometry, band: (band: Packed, layer: number) => Packed}} Turn
 */

/** Minimum interval between changes of what is requested and drawn. */
const INTERVAL_MS = 100;

/** A scene with levels of detail that an engine draws. */
export class LevelScene {
  /**
   * Start to read the coarsest version of a scene.
   *
   * @param {Reader} reader
   * @param {Aims} aims
   * @param {AbortSignal} signal
   * @param {{shDegree: number, workers: number}} options
   */
  static async open(reader, aims, signal, { shDegree, workers }) {
    const stream = await TileStream.open(reader, aims, signal, { shDegree, lanes: Math.max(1, workers) });
    stream.prefetchRoots(signal);
    return new LevelScene(stream, workers > 0 ? new LayerWorkers(reader) : null);
  }

  /**
   * @param {TileStream} stream
   * @param {LayerWorkers | null} workers
   */
  constructor(stream, workers) {
    this.stream = stream;
    this.workers = workers;
    /** @type {Turn} */
    this.turn = { geometry: (tile) => tile, band: (band) => band };
    /** Tiles in memory. @type {Map<number, LoadedTile>} */
    this.loaded = new Map();
    this.shown = new ShownTiles(stream);
    /** Bands of these that arrived since the last change. @type {[number, number, Packed][]} */
    this.bands = [];
    /** @type {TileTarget | null} */
    this.target = null;
    /** @type {View | null} */
    this.view = null;
    /** @type {ReturnType<typeof setTimeout> | undefined} */
    this.timer = undefined;
    this.changedAt = -Infinity;
    this.isChanging = false;
    this.isDue = false; // something has arrived or moved since the last change
    /** @type {() => void} */
    this.showedAll = () => {};
    /** Resolves when the whole scene is drawn, at any level. */
    this.firstPicture = new Promise((/** @type {(value: void) => void} */ resolve) => (this.showedAll = resolve));
    /** @type {() => void} */
    this.completed = () => {};
    /** Resolves when everything that a view requires is drawn for the first time. */
    this.complete = new Promise((/** @type {(value: void) => void} */ resolve) => (this.completed = resolve));
    stream.failed.finally(() => this.close()).catch(() => {});
    stream.sink = {
      decode: (tile, layer, aborted) =>
        workers
          ? workers.read(tile, layer, aborted)
          : stream.reader.readLayer(tile.index, layer, { form: 'packed', signal: aborted }),
      geometry: ({ index }, packed) => {
        this.loaded.set(index, { ...this.turn.geometry(packed), sh: [] });
        this.#changeSoon();
      },
      band: ({ index }, layer, { sh }) => {
        const band = this.turn.band(sh, layer);
        /** @type {LoadedTile} */ (this.loaded.get(index)).sh[layer - 1] = band;
        if (!this.shown.shares.has(index)) return;
        this.bands.push([index, layer, band]);
        this.#changeSoon();
      },
      evict: (index) => {
        this.loaded.delete(index);
        this.#changeSoon();
      },
      progress: () => {},
      warn: console.error,
      complete: () => this.#changeSoon(),
    };
  }

  /** Whether all that the camera requires is drawn. */
  get isComplete() {
    const { stream, shown, view, isChanging, isDue } = this;
    return view !== null && view === stream.view && stream.isComplete && !shown.isFading && !isChanging && !isDue;
  }

  /** Number of splats that are drawn. */
  get splatCount() {
    return this.shown.splatCount;
  }

  /** Bytes that the camera requires and that are not here. */
  get missingBytes() {
    return this.stream.amounts.missing;
  }

  /**
   * Draw in an engine from now on.
   *
   * @param {TileTarget} target
   * @param {Turn} turn
   */
  start(target, turn) {
    this.target = target;
    this.turn = turn;
    this.stream.setView(null);
  }

  /**
   * Load and draw what a camera requires. May be called for each frame.
   *
   * @param {View} view in the coordinates of the file
   */
  update(view) {
    const { view: last } = this;
    const isSame =
      last !== null &&
      last.width === view.width &&
      last.height === view.height &&
      last.fx === view.fx &&
      last.fy === view.fy &&
      Array.from(last.viewmat).every((value, i) => value === view.viewmat[i]);
    if (isSame) return;
    this.view = view;
    this.#changeSoon();
  }

  /** Stop reading; what is drawn stays. */
  close() {
    clearTimeout(this.timer);
    this.target = null;
    this.workers?.close();
    this.loaded.clear();
  }

  #changeSoon() {
    this.isDue = true;
    if (this.timer !== undefined || this.isChanging || this.target === null) return;
    this.timer = setTimeout(
      () => {
        this.timer = undefined;
        this.#change(/** @type {TileTarget} */ (this.target)).catch((error) => this.stream.fail(error));
      },
      Math.max(0, this.changedAt + (this.shown.isFading ? STEP_MS : INTERVAL_MS) - performance.now()),
    );
  }

  /**
   * Exchange the tiles that are drawn, one per task, so that frames are drawn meanwhile.
   *
   * @param {TileTarget} target
   */
  async #change(target) {
    const { stream, view, loaded, shown, bands } = this;
    const { shares: before } = shown;
    this.isChanging = true;
    this.isDue = false;
    if (view !== null && view !== stream.view) stream.setView(view);
    shown.update((tile) => loaded.has(tile), performance.now(), stream.aims.pixels);
    const { shares } = shown;
    this.bands = [];
    const removed = [...before.keys()].filter((index) => !shares.has(index));
    for (const index of removed) target.hide(index);
    const tasks = bands
      .filter(([index]) => shares.has(index) && before.has(index))
      .map((band) => () => target.band(...band));
    for (const [index, some] of shares) {
      const tile = /** @type {LoadedTile} */ (loaded.get(index)); // it may be evicted before its turn
      if (!before.has(index)) tasks.push(() => target.show(index, tile, some));
      else if (before.get(index) !== some) tasks.push(() => target.fade(index, some));
    }
    for (const task of tasks) {
      task();
      await nextTask();
      if (this.target === null) return;
    }
    if (removed.length + tasks.length > 0) target.flush();
    this.changedAt = performance.now();
    this.isChanging = false;
    if (shown.isWhole) this.showedAll();
    if (this.isDue || shown.isFading) this.#changeSoon();
    if (this.isComplete) this.completed();
  }
}
