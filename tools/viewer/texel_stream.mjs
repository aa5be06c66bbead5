// SPDX-License-Identifier: Apache-2.0
// Reads what a view of a file requires, and packs each part for the GPU as it arrives.

import { CsplatReader } from '../../codec/js/decoder.mjs';
import { TileStream } from '../../codec/js/levels/tile_stream.mjs';
import { SAMPLE_COUNT, showing } from './bounds.mjs';
import { reachClass } from './cull.mjs';
import { BLOCK_SPLATS, packBand, packGeometry, packRows, pagesOf } from './texels.mjs';

/**
 * @typedef {import('../../codec/js/decoder.d.ts').Header} Header
 * @typedef {import('../../codec/js/decoder.d.ts').PackedGeometry} PackedGeometry
 * @typedef {import('../../codec/js/decoder.d.ts').TileRecord} TileRecord
 * @typedef {import('../../codec/js/levels/tile_stream.mjs').Aims} Aims
 * @typedef {import('./cull.mjs').CullTile} CullTile
 * @typedef {import('./texels.mjs').BandTexels} BandTexels
 * @typedef {import('./texels.mjs').GeometryTexels} GeometryTexels
 * @typedef {import('./texels.mjs').Rows} Rows
 *
 * Receives the parts of a file.
 *
 * @typedef {object} TexelSink
 * @property {(opened: Opened) => void} header
 * @property {(tile: number, texels: GeometryTexels, cull: CullTile, samples: Samples) => void | Promise<void>} geometry
 * @property {(codebook: number, layer: number, rows: Rows) => void} table
 * @property {(tile: number, layer: number, band: BandTexels) => void | Promise<void>} band
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
 * @typedef {import('../../codec/js/levels/tile_stream.mjs').Amounts & {phase: 'open' | 'layers', received: number,
 *   fileSize: number, splatCount: number}} Amounts
 */

/** A stream of tiles for the GPU. */
export class TexelStream {
  /**
   * Open a file.
   *
   * @param {string | Blob | ArrayBuffer} source
   * @param {TexelSink} sink
   * @param {Aims} aims
   * @param {AbortSignal} signal
   * @param {import('../../codec/js/decoder.d.ts').FetchOptions} [fetching]
   */
  static async open(source, sink, aims, signal, fetching = {}) {
    const none = { missing: 0, splatsDone: 0, layer: 0, decodeMs: 0 };
    /** @type {Amounts} */
    const amounts = { phase: 'open', received: 0, fileSize: 0, splatCount: 0, ...none };
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
    const tiles = await TileStream.open(/** @type {any} */ (reader), aims, signal, { memoryOf });
    tiles.amounts = Object.assign(amounts, { fileSize: header.fileSize, splatCount: header.splatCount });
    const stream = new TexelStream(reader, tiles, sink, amounts, connection);
    tiles.prefetchRoots(signal); // together with the description
    sink.header({ header, description: await described, roots: tiles.roots.size, pages: tiles.memory.pages });
    if (!tiles.hasLevels) amounts.phase = 'layers'; // otherwise a view says what is missing
    return stream;
  }

  /**
   * @param {CsplatReader} reader
   * @param {TileStream} tiles
   * @param {TexelSink} sink
   * @param {Amounts} amounts
   * @param {{isLost: boolean}} connection
   */
  constructor(reader, tiles, sink, amounts, connection) {
    this.reader = reader;
    this.tiles = tiles;
    this.stride = Math.max(1, Math.floor(tiles.rootSplats / SAMPLE_COUNT));
    /** Tiles whose layer 0 is here. @type {Map<number, CullTile>} */
    this.here = new Map();
    /** Tables that the sink has received. @type {Set<string>} */
    this.tables = new Set();
    tiles.sink = {
      decode: ({ index }, layer, signal) =>
        reader.readLayer(index, /** @type {0} */ (layer), { form: 'packed', signal }),
      geometry: (tile, packed, slot) => this.#putGeometry(sink, tile, packed, slot),
      band: (tile, layer, packed) => this.#putBand(sink, tile, layer, packed),
      evict: (index) => {
        this.here.delete(index);
        sink.evict(index);
      },
      progress: (place) => {
        if (place) connection.isLost = false;
        if (tiles.view !== null) amounts.phase = 'layers';
        sink.progress(amounts);
      },
      warn: sink.warn,
      complete: () => sink.complete(),
    };
  }

  /**
   * @param {TexelSink} sink
   * @param {TileRecord} tile
   * @param {PackedGeometry} packed
   * @param {number} slot
   */
  #putGeometry(sink, tile, packed, slot) {
    const { index } = tile;
    const [opacities, , quats] = this.reader.header.attributes;
    const texels = packGeometry(packed, opacities, quats);
    const alphas = alphasOf(packed, opacities);
    const culled = cullTile(packed, alphas, tile, slot);
    this.here.set(index, culled);
    const samples = this.tiles.roots.has(index) ? samplesOf(packed, alphas, this.stride) : noSamples();
    return sink.geometry(index, texels, culled, samples);
  }

  /**
   * @param {TexelSink} sink
   * @param {TileRecord} tile
   * @param {number} layer
   * @param {import('../../codec/js/decoder.d.ts').PackedBand} packed
   */
  #putBand(sink, { index }, layer, { sh, count }) {
    if (sh.lookup) {
      const key = `${sh.lookup.codebook}.${layer}`;
      if (!this.tables.has(key)) sink.table(sh.lookup.codebook, layer, packRows(sh.lookup.table));
      this.tables.add(key);
    }
    return sink.band(index, layer, packBand(sh, count));
  }
}

/**
 * @param {TileRecord[]} tiles
 * @param {number} most
 */
const memoryOf = (tiles, most) => ({ ...pagesOf(tiles, most), block: BLOCK_SPLATS });

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
