// SPDX-License-Identifier: Apache-2.0
// Reads what a view of a file requires: the coarsest version of the scene, then what is seen, the largest errors first,
// layer 0 before the SH bands; then what surrounds it. Packs each part for the GPU as it arrives, and evicts what was not
// needed for longest when the memory is full. A file without levels of detail is read completely.

import { CsplatReader, FormatError } from '../../codec/js/decoder.mjs';
import { chooseWishes, looksOf, nodesOrTiles, tilesOf } from '../../codec/js/levels/level_cut.mjs';
import { Ranges } from '../../codec/js/levels/ranges.mjs';
import { allTiles } from '../../codec/js/tile_records.mjs';
import { SAMPLE_COUNT, showing } from './bounds.mjs';
import { reachClass } from './cull.mjs';
import { BLOCK_SPLATS, packBand, packGeometry, packRows, pagesOf } from './texels.mjs';

/**
 * @typedef {import('../../codec/js/decoder.d.ts').Header} Header
 * @typedef {import('../../codec/js/decoder.d.ts').LayerRecord} LayerRecord
 * @typedef {import('../../codec/js/decoder.d.ts').PackedGeometry} PackedGeometry
 * @typedef {import('../../codec/js/decoder.d.ts').TileRecord} TileRecord
 * @typedef {import('./cull.mjs').CullTile} CullTile
 * @typedef {import('./texels.mjs').BandTexels} BandTexels
 * @typedef {import('./texels.mjs').GeometryTexels} GeometryTexels
 * @typedef {import('./texels.mjs').Rows} Rows
 * @typedef {import('./types.d.ts').TreeNode} TreeNode
 * @typedef {import('./types.d.ts').View} View
 *
 * Receives the parts of a file.
 *
 * @typedef {object} Sink
 * @property {(opened: Opened) => void} header
 * @property {(tile: number, texels: GeometryTexels, cull: CullTile, samples: Samples) => void} geometry
 * @property {(codebook: number, layer: number, rows: Rows) => void} table
 * @property {(tile: number, layer: number, band: BandTexels) => void} band
 * @property {(tile: number) => void} evict the tile is no longer here
 * @property {(progress: Amounts) => void} progress
 * @property {(error: unknown) => void} warn reports an error that leaves the scene usable: a damaged tile, for which a
 *   coarser one is drawn, or a lost connection, which is tried again
 * @property {() => void} complete everything that the view requires is here
 *
 * A file that was opened. `roots`: number of tiles of the coarsest version; `pages`: slots of the GPU's memory, see `pagesOf`.
 *
 * @typedef {{header: Header, description: any, roots: number, pages: number[]}} Opened
 *
 * Samples of splats of the coarsest version, or of a file without levels.
 *
 * @typedef {{points: Float32Array<ArrayBuffer>, weights: Float32Array<ArrayBuffer>}} Samples
 *
 * `missing`: bytes that the view requires and that are not here; `layer`: the one that was read last.
 *
 * @typedef {{phase: 'open' | 'layers', received: number, missing: number, fileSize: number, splatsDone: number,
 *   splatCount: number, layer: number, decodeMs: number}} Amounts
 *
 * Limits of a stream. `budget`: splats to draw; `pixels`: error that is small enough; `around`: whether to read what is out of
 * view.
 *
 * @typedef {{budget: number, pixels: number, around: boolean}} Aims
 *
 * A layer of a tile to read.
 *
 * @typedef {{tile: TileRecord, place: LayerRecord}} Part
 */

/** Bytes that are requested together, and requests in flight; together about half a second at 10 Mbit/s. */
const BATCH_BYTES = 1 << 18;
const BATCHES = 3;

/** Splats that are kept, as a multiple of those drawn: coarser versions, a third, and what was seen before. */
const KEPT = 2;

/** Share of the memory that is filled on purpose, since free ranges may be too small. */
const FILLED = 0.9;

