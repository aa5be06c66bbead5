// SPDX-License-Identifier: Apache-2.0
// A file as the adapters for engines load it: their shared options, and packed tiles as they arrive.

import { CsplatReader } from '../decoder.mjs';
import { LevelScene } from '../levels/level_scene.mjs';
import { poolSize } from '../levels/splat_pool.mjs';
import { ballOf, eyeOf, firstView } from '../first_view.mjs';
import { drawnOtherwise } from '../registry.mjs';
import { allTiles } from '../tile_records.mjs';
import { mirroredBand, mirroredGeometry } from './mirror.mjs';
import { onceSaid, uprightIn } from './packed_values.mjs';

/**
 * @typedef {import('../decoder.d.ts').Header} Header
 * @typedef {import('../decoder.d.ts').Packed} Packed
 * @typedef {import('../decoder.d.ts').PackedTile} PackedTile
 * @typedef {import('../decoder.d.ts').TileRecord} TileRecord
 * @typedef {import('./options.d.ts').LoadOptions} LoadOptions
 * @typedef {{first: number, count: number, sh: Packed}} Band the band of a tile, and the index of its first splat
 */

const PHONE = /Android|iPhone|iPad/;
const WORKERS = 2; // default number of decoding workers
const DETERMINANT_ROWS = [[1, 2], [2, 0], [0, 1]]; // prettier-ignore
const SAMPLE = 1024; // splats per tile from which bounds are computed
const MOST = 0.9; // fraction of the sample within the bounds

/**
 * Open a file.
 *
 * @param {Parameters<typeof CsplatReader.open>[0]} from
 * @param {LoadOptions} options
 * @param {{name: string, engine: 'RUB' | 'RUF', mirrors: boolean, aligns?: boolean, shDegree: number, maxSplats?: number}} target
 *   name of the adapter; letters of the engine's directions +x, +y, +z; whether the engine can draw with a mirroring matrix;
 *   whether tiles have the engine's axes if signs suffice for that; its highest SH degree; the engine's own default of the
 *   option
 * @param {(AbortSignal | undefined)[]} [signals] further signals that abort the load
 */
export async function openScene(from, options, target, signals = []) {
  const {
    shDegree,
    progressive,
    workers = WORKERS,
    maxSplats = target.maxSplats ?? usualMaxSplats(),
    levels = false,
    pixelError = 1,
    signal: given,
    ...others
  } = options;
  const life = new Life([given, ...signals]);
  try {
    const { signal } = life;
    const onProgress = (/** @type {number} */ received, /** @type {number} */ size) => {
      options.onProgress?.(received, size);
      life.received = received;
      life.onBytes();
    };
    const reader = await CsplatReader.open(from, { ...others, signal, onProgress });
    options.onProgress?.(life.received, reader.header.fileSize); // a small file is here before its size is known
    const described = reader.describe({ signal });
    described.catch(() => {}); // it is waited for below
    const { extras, shDegree: most, coarseTiles } = reader.header;
    const wanted = Math.min(shDegree ?? most, most);
    const degree = Math.min(wanted, target.shDegree);
    let streamed = null;
    if (levels && coarseTiles.length > 0) {
      reader.retries = others.retries ?? Infinity; // what is drawn stays usable meanwhile
      const aims = { budget: maxSplats, pixels: pixelError, around: true };
      streamed = await LevelScene.open(/** @type {any} */ (reader), aims, signal, { shDegree: degree, workers });
    }
    const description = await described; // it comes together with the coarsest version
    const version = streamed ? [] : await chooseTiles(reader, maxSplats);
    if (degree < wanted)
      onceSaid(target.name, `SH bands above ${degree} are left out: the engine ends at degree ${degree}`);
    const otherwise = drawnOtherwise(reader.header);
    if (otherwise) onceSaid(target.name, otherwise);
    if (extras.length)
      onceSaid(target.name, `extra columns are left out: ${extras.map(({ name }) => name).join(', ')}`);
    const settings = { degree, progressive: progressive === true && degree > 0 && !streamed, workers };
    return new SplatScene(reader, version, description, settings, target, life, streamed);
  } catch (error) {
    life.end();
    throw error;
  }
}

/** Return the default of `maxSplats`: what Spark 2.2 and Babylon.js 9.34 draw at most of scenes with levels. */
const usualMaxSplats = () => (PHONE.test(globalThis.navigator?.userAgent ?? '') ? 1_000_000 : 2_500_000);

/**
 * Return the tiles of the version with the smallest errors that has at most a number of splats; of a file without levels of
 * detail, all tiles; if there is none, the coarsest version.
 *
 * @param {CsplatReader} reader
 * @param {number} maxSplats
 */
