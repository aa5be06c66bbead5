// SPDX-License-Identifier: Apache-2.0
// Reads what a view of a file requires: the coarsest version of the scene, then what is seen, the largest errors first,
// layer 0 before the SH bands; then what surrounds it. Evicts what was not needed for longest when the memory is full. A file
// without levels of detail is read completely.

import { FormatError } from '../errors.mjs';
import { allTiles } from '../tile_records.mjs';
import { chooseWishes, looksOf, nodesOrTiles, tilesOf } from './level_cut.mjs';
import { Ranges } from './ranges.mjs';

/**
 * @typedef {import('../decoder.d.ts').LayerRecord} LayerRecord
 * @typedef {import('../decoder.d.ts').TileRecord} TileRecord
 * @typedef {import('../reader.mjs').Reader} Reader
 * @typedef {import('./level_cut.mjs').View} View
 *
 * Receives what was read. `decode` reads a layer as the decoder's form 'packed'; `geometry` and `band` take the result, and may
 * return a promise to wait for before the next one is decoded.
 *
 * @typedef {object} Sink
 * @property {(tile: TileRecord, layer: number, signal: AbortSignal) => Promise<any>} decode
 * @property {(tile: TileRecord, packed: any, slot: number) => void | Promise<void>} geometry
 * @property {(tile: TileRecord, layer: number, packed: any) => void | Promise<void>} band
 * @property {(index: number) => void} evict the tile is no longer here
 * @property {(place: LayerRecord | null) => void} progress a part was read; null: everything that a view requires is here
 * @property {(error: unknown) => void} warn reports an error that leaves the scene usable: a damaged tile, for which a
 *   coarser one is drawn
 * @property {() => void} complete everything that the view requires is here
 *
 * Memory for tiles, in splats. `pages`: a tile does not cross their borders; `starts`: places of all tiles, if there is room
 * for them; `block`: a tile takes a multiple of it.
 *
 * @typedef {{pages: number[], starts: number[] | null, block: number}} Memory
 *
 * `missing`: bytes that the view requires and that are not here; `layer`: the one that was read last.
 *
 * @typedef {{missing: number, splatsDone: number, layer: number, decodeMs: number}} Amounts
 *
 * Limits of a stream. `budget`: splats to draw; `pixels`: error that is small enough; `around`: whether to read what is out of
 * view.
 *
 * @typedef {{budget: number, pixels: number, around: boolean}} Aims
 *
 * A layer of a tile to read, and how its request is cancelled.
 *
 * @typedef {{tile: TileRecord, place: LayerRecord}} Part
 */

/**
/**
 * Least and largest number of bytes that are requested together. It begins with the least, doubles when a batch is here in less
 * than `BATCH_MS`, and is halved when a batch takes longer than four times that. What is encoded in memory is at most the
 * largest times `BATCHES`, and one part for each request.
 */
export const BATCH_BYTES = [1 << 15, 1 << 20];
const BATCH_MS = 250;

/** Batches in flight, to not wait between them; of the least number of bytes, one alone, so that nothing else delays it. */
export const BATCHES = 2;

/** Splats that are kept, as a multiple of those drawn: coarser versions, a third, and what was seen before. */
const KEPT = 2;

/** Share of the memory that is filled on purpose, since free ranges may be too small. */
const FILLED = 0.9;

/** The reading of a file. */
export class TileStream {
  /**
   * Prepare the reading of a file; with a `sink`, `setView` starts it.
   *
   * @param {Reader} reader
   * @param {Aims} aims
   * @param {AbortSignal} signal
   * @param {{memoryOf?: (tiles: TileRecord[], most: number) => Memory, shDegree?: number, lanes?: number}} [options] the
   *   memory for at most a number of splats; highest SH band to read; number of parts that are decoded at the same time
   */
  static async open(reader, aims, signal, { memoryOf = onePage, shDegree = reader.header.shDegree, lanes = 1 } = {}) {
    const nodes = nodesOrTiles(reader.header, reader.header.coarseTiles.length > 0 ? await reader.nodes() : []);
    return new TileStream(reader, nodes, aims, signal, memoryOf, shDegree, lanes);
  }