/** The reading of a file. */
export class TileStream {
  /**
   * Open a file.
   *
   * @param {string | Blob | ArrayBuffer} source
   * @param {Sink} sink
   * @param {Aims} aims
   * @param {AbortSignal} signal
   * @param {import('../../codec/js/decoder.d.ts').FetchOptions} [fetching]
   */
  static async open(source, sink, aims, signal, fetching = {}) {
    /** @type {Amounts} */
    const amounts = {
      phase: 'open',
      received: 0,
      missing: 0,
      fileSize: 0,
      splatsDone: 0,
      splatCount: 0,
      layer: 0,
      decodeMs: 0,
    };
    const connection = { isLost: false };
    const reader = await CsplatReader.open(source, {
      ...fetching,
      signal,
      onRetry: (error) => {
        if (!connection.isLost) sink.warn(error);
        connection.isLost = true;
      },
      onProgress: (received) => {
        amounts.received = received;
        sink.progress(amounts);
      },
    });
    reader.retries = fetching.retries ?? Infinity; // the scene stays usable meanwhile
    const { header } = reader;
    const described = reader.describe({ signal });
    described.catch(() => {}); // it is waited for below
    const nodes = nodesOrTiles(header, header.coarseTiles.length > 0 ? await reader.nodes() : []);
    Object.assign(amounts, { phase: 'layers', fileSize: header.fileSize, splatCount: header.splatCount });
    const isLocal = typeof source !== 'string' || /^(blob|data):/.test(source); // the decoder reports no parts of these
    if (isLocal) amounts.received = header.indexSize;
    const stream = new TileStream(reader, nodes, sink, aims, amounts, isLocal, signal, connection);
    // What is shown first comes together with the description.
    if (stream.hasLevels)
      reader.prefetch(
        Array.from(stream.roots, (tile) => ({ tile, layer: 0 })),
        { signal },
      );
    sink.header({ header, description: await described, roots: stream.roots.size, pages: stream.pages });
    sink.progress(amounts);
    return stream;
  }

  /**
   * @param {CsplatReader} reader
   * @param {TreeNode[]} nodes
   * @param {Sink} sink
   * @param {Aims} aims
   * @param {Amounts} amounts
   * @param {boolean} isLocal
   * @param {AbortSignal} signal
   * @param {{isLost: boolean}} connection
   */
  constructor(reader, nodes, sink, aims, amounts, isLocal, signal, connection) {
    this.reader = reader;
    this.nodes = nodes;
    this.sink = sink;
    this.aims = aims;
    this.amounts = amounts;
    this.isLocal = isLocal;
    this.connection = connection;
    this.all = allTiles(reader.header);
    const roots = nodes.filter(({ parent }) => parent === null);
    const rootSplats = roots.reduce((sum, { splatCount }) => sum + splatCount, 0);
    /** Tiles of the coarsest version. */
    this.roots = new Set(roots.flatMap(({ firstTile, tileCount }) => tilesOf(firstTile, tileCount)));
    this.hasLevels = this.roots.size < this.all.length;
    this.stride = Math.max(1, Math.floor(rootSplats / SAMPLE_COUNT));
    const { pages, starts } = pagesOf(this.all, this.hasLevels ? KEPT * Math.max(aims.budget, rootSplats) : Infinity);
    /** Slots of each page of the GPU's memory. */
    this.pages = pages;
    /** Slots of all tiles, if there is room for them. */
    this.fixed = starts;
    this.slots = new Ranges(pages);
    /** Tiles whose layer 0 is here. @type {Map<number, CullTile>} */
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
    this.batches = 0;
    /** Tables that the sink has received. @type {Set<string>} */
    this.tables = new Set();
    /** @type {View | null} */
    this.view = null;
    this.looks = looksOf(nodes, null);
    this.isPaused = false;
    /** Whether everything that the view requires is here. */
    this.isComplete = false;
    /** Batches are read one after the other. @type {Promise<void>} */
    this.reading = Promise.resolve();
    this.hasFailed = false;
    /** @type {(error: unknown) => void} */
    this.reject = () => {};
    /** Rejects when the file cannot be read on. @type {Promise<never>} */
    this.failed = new Promise((_, reject) => (this.reject = reject));
    this.failed.catch(() => {}); // the caller may not listen yet
    signal.addEventListener('abort', () => this.fail(signal.reason));
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
      if (this.isLocal && !this.hasLevels) this.amounts.received = this.amounts.fileSize;
      this.sink.progress(this.amounts);
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
    while (this.batches < BATCHES && left.length > 0) {
      let [bytes, count] = [0, 0];
      while (count < left.length && bytes < BATCH_BYTES) bytes += left[count++].place.size;
      this.#request(left.splice(0, count));
    }
  }