async function chooseTiles(reader, maxSplats) {
  const { header } = reader;
  if (header.coarseTiles.length === 0 || header.splatCount <= maxSplats) return header.tiles;
  const nodes = await reader.nodes();
  const fewest = nodes.reduce((sum, { parent, splatCount }) => sum + (parent === null ? splatCount : 0), 0);
  const tiles = allTiles(header);
  const chosen = await reader.cut({ maxSplats: Math.max(maxSplats, fewest) });
  return chosen.map((index) => tiles[index]);
}

/** The lifetime of a load. It ends when any of the signals aborts, and removes its listeners when the load is over. */
class Life {
  /** @param {(AbortSignal | undefined)[]} signals */
  constructor(signals) {
    this.controller = new AbortController();
    this.signal = this.controller.signal;
    this.over = new AbortController();
    this.received = 0; // bytes
    this.onBytes = () => {};
    for (const signal of signals) {
      if (signal?.aborted) this.controller.abort(signal.reason);
      signal?.addEventListener('abort', () => this.controller.abort(signal.reason), { signal: this.over.signal });
    }
  }

  end() {
    this.over.abort();
  }
}

/** Tiles, bands and metadata of one version of a scene. */
export class SplatScene {
  /**
   * @param {CsplatReader} reader
   * @param {TileRecord[]} version its tiles
   * @param {Pick<import('../decoder.d.ts').Description, 'metadata' | 'cameras'>} description
   * @param {{degree: number, progressive: boolean, workers: number}} wanted
   * @param {{engine: 'RUB' | 'RUF', mirrors: boolean, aligns?: boolean}} target
   * @param {Life} life
   * @param {LevelScene | null} [levels]
   */
  constructor(reader, version, { metadata, cameras }, { degree, progressive, workers }, target, life, levels = null) {
    /** @type {CsplatReader | null} null once everything has been read, to free the bytes of the file and the decoder */
    this.reader = reader;
    /** The header of the file. */
    this.file = reader.header;
    /** Of each tile of the header below, its index in the file. */
    this.indices = version.map(({ index }) => index);
    let splatCount = 0;
    const tiles = version.map((tile, index) => {
      const first = splatCount;
      splatCount += tile.splatCount;
      return { ...tile, index, first };
    });
    /** The header of a file with this version alone, or with room for what is streamed. */
    this.header = { ...reader.header, tiles, splatCount: levels ? poolSize(levels.stream) : splatCount };
    this.metadata = metadata;
    this.degree = degree;
    this.progressive = progressive;
    this.workers = workers;
    this.life = life;
    /** @type {number[][]} sampled centres */
    this.sample = [];
    /** What streams the levels of detail, if they are drawn by what the camera sees. */
    this.levels = levels;
    this.isShown = false;
    const upright = uprightIn(reader.header, metadata, target.engine);
    /** Of each axis, −1 if the tiles are mirrored along it. */
    this.signs = signsFor(upright, uprightIn(reader.header, null, target.engine), target);
    /** 3 × 3, by rows: makes the tiles upright. */
    this.upright = this.mirroredColumns(upright);
    this.view = uprightView(reader.header, { metadata, cameras }, upright);
  }

  /**
   * Draw the levels of detail; resolves when the whole scene is drawn, at any level.
   *
   * @param {import('../levels/level_scene.mjs').TileTarget} target
   */
  async drawLevels(target) {
    const levels = /** @type {LevelScene} */ (this.levels);
    this.life.signal.throwIfAborted();
    this.life.signal.addEventListener('abort', () => this.release());
    levels.start(target, {
      geometry: (tile) => {
        if (!this.isShown) this.sample.push(...centresOf(tile));
        return this.geometry(tile);
      },
      band: (band, layer) => this.band(band, layer),
    });
    try {
      await Promise.race([levels.firstPicture, levels.stream.failed]);
    } catch (error) {
      this.release();
      throw error;
    }
  }

  /**
   * Load and draw what a camera requires.
   *
   * @param {ArrayLike<number>} modelView 4 × 4, by columns: from the object's coordinates to those of the camera, whose z
   *   points backward
   * @param {ArrayLike<number>} projection 4 × 4, by columns
   * @param {{width: number, height: number, near: number}} picture its size in pixels; distance of the near plane
   */
  look(modelView, projection, { width, height, near }) {
    const scale = Math.hypot(modelView[0], modelView[1], modelView[2]) || 1;
    const flips = [1, -1, -1]; // of the camera's axes, whose z points forward in `viewmat`
    const signs = [...this.signs, 1];
    const viewmat = Array.from({ length: 16 }, (_, at) => {
      const [row, column] = [at >> 2, at & 3];
      if (row === 3) return column === 3 ? 1 : 0;
      return (modelView[4 * column + row] * flips[row] * signs[column]) / scale;
    });
    const [fx, fy] = [0.5 * width * projection[0], 0.5 * height * projection[5]];
    const [cx, cy] = [0.5 * width * (1 - projection[8]), 0.5 * height * (1 + projection[9])];
    this.levels?.update({ viewmat, fx, fy, cx, cy, near: near / scale, width, height });
  }

