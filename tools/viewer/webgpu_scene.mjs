// The memory of one scene on a WebGPU device. csplat_render/gpu/packing.py describes the layout.

import { toCamera } from './camera_maths.mjs';
import { Words } from './webgpu_device.mjs';

/**
 * @typedef {import('./texels.mjs').BandTexels} BandTexels
 * @typedef {import('./texels.mjs').GeometryTexels} GeometryTexels
 * @typedef {import('./texels.mjs').Rows} Rows
 * @typedef {import('./renderer.mjs').SceneLayout} SceneLayout
 * @typedef {import('./types.d.ts').View} View
 * @typedef {import('./webgpu_device.mjs').Device} Device
 *
 * Tiles whose words share two buffers.
 * @typedef {{blocks: number, info: GPUBuffer, geometry: Words, rows: Words}} Page
 */

/** Splats of a workgroup, all of one tile. */
export const BLOCK = 256;

/** Rows of four words per tile in the table of constants. */
const TILE_ROWS = 12;

/** Blocks of a page: the buffers of its tiles stay below WebGPU's default limit, whatever their fields. */
const PAGE_BLOCKS = 1 << 10;

const TEXEL_WORDS = 4;
const USUAL_WORDS = 5; // of a splat, at first
const BAND_ROWS = 1;
const BAND_CODEBOOK = 2;
const FLOAT_MAX = 3.4e38;
const SQUARED = 1 << 24;
const ANTIALIASED = 1 << 25;

export class GpuScene {
  /**
   * @param {Device} device
   * @param {SceneLayout} layout
   * @param {() => void} replaced called when bind groups of the scene are outdated
   */
  constructor(device, layout, replaced) {
    this.device = device;
    this.layout = layout;
    const { tiles } = layout;
    /** First block of each tile. @type {number[]} */
    this.starts = [];
    /** Index of each tile's page. @type {number[]} */
    this.pageOf = [];
    const counts = [0]; // blocks of each page
    this.blockCount = 0;
    for (const { splatCount } of tiles) {
      const blocks = Math.ceil(splatCount / BLOCK);
      const last = counts.length - 1;
      if (counts[last] + blocks > PAGE_BLOCKS) counts.push(blocks);
      else counts[last] += blocks;
      this.pageOf.push(counts.length - 1);
      this.starts.push(this.blockCount);
      this.blockCount += blocks;
    }
    let first = 0;
    /** @type {Page[]} */
    this.pages = counts.map((blocks) => {
      const info = device.uniform(Uint32Array.of(first, 0, 0, 0));
      first += blocks;
      const geometry = new Words(device, USUAL_WORDS * BLOCK * blocks, replaced);
      return { blocks, info, geometry, rows: new Words(device, BLOCK * blocks, replaced) };
    });
    this.tileTable = tiles.length;
    this.blockTable = tiles.length * (1 + TILE_ROWS);
    this.table = device.buffer(16 * (this.blockTable + Math.ceil(this.blockCount / 4)));
    this.tables = new Words(device, TEXEL_WORDS, replaced);
    /** @type {Map<string, {at: number, rows: Rows}>} by codebook and layer */
    this.tableOf = new Map();
    /** @type {Map<string, number>} places of indices by tile and codebook */
    this.indices = new Map();
    this.constants = new Uint32Array(TEXEL_WORDS * TILE_ROWS * tiles.length);
    this.places = new Float32Array(TEXEL_WORDS * tiles.length);
    /** Which tiles are drawn; null for all. @type {Set<number> | null} */
    this.cut = null;
    this.#putBlocks();
  }

  get bytes() {
    const buffers = this.pages.flatMap(({ geometry, rows }) => [geometry.buffer, rows.buffer]);
    return [this.table, this.tables.buffer, ...buffers].reduce((sum, { size }) => sum + size, 0);
  }