  /**
   * @param {Reader} reader
   * @param {import('../decoder.d.ts').TreeNode[]} nodes
   * @param {Aims} aims
   * @param {AbortSignal} signal
   * @param {(tiles: TileRecord[], most: number) => Memory} memoryOf
   * @param {number} shDegree
   * @param {number} lanes
   */
  constructor(reader, nodes, aims, signal, memoryOf, shDegree, lanes) {
    this.reader = reader;
    this.nodes = nodes;
    this.aims = aims;
    this.shDegree = shDegree;
    /** @type {Amounts} */
    this.amounts = { missing: 0, splatsDone: 0, layer: 0, decodeMs: 0 };
    this.all = allTiles(reader.header);
    const roots = nodes.filter(({ parent }) => parent === null);
    /** Number of splats of the coarsest version. */
    this.rootSplats = roots.reduce((sum, { splatCount }) => sum + splatCount, 0);
    /** Tiles of the coarsest version. */
    this.roots = new Set(roots.flatMap(({ firstTile, tileCount }) => tilesOf(firstTile, tileCount)));
    this.hasLevels = this.roots.size < this.all.length;
    /** Number of splats that are drawn at most, unless the coarsest version has more. */
    this.budget = Math.max(aims.budget, this.rootSplats);
    this.memory = memoryOf(this.all, this.hasLevels ? KEPT * this.budget : Infinity);
    this.slots = new Ranges(this.memory.pages);
    /** Tiles whose layer 0 is here, and their slots. @type {Map<number, number>} */
    this.here = new Map();
    /** Parts that are here. @type {Set<LayerRecord>} */
    this.read = new Set();
    /** Tiles that are invalid, and those that the memory has no room for in this view. @type {Set<number>} */
    this.damaged = new Set();
    this.crowded = new Set();
    /** Number of the last choice that required a tile. @type {Map<number, number>} */
    this.required = new Map();
    this.choices = 0;
    /** Parts in flight. @type {Map<LayerRecord, AbortController>} */
    this.pending = new Map();
    /** Number of parts in flight by batch, and when it was requested. @type {Map<AbortController, {left: number, begun: number}>} */
    this.batches = new Map();
    this.batchBytes = BATCH_BYTES[0];
    /** Parts to decode, in this order. @type {Part[]} */
    this.queue = [];
    this.freeLanes = lanes;
    /** @type {View | null} */
    this.view = null;
    this.looks = looksOf(nodes, null);
    this.isPaused = false;
    /** Whether everything that the view requires is here. */
    this.isComplete = false;
    this.hasFailed = false;
    /** @type {Sink} */
    this.sink = /** @type {any} */ (null);
    /** @type {(error: unknown) => void} */
    this.reject = () => {};
    /** Rejects when the file cannot be read on. @type {Promise<never>} */
    this.failed = new Promise((_, reject) => (this.reject = reject));
    this.failed.catch(() => {}); // the caller may not listen yet
    signal.addEventListener('abort', () => this.fail(signal.reason));
  }

  /**
   * Request the coarsest version, which is shown first.
   *
   * @param {AbortSignal} signal
   */
  prefetchRoots(signal) {
    if (!this.hasLevels) return;
    this.reader.prefetch(
      Array.from(this.roots, (tile) => ({ tile, layer: 0 })),
      { signal },
    );
  }

  /**
   * End the reading.
   *
   * @param {unknown} error
   */
  fail(error) {
    this.hasFailed = true;
    this.reject(error);
    for (const controller of this.pending.values()) controller.abort();
  }

  /**
   * Read for a view from now on; before the first, the coarsest version is read.
   *
   * @param {View | null} view
   */
  setView(view) {
    this.view = view;
    this.looks = looksOf(this.nodes, view);
    this.crowded.clear();
    this.readOn();
  }

  /** @param {boolean} isPaused whether the scene is not seen: of a file with levels, only the coarsest version is read */
  pause(isPaused) {
    this.isPaused = isPaused;
    this.readOn();
  }