  /**
   * Choose what the view requires, and return the parts that are not here, the most urgent first.
   *
   * @returns {Part[]}
   */
  #missing() {
    const { all, aims, nodes, looks, view, read, damaged, crowded } = this;
    const choice = ++this.choices;
    const wishes = chooseWishes(nodes, looks, view === null ? { ...aims, pixels: Infinity } : aims);
    let room = this.fixed ? Infinity : FILLED * this.pages.reduce((sum, size) => sum + size, 0);
    let free = room - [...this.here.keys()].reduce((sum, index) => sum + slotsOf(all[index]), 0);
    /** @type {Part[]} */
    const parts = [];
    let missing = 0;
    for (const isAround of [false, true]) {
      const some = wishes.filter(({ isNeeded }) => isAround !== isNeeded);
      for (let layer = 0; layer <= this.reader.header.shDegree; layer++) {
        for (const { node, isDrawn } of some) {
          if (layer > 0 && !isDrawn) continue;
          for (const index of tilesOf(node.firstTile, node.tileCount)) {
            const tile = all[index];
            if (this.required.get(index) !== choice) {
              if (layer > 0 || damaged.has(index) || crowded.has(index)) continue;
              // What is out of view replaces nothing.
              if (isAround && !this.here.has(index) && (free -= slotsOf(tile)) < 0) continue;
              room -= slotsOf(tile);
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
    this.batches++;
    for (const { place } of parts) this.pending.set(place, controller);
    const layers = parts.map(({ tile, place }) => ({ tile: tile.index, layer: place.layer }));
    this.reader.prefetch(layers, { signal: controller.signal });
    this.reading = this.reading
      .then(() => this.#readBatch(parts, controller.signal))
      .catch((error) => this.fail(error));
  }

  /**
   * @param {Part[]} parts
   * @param {AbortSignal} signal
   */
  async #readBatch(parts, signal) {
    for (const part of parts) {
      if (!signal.aborted) await this.#readPart(part, signal);
      this.pending.delete(part.place);
      await nextTask(); // lets the camera's messages in
    }
    this.batches--;
    this.readOn();
  }

  /**
   * @param {Part} part
   * @param {AbortSignal} signal
   */
  async #readPart({ tile, place }, signal) {
    const { reader, amounts } = this;
    const begun = performance.now() - reader.waitedMs;
    try {
      if (place.layer === 0) await this.#readGeometry(tile, place, signal);
      else if (this.here.has(tile.index)) await this.#readBand(tile, place, signal);
    } catch (error) {
      if (!signal.aborted) this.#refuse(tile, error);
      return;
    }
    this.connection.isLost = false;
    amounts.decodeMs += performance.now() - reader.waitedMs - begun;
    amounts.layer = place.layer;
    if (this.isLocal) amounts.received += place.size;
    this.sink.progress(amounts);
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
   * @param {AbortSignal} signal
   */
  async #readGeometry(tile, place, signal) {
    const { index } = tile;
    const { header } = this.reader;
    /** @type {PackedGeometry} */
    const packed = await this.reader.readLayer(index, 0, { form: 'packed', signal });
    const slot = this.#room(tile);
    if (slot === null) return void this.crowded.add(index);
    const [opacities, , quats] = header.attributes;
    const texels = packGeometry(packed, opacities, quats);
    const alphas = alphasOf(packed, opacities);
    const culled = cullTile(packed, alphas, tile, slot);
    this.here.set(index, culled);
    this.read.add(place);
    if (tile.level === 0) this.amounts.splatsDone += tile.splatCount;
    const samples = this.roots.has(index) ? samplesOf(packed, alphas, this.stride) : noSamples();
    this.sink.geometry(index, texels, culled, samples);
  }

  /**
   * @param {TileRecord} tile
   * @param {LayerRecord} place
   * @param {AbortSignal} signal
   */
  async #readBand({ index, layers }, place, signal) {
    const { layer } = place;
    /** @type {import('../../codec/js/decoder.d.ts').PackedBand} */
    const { sh, count } = await this.reader.readLayer(index, layer, { form: 'packed', signal });
    if (sh.lookup) {
      const key = `${sh.lookup.codebook}.${layer}`;
      if (!this.tables.has(key)) this.sink.table(sh.lookup.codebook, layer, packRows(sh.lookup.table));
      this.tables.add(key);
    }
    this.read.add(place);
    if (layers.every((one) => one.layer > this.reader.header.shDegree || this.read.has(one))) this.reader.forget(index);
    this.sink.band(index, layer, packBand(sh, count));
  }

  /**
   * Return the first slot for a tile, after evicting others if necessary; null if all others are required.
   *
   * @param {TileRecord} tile
   */
  #room(tile) {
    if (this.fixed) return this.fixed[tile.index];
    for (;;) {
      const slot = this.slots.take(slotsOf(tile));
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
    const { slot } = /** @type {CullTile} */ (this.here.get(index));
    if (!this.fixed) this.slots.give(slot, slotsOf(tile));
    this.here.delete(index);
    for (const place of tile.layers) this.read.delete(place);
    this.reader.forget(index);
    if (tile.level === 0) this.amounts.splatsDone -= tile.splatCount;
    this.sink.evict(index);
  }
}

/** @param {TileRecord} tile */
const slotsOf = ({ splatCount }) => Math.ceil(splatCount / BLOCK_SPLATS) * BLOCK_SPLATS;

/** Resolves after the messages that are already queued. */
function nextTask() {
  const { port1, port2 } = new MessageChannel();
  return new Promise((/** @type {(value: void) => void} */ resolve) => {
    port1.onmessage = () => {
      port1.close();
      resolve();
    };
    port2.postMessage(null);
  });
}

/**
 * @param {PackedGeometry} packed
 * @param {{levels: number, mapping: string}} record
 */
function alphasOf({ opacities: { columns, offsets }, count }, { levels, mapping }) {
  const alphas = new Float32Array(count);
  for (let i = 0; i < count; i++) alphas[i] = (offsets[0] + columns[i]) / levels;
  if (mapping === 'square') for (let i = 0; i < count; i++) alphas[i] *= alphas[i];
  return alphas;
}

/**
 * Return the log-scale of a splat in a column.
 *
 * @param {PackedGeometry} packed
 * @param {number} column
 * @param {number} i
 */
const logScale = ({ scales: { columns, offsets, step }, count }, column, i) =>
  (offsets[column] + columns[column * count + i]) * step;

/**
 * @param {PackedGeometry} packed
 * @param {Float32Array} alphas
 * @param {TileRecord} tile
 * @param {number} slot
 * @returns {CullTile}
 */
function cullTile(packed, alphas, { index, extent, maxScale }, slot) {
  const { count, means } = packed;
  const reaches = new Uint8Array(count);
  for (let i = 0; i < count; i++) {
    const largest = Math.max(logScale(packed, 0, i), logScale(packed, 1, i), logScale(packed, 2, i));
    reaches[i] = reachClass(alphas[i], largest);
  }
  const reach = 4 * Math.exp(maxScale); // 4 exceeds REACH_MAX plus the rounding of the classes
  return { index, count, slot, means: means.columns, corner: means.offsets, step: means.step, extent, reach, reaches };
}

/** @returns {Samples} */
const noSamples = () => ({ points: new Float32Array(0), weights: new Float32Array(0) });

/**
 * Sample every `stride`-th splat.
 *
 * @param {PackedGeometry} packed
 * @param {Float32Array} alphas
 * @param {number} stride
 * @returns {Samples}
 */
function samplesOf(packed, alphas, stride) {
  const { count, means } = packed;
  const n = Math.ceil(count / stride);
  const points = new Float32Array(3 * n);
  const weights = new Float32Array(n);
  for (let k = 0, i = 0; k < n; k++, i += stride) {
    for (let axis = 0; axis < 3; axis++) {
      points[3 * k + axis] = (means.offsets[axis] + means.columns[axis * count + i]) * means.step;
    }
    const [, b, c] = [0, 1, 2].map((column) => logScale(packed, column, i)).sort((x, y) => x - y);
    weights[k] = showing(alphas[i], b, c);
  }
  return { points, weights };
}