  /** Write the tile of each block. */
  #putBlocks() {
    const owners = new Uint32Array(Math.ceil(this.blockCount / 4) * 4);
    this.layout.tiles.forEach(({ splatCount }, tile) => {
      owners.fill(tile, this.starts[tile], this.starts[tile] + Math.ceil(splatCount / BLOCK));
    });
    this.#write(16 * this.blockTable, owners);
  }

  /**
   * @param {number} offset
   * @param {Uint32Array<ArrayBuffer> | Float32Array<ArrayBuffer>} content
   */
  #write(offset, content) {
    if (content.length) this.device.device.queue.writeBuffer(this.table, offset, content);
  }

  /**
   * @param {number} tile
   * @param {GeometryTexels} texels
   */
  putGeometry(tile, texels) {
    const { antialiased, opacityLevels, opacitySquare, quatLevels } = this.layout;
    const { count, bits, scales, sh0 } = texels;
    const page = this.pages[this.pageOf[tile]];
    const word = page.geometry.append(planesOf(texels));
    const flags = (antialiased ? ANTIALIASED : 0) | (opacitySquare ? SQUARED : 0);
    const [x, y, z] = bits.means;
    this.#set(tile, 0, [word, TEXEL_WORDS + texels.moreWords, this.starts[tile], count | flags]);
    this.#set(tile, 1, [
      x | (y << 8) | (z << 16) | (bits.opacities << 24),
      bits.scales | (bits.quats << 8) | (bits.sh0 << 16),
      opacityLevels,
      quatLevels,
    ]);
    this.#set(tile, 2, new Uint32Array(Float32Array.of(...scales.offsets, scales.step).buffer));
    this.#set(tile, 3, new Uint32Array(Float32Array.of(...sh0.offsets, sh0.step).buffer));
    this.#putConstants(tile);
  }

  /**
   * @param {number} codebook
   * @param {number} layer
   * @param {Rows} rows
   */
  putTable(codebook, layer, rows) {
    this.tableOf.set(`${codebook}.${layer}`, { at: this.tables.append(rows.texels), rows });
  }

  /**
   * @param {number} tile
   * @param {number} layer
   * @param {BandTexels} band
   */
  putBand(tile, layer, { rows, codebook }) {
    const store = this.pages[this.pageOf[tile]].rows;
    const rowsAt = rows ? store.append(rows.texels) : 0;
    const rowBits = rows ? rows.bits : 1;
    const table = codebook && this.tableOf.get(`${codebook.id}.${layer}`);
    const head = 2 + 2 * layer;
    if (!codebook || !table) {
      this.#set(tile, head, [BAND_ROWS | (rowBits << 16), 0, 0, rowsAt]);
      this.#setFloats(tile, head + 1, [0, rows ? rows.offset : 0, rows ? rows.step : 0], 0);
    } else {
      const key = `${tile}.${codebook.id}`; // all bands of a codebook have the same indices
      let indexAt = this.indices.get(key);
      if (indexAt === undefined) this.indices.set(key, (indexAt = store.append(codebook.index)));
      const bits = (codebook.indexBits << 2) | (table.rows.bits << 8) | (rowBits << 16);
      this.#set(tile, head, [BAND_CODEBOOK | bits, indexAt, table.at, rowsAt]);
      this.#setFloats(tile, head + 1, [table.rows.offset, rows ? rows.offset : 0, table.rows.step], codebook.size);
    }
    const second = TEXEL_WORDS * (TILE_ROWS * tile + 1) + 1;
    const degree = Math.max(layer, this.constants[second] >>> 24);
    this.constants[second] = (this.constants[second] & 0xffffff) | (degree << 24);
    this.#putConstants(tile);
  }

  /**
   * @param {number} tile
   * @param {number} row
   * @param {ArrayLike<number>} words
   */
  #set(tile, row, words) {
    this.constants.set(words, TEXEL_WORDS * (TILE_ROWS * tile + row));
  }

  /**
   * @param {number} tile
   * @param {number} row
   * @param {number[]} floats
   * @param {number} last
   */
  #setFloats(tile, row, floats, last) {
    this.#set(tile, row, [...new Uint32Array(Float32Array.from(floats).buffer), last]);
  }

  /** @param {number} tile */
  #putConstants(tile) {
    const words = TEXEL_WORDS * TILE_ROWS;
    const constants = this.constants.slice(words * tile, words * (tile + 1));
    if (this.cut && !this.cut.has(tile)) constants[3] = 0; // no splats
    this.#write(16 * (this.tileTable + TILE_ROWS * tile), constants);
  }

  /** @param {Uint32Array} tiles the tiles to draw */
  setCut(tiles) {
    const before = this.cut;
    this.cut = new Set(tiles);
    for (let tile = 0; tile < this.layout.tiles.length; tile++) {
      if (before?.has(tile) !== this.cut.has(tile)) this.#putConstants(tile);
    }
  }

  /**
   * Write the corners of tiles in camera coordinates, computed in binary64 to avoid jitter far from the origin.
   *
   * @param {View} view
   */
  place({ viewmat }) {
    this.layout.tiles.forEach(({ corner, step }, tile) => {
      this.places.set(
        toCamera(
          viewmat,
          corner.map((n) => n * step),
        ),
        TEXEL_WORDS * tile,
      );
      this.places[TEXEL_WORDS * tile + 3] = Math.min(step, FLOAT_MAX);
    });
    this.#write(0, this.places);
  }

  /** Free reserved memory. */
  trim() {
    for (const words of [this.tables, ...this.pages.flatMap(({ geometry, rows }) => [geometry, rows])]) words.trim();
  }

  dispose() {
    this.device.free(this.table);
    this.tables.dispose();
    for (const { info, geometry, rows } of this.pages) {
      this.device.free(info);
      geometry.dispose();
      rows.dispose();
    }
  }
}

/**
 * Return the words of a tile's splats in blocks: 256 first words, 256 second words, and so on.
 *
 * @param {GeometryTexels} texels
 */
function planesOf({ count, first, more, moreWords }) {
  const blocks = Math.ceil(count / BLOCK);
  const stride = TEXEL_WORDS + moreWords;
  const planes = new Uint32Array(blocks * BLOCK * stride);
  for (let splat = 0; splat < count; splat++) {
    let at = Math.floor(splat / BLOCK) * BLOCK * stride + (splat % BLOCK);
    for (let word = 0; word < TEXEL_WORDS; word++, at += BLOCK) planes[at] = first[TEXEL_WORDS * splat + word];
    for (let word = 0; word < moreWords && more; word++, at += BLOCK) planes[at] = more[moreWords * splat + word];
  }
  return planes;
}