  get isMirrored() {
    return this.signs.includes(-1);
  }

  /** @param {number[][]} rows 3 × 3: between the file's coordinates and those of the tiles */
  mirroredColumns(rows) {
    return rows.map((row) => row.map((value, k) => value * this.signs[k]));
  }

  /** @template {import('../decoder.d.ts').PackedGeometry} T @param {T} tile @returns {T} as the engine draws it */
  geometry(tile) {
    return this.isMirrored ? mirroredGeometry(tile, this.signs) : tile;
  }

  /** @template {Packed | null} T @param {T} band @param {number} layer @returns {T} as the engine draws it */
  band(band, layer) {
    return this.isMirrored && band ? /** @type {T} */ (mirroredBand(band, layer, this.signs)) : band;
  }

  /**
   * Return two corners of the box of all centres, or of all splats, not turned.
   *
   * @template T
   * @param {new (x: number, y: number, z: number) => T} Vector of the engine
   * @param {Header} [header] with the tiles; all levels if it is missing
   * @param {number} [sigmas] standard deviations of the largest splat of a tile around its centres
   * @returns {[T, T]}
   */
  corners(Vector, header, sigmas = 0) {
    const all = header?.tiles ?? allTiles(this.file);
    const [low, high] = /** @type {const} */ (['min', 'max']).map((side) =>
      [0, 1, 2].map((axis) => {
        const reach = side === 'min' ? -sigmas : sigmas;
        const beyond = (/** @type {number} */ maxScale) => reach * Math.exp(Math.min(maxScale, 80));
        return Math[side](...all.map((tile) => tile[side][axis] + beyond(tile.maxScale)));
      }),
    );
    for (const [k, sign] of this.signs.entries()) if (sign < 0) [low[k], high[k]] = [-high[k], -low[k]];
    return [new Vector(low[0], low[1], low[2]), new Vector(high[0], high[1], high[2])];
  }

  /** Abort the load. */
  abort() {
    this.life.controller.abort();
  }

  /** Free the reader once all reads have ended. */
  release() {
    this.life.end();
    this.reader?.compiled?.close();
    this.reader = null;
  }

  /**
   * Yield the tiles with the layers that a load waits for.
   *
   * @returns {AsyncGenerator<PackedTile & {index: number, first: number}, void>} tiles in the order of completion
   */
  async *tiles() {
    const { header, indices, progressive, workers } = this;
    const { signal } = this.life;
    const numbers = new Map(indices.map((index, number) => [index, number]));
    const shDegree = progressive ? 0 : this.degree;
    try {
      const reader = this.reading(Array.from({ length: shDegree + 1 }, (_, layer) => layer));
      if (progressive) this.fetchBandsNext();
      for await (const read of reader.readTiles({ tiles: indices, form: 'packed', shDegree, workers, signal })) {
        signal.throwIfAborted();
        const tile = { ...read, index: /** @type {number} */ (numbers.get(read.index)) };
        const { first } = header.tiles[tile.index];
        this.sample.push(...centresOf(tile));
        const sh = tile.sh.map((/** @type {Packed | null} */ band, /** @type {number} */ i) => this.band(band, i + 1));
        yield { ...this.geometry(tile), sh, first };
      }
      signal.throwIfAborted();
    } catch (error) {
      this.release();
      throw error;
    }
  }

  /** Fetch SH bands as soon as layer 0 has arrived: no earlier, to not compete with it, and no later, to not idle. */
  fetchBandsNext() {
    const { life, header, file, indices, degree } = this;
    const end = header.tiles.reduce((most, { layers: [{ offset, size }] }) => Math.max(most, offset + size), 0); // layer 0 comes first
    // Tiles of other versions are between these, but are not fetched.
    const chosen = new Set(indices);
    const base = allTiles(file).reduce(
      (sum, { index, layers: [{ offset, size }] }) => sum - (offset < end && !chosen.has(index) ? size : 0),
      end,
    );
    life.onBytes = () => {
      if (life.received < base || life.signal.aborted) return;
      life.onBytes = () => {};
      this.reading(Array.from({ length: degree }, (_, i) => i + 1));
    };
    life.onBytes();
  }