  /** Request what the view requires most urgently, and cancel requests for what it does not require. */
  readOn() {
    if (this.hasFailed) return;
    const wasComplete = this.isComplete;
    const parts = this.#missing();
    if (this.isComplete && !wasComplete) {
      this.sink.progress(null);
      this.sink.complete();
    }
    const places = new Set(parts.map(({ place }) => place));
    const due = new Set([...this.pending].filter(([place]) => places.has(place)).map(([, controller]) => controller));
    for (const controller of this.pending.values()) if (!due.has(controller)) controller.abort();
    // The coarsest version is requested alone, then one layer at a time, so that nothing else delays it.
    const isFirst = this.hasLevels && parts.some(({ tile, place }) => place.layer === 0 && this.roots.has(tile.index));
    if (this.isPaused && this.hasLevels && !isFirst) return;
    const layer = parts[0]?.place.layer;
    const left = parts.filter(({ tile, place }) => {
      const isNext = place.layer === layer && (!isFirst || this.roots.has(tile.index));
      return isNext && !this.pending.has(place);
    });
    while (this.batches.size < (this.batchBytes > BATCH_BYTES[0] ? BATCHES : 1) && left.length > 0) {
      let [bytes, count] = [0, 0];
      while (count < left.length && bytes < this.batchBytes) bytes += left[count++].place.size;
      this.#request(left.splice(0, count));
    }
  }

  /**
   * Choose what the view requires, and return the parts that are not here, the most urgent first.
   *
   * @returns {Part[]}
   */
  #missing() {
    const { all, aims, nodes, looks, view, read, damaged, crowded, memory } = this;
    const choice = ++this.choices;
    const wishes = chooseWishes(nodes, looks, view === null ? { ...aims, pixels: Infinity } : aims);
    let room = memory.starts ? Infinity : FILLED * memory.pages.reduce((sum, size) => sum + size, 0);
    let free = room - [...this.here.keys()].reduce((sum, index) => sum + this.#sizeOf(all[index]), 0);
    /** @type {Part[]} */
    const parts = [];
    let missing = 0;
    for (const isAround of [false, true]) {
      const some = wishes.filter(({ isNeeded }) => isAround !== isNeeded);
      for (let layer = 0; layer <= this.shDegree; layer++) {
        for (const { node, isDrawn } of some) {
          if (layer > 0 && !isDrawn) continue;
          for (const index of tilesOf(node.firstTile, node.tileCount)) {
            const tile = all[index];
            if (this.required.get(index) !== choice) {
              if (layer > 0 || damaged.has(index) || crowded.has(index)) continue;
              // What is out of view replaces nothing.
              if (isAround && !this.here.has(index) && (free -= this.#sizeOf(tile)) < 0) continue;
              room -= this.#sizeOf(tile);
              if (room < 0) continue;
              this.required.set(index, choice);
            }
            const place = tile.layers.find((one) => one.layer === layer);
            if (place === undefined || read.has(place)) continue;
            parts.push({ tile, place });
            if (!isAround) missing += place.size;
          }
        }
      }
    }
    this.amounts.missing = missing;
    this.isComplete = missing === 0;
    // A server without ranges sends the file from its beginning.
    return this.reader.arrivesInOrder ? parts.sort((a, b) => a.place.offset - b.place.offset) : parts;
  }

  /** @param {Part[]} parts */
  #request(parts) {
    const controller = new AbortController();
    this.batches.set(controller, { left: parts.length, begun: performance.now() });
    for (const { place } of parts) this.pending.set(place, controller);
    const layers = parts.map(({ tile, place }) => ({ tile: tile.index, layer: place.layer }));
    this.reader.prefetch(layers, { signal: controller.signal });
    this.queue.push(...parts);
    while (this.freeLanes > 0 && this.queue.length > 0) {
      this.freeLanes--;
      this.#readQueue().catch((error) => this.fail(error));
    }
  }

  /** Read part after part. */
  async #readQueue() {
    for (let part = this.queue.shift(); part; part = this.queue.shift()) {
      const controller = /** @type {AbortController} */ (this.pending.get(part.place));
      if (!controller.signal.aborted) await this.#readPart(part, controller.signal);
      this.pending.delete(part.place);
      await nextTask(); // lets the camera's messages in
      const batch = /** @type {{left: number, begun: number}} */ (this.batches.get(controller));
      if (--batch.left > 0) continue;
      this.batches.delete(controller);
      if (!controller.signal.aborted) this.#fitBatches(performance.now() - batch.begun);
      this.readOn();
    }
    this.freeLanes++;
  }

