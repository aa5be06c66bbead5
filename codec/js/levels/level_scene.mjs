// SPDX-License-Identifier: Apache-2.0
// Draws the levels of detail of a file in an engine: streams what a camera requires, and tells the engine which tiles to show.

import { LayerWorkers } from '../workers.mjs';
import { chooseTiles } from './level_cut.mjs';
import { TileStream } from './tile_stream.mjs';

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
 * What draws tiles. All calls until `flush` are one change of the picture: tiles are hidden first, then shown.
 *
 * @typedef {object} TileTarget
 * @property {(index: number) => void} hide
 * @property {(index: number, tile: LoadedTile) => void} show
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
   * @param {{shDegree: number, workers: number, turn: Turn, warn: (error: unknown) => void}} options
   */
  static async open(reader, aims, signal, { shDegree, workers, turn, warn }) {
    const stream = await TileStream.open(reader, aims, signal, { shDegree, lanes: Math.max(1, workers) });
    stream.prefetchRoots(signal);
    return new LevelScene(stream, signal, workers > 0 ? new LayerWorkers(reader) : null, turn, warn);
  }

  /**
   * @param {TileStream} stream
   * @param {AbortSignal} signal
   * @param {LayerWorkers | null} workers
   * @param {Turn} turn
   * @param {(error: unknown) => void} warn
   */
  constructor(stream, signal, workers, turn, warn) {
    this.stream = stream;
    this.signal = signal;
    /** Tiles in memory. @type {Map<number, LoadedTile>} */
    this.loaded = new Map();
    /** Tiles that are drawn. @type {Set<number>} */
    this.shown = new Set();
    /** Bands of these that arrived since the last change. @type {[number, number, Packed][]} */
    this.bands = [];
    /** @type {Set<number>} */
    this.refined = new Set();
    /** @type {TileTarget | null} */
    this.target = null;
    /** @type {View | null} */
    this.view = null;
    /** @type {ReturnType<typeof setTimeout> | undefined} */
    this.timer = undefined;
    this.changedAt = -Infinity;
    /** Number of splats that are drawn. */
    this.splatCount = 0;
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
        this.loaded.set(index, { ...turn.geometry(packed), sh: [] });
        this.#changeSoon();
      },
      band: ({ index }, layer, { sh }) => {
        const band = turn.band(sh, layer);
        /** @type {LoadedTile} */ (this.loaded.get(index)).sh[layer - 1] = band;
        if (!this.shown.has(index)) return;
        this.bands.push([index, layer, band]);
        this.#changeSoon();
      },
      evict: (index) => {
        this.loaded.delete(index);
        this.#changeSoon();
      },
      progress: () => {},
      warn,
      complete: () => this.#changeSoon(),
    };
    this.workers = workers;
  }

  /** Number of splats that are drawn at most, unless the coarsest version has more. */
  get budget() {
    return Math.max(this.stream.aims.budget, this.stream.rootSplats);
  }

  /**
   * Draw in an engine from now on.
   *
   * @param {TileTarget} target
   */
  start(target) {
    this.target = target;
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
    if (this.timer !== undefined || this.target === null) return;
    this.timer = setTimeout(
      () => {
        this.timer = undefined;
        this.#change();
      },
      Math.max(0, this.changedAt + INTERVAL_MS - performance.now()),
    );
  }

  /** Exchange the tiles that are drawn. */
  #change() {
    const { stream, target, view, loaded, shown, bands } = this;
    if (target === null) return;
    if (view !== null && view !== stream.view) stream.setView(view);
    const { nodes, looks, aims } = stream;
    const isHere = (/** @type {number} */ tile) => loaded.has(tile);
    const { tiles, isWhole, refined } = chooseTiles(nodes, isHere, looks, aims.budget, this.refined, aims.pixels);
    this.refined = refined;
    const chosen = new Set(tiles);
    const added = tiles.filter((index) => !shown.has(index));
    const removed = [...shown].filter((index) => !chosen.has(index));
    for (const index of removed) target.hide(index);
    for (const [index, layer, band] of bands) if (chosen.has(index)) target.band(index, layer, band);
    for (const index of added) target.show(index, /** @type {LoadedTile} */ (loaded.get(index)));
    const isNew = added.length + removed.length + bands.length > 0;
    this.shown = chosen;
    this.bands = [];
    this.splatCount = tiles.reduce((sum, index) => sum + stream.all[index].splatCount, 0);
    if (isNew) target.flush();
    this.changedAt = performance.now();
    if (isWhole) this.showedAll();
    if (stream.isComplete && stream.view !== null) this.completed();
  }
}