  /**
   * Yield one band of all tiles that have it, for a progressive load.
   *
   * @param {number} layer from 1 on
   * @returns {AsyncGenerator<Band & {index: number}, void>}
   */
  async *bands(layer) {
    const { signal } = this.life;
    const reader = this.reading([layer]);
    for (const { index, first } of this.header.tiles) {
      const band = await reader.readLayer(this.indices[index], layer, { form: 'packed', signal });
      signal.throwIfAborted();
      if (band) yield { index, first, count: band.count, sh: this.band(band.sh, layer) };
    }
  }

  /**
   * Return the property `csplat` of the engine's object.
   *
   * @template T
   * @param {(() => Promise<T>)} work passes the bands to the engine
   * @param {T} done result if nothing is left to do
   * @returns {import('./options.d.ts').SceneFacts<T>}
   */
  facts(work, done) {
    const { file: header, metadata, view, bounds, levels } = this;
    const { splatCount } = this.header;
    this.isShown = true;
    const whole = levels ? Promise.race([levels.complete, levels.stream.failed]) : Promise.resolve();
    const complete = this.progressive ? work() : whole.then(() => done);
    // If the caller does not await `complete`, its errors would be lost.
    complete
      .catch((error) => this.life.signal.aborted || console.error(error))
      .finally(() => levels === null && this.release());
    return { header, splatCount, metadata, view, bounds, complete, levels };
  }

  /** Bounds of most splats of the upright scene: a few far away would make the bounds of all useless. */
  get bounds() {
    const turn = this.mirroredColumns(this.upright);
    const centre = [0, 1, 2].map((axis) => quantile(this.sample.map((mean) => mean[axis]), 0.5)); // prettier-ignore
    const away = this.sample.map((mean) => Math.hypot(...mean.map((value, axis) => value - centre[axis])));
    return {
      centre: turn.map((row) => row.reduce((sum, one, i) => sum + one * centre[i], 0)),
      radius: quantile(away, MOST),
    };
  }

  /**
   * Return the reader and start to fetch layers.
   *
   * @param {number[]} layers
   */
  reading(layers) {
    const { indices, reader } = this;
    const { signal } = this.life;
    signal.throwIfAborted();
    if (reader === null) throw new Error('the whole file has already been read');
    reader.prefetch(
      indices.flatMap((tile) => layers.map((layer) => ({ tile, layer }))),
      { signal },
    );
    return reader;
  }
}

/**
 * Return the first view of the upright scene.
 *
 * @param {Header} header
 * @param {Pick<import('../decoder.d.ts').Description, 'metadata' | 'cameras'>} description
 * @param {number[][]} upright 3 × 3, by rows
 * @returns {import('./options.d.ts').SceneView}
 */
function uprightView(header, description, upright) {
  const first = firstView(header, description, upright[1]);
  const { viewmat: m, lens, near, from } = first;
  const { eye, distance } = eyeOf(first, ballOf(header));
  const turned = (/** @type {number[]} */ v) => upright.map((row) => row[0] * v[0] + row[1] * v[1] + row[2] * v[2]);
  const fov = (/** @type {number} */ aspect) =>
    (360 / Math.PI) * Math.atan(0.5 / (lens.fy * Math.min(aspect / lens.W, 1 / lens.H)));
  return {
    position: turned(eye),
    target: turned(eye.map((value, k) => value + distance * m[8 + k])),
    up: turned([-m[4], -m[5], -m[6]]),
    near,
    from,
    fov,
  };
}

/**
 * Return −1 for each axis along which tiles have to be mirrored.
 *
 * @param {number[][]} upright 3 × 3, by rows
 * @param {number[][]} along the same without the file's up direction
 * @param {{mirrors: boolean, aligns?: boolean}} target
 */
function signsFor([a, b, c], along, { mirrors, aligns }) {
  const diagonal = along.map((row, k) => row[k]);
  if (aligns && !diagonal.includes(0)) return diagonal;
  const determinant = DETERMINANT_ROWS.reduce((sum, [i, j], k) => sum + a[k] * (b[i] * c[j] - b[j] * c[i]), 0);
  return determinant < 0 && !mirrors ? [-1, 1, 1] : [1, 1, 1];
}

/** @param {import('../decoder.d.ts').PackedGeometry} tile */
function centresOf({ count, means: { columns, offsets, step } }) {
  const every = Math.ceil(count / SAMPLE);
  return Array.from({ length: Math.ceil(count / every) }, (_, i) =>
    offsets.map((offset, axis) => (offset + columns[axis * count + i * every]) * step),
  );
}

/**
 * @param {number[]} values
 * @param {number} part
 */
const quantile = (values, part) => values.sort((a, b) => a - b)[Math.floor(part * (values.length - 1))] ?? 0;