  /** @param {number} took time of a batch, milliseconds */
  #fitBatches(took) {
    const factor = took < BATCH_MS ? 2 : took > 4 * BATCH_MS ? 0.5 : 1;
    this.batchBytes = Math.min(BATCH_BYTES[1], Math.max(BATCH_BYTES[0], factor * this.batchBytes));
  }

  /**
   * @param {Part} part
   * @param {AbortSignal} signal
   */
  async #readPart({ tile, place }, signal) {
    const { reader, amounts, sink } = this;
    const { layer } = place;
    const begun = performance.now() - reader.waitedMs;
    try {
      if (layer > 0 && !this.here.has(tile.index)) return;
      const packed = await sink.decode(tile, layer, signal);
      amounts.decodeMs += performance.now() - reader.waitedMs - begun;
      await (layer === 0 ? this.#takeGeometry(tile, place, packed) : this.#takeBand(tile, place, packed));
    } catch (error) {
      if (!signal.aborted) this.#refuse(tile, error);
      return;
    }
    amounts.layer = layer;
    sink.progress(place);
  }

  /**
   * @param {TileRecord} tile
   * @param {unknown} error
   */
  #refuse(tile, error) {
    const { index } = tile;
    if (error instanceof FormatError && !this.roots.has(index)) {
      this.damaged.add(index);
      if (this.here.has(index)) this.#evict(index);
      this.sink.warn(error);
    } else this.fail(error);
  }

  /**
   * @param {TileRecord} tile
   * @param {LayerRecord} place
   * @param {any} packed
   */
  #takeGeometry(tile, place, packed) {
    const slot = this.#room(tile);
    if (slot === null) {
      this.crowded.add(tile.index);
      return;
    }
    this.here.set(tile.index, slot);
    this.read.add(place);
    if (tile.level === 0) this.amounts.splatsDone += tile.splatCount;
    return this.sink.geometry(tile, packed, slot);
  }

  /**
   * @param {TileRecord} tile
   * @param {LayerRecord} place
   * @param {any} packed
   */
  #takeBand(tile, place, packed) {
    if (!this.here.has(tile.index)) return; // evicted meanwhile
    this.read.add(place);
    const isWhole = tile.layers.every((one) => one.layer > this.reader.header.shDegree || this.read.has(one));
    if (isWhole) this.reader.forget(tile.index);
    return this.sink.band(tile, place.layer, packed);
  }

  /**
   * Return the first slot for a tile, after evicting others if necessary; null if all others are required.
   *
   * @param {TileRecord} tile
   */
  #room(tile) {
    if (this.memory.starts) return this.memory.starts[tile.index];
    for (;;) {
      const slot = this.slots.take(this.#sizeOf(tile));
      if (slot !== null) return slot;
      const victim = this.#victim();
      if (victim === null) return null;
      this.#evict(victim);
    }
  }

  /** Return the tile that has not been required for longest, before those that cover for it. */
  #victim() {
    let victim = null;
    let least = Infinity;
    for (const index of this.here.keys()) {
      const last = this.required.get(index) ?? 0;
      if (last === this.choices || this.roots.has(index)) continue;
      const age = last - 1 / (2 + this.all[index].level); // of tiles of equal age, the finest
      if (age < least) [victim, least] = [index, age];
    }
    return victim;
  }

  /** @param {number} index */
  #evict(index) {
    const tile = this.all[index];
    const slot = /** @type {number} */ (this.here.get(index));
    if (!this.memory.starts) this.slots.give(slot, this.#sizeOf(tile));
    this.here.delete(index);
    for (const place of tile.layers) this.read.delete(place);
    this.reader.forget(index);
    if (tile.level === 0) this.amounts.splatsDone -= tile.splatCount;
    this.sink.evict(index);
  }

  /** @param {TileRecord} tile */
  #sizeOf({ splatCount }) {
    const { block } = this.memory;
    return Math.ceil(splatCount / block) * block;
  }
}

/**
 * Return memory in which a tile may be anywhere.
 *
 * @param {TileRecord[]} tiles
 * @param {number} most
 * @returns {Memory}
 */
function onePage(tiles, most) {
  const all = tiles.reduce((sum, { splatCount }) => sum + splatCount, 0);
  return { pages: [Math.ceil(Math.min(all, most) / FILLED)], starts: null, block: 1 };
}

/** Resolves after the messages that are already queued. */
export function nextTask() {
  const { port1, port2 } = new MessageChannel();
  return new Promise((/** @type {(value: void) => void} */ resolve) => {
    port1.onmessage = () => {
      port1.close();
      resolve();
    };
    port2.postMessage(null);
  });
}
