// SPDX-License-Identifier: Apache-2.0
// The memory of one scene on a WebGPU device. csplat_render/gpu/packing.py describes the layout.

import { FADE_STEPS } from '../../codec/js/levels/shown_tiles.mjs';
import { putCorners } from './camera_maths.mjs';
import { bandConstants } from './shader_attributes.mjs';
import { BLOCK_SPLATS } from './texels.mjs';
import { Words } from './webgpu_device.mjs';

/**
 * @typedef {import('./texels.mjs').BandTexels} BandTexels
 * @typedef {import('./texels.mjs').GeometryTexels} GeometryTexels
 * @typedef {import('./texels.mjs').Rows} Rows
 * @typedef {import('./renderer.mjs').SceneLayout} SceneLayout
 * @typedef {import('./types.d.ts').View} View
 * @typedef {import('./webgpu_device.mjs').Device} Device
 *
 * @typedef {{start: number, size: number}} Range
 *
 * Blocks whose tiles' words share two buffers, which are created with the first tile.
 * @typedef {{first: number, blocks: number, info: GPUBuffer, geometry: Words | null, rows: Words | null}} Page
 */

/** Rows of four words per tile in the table of constants. */
const TILE_ROWS = 12;

const TEXEL_WORDS = 4;
const USUAL_WORDS = 5; // of a splat, at first
const SQUARED = 1 << 24;
const ANTIALIASED = 1 << 25;
const FADE_SHIFT = 26; // of the shares that are not drawn

export class GpuScene {
  /**
   * @param {Device} device
   * @param {SceneLayout} layout
   * @param {() => void} replaced called when bind groups of the scene are outdated
   */
  constructor(device, layout, replaced) {
    this.device = device;
    this.layout = layout;
    this.replaced = replaced;
    const { tiles } = layout;
    this.blockCount = 0;
    /** @type {Page[]} */
    this.pages = layout.pages.map((slots) => {
      const [first, blocks] = [this.blockCount, slots / BLOCK_SPLATS];
      this.blockCount += blocks;
      return { first, blocks, info: device.uniform(Uint32Array.of(first, 0, 0, 0)), geometry: null, rows: null };
    });
    /** What each tile takes of its page. @type {Map<number, {page: Page, geometry: Range, rows: Range[]}>} */
    this.held = new Map();
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
    /** Shares of the tiles that are drawn; null for all of all. @type {Map<number, number> | null} */
    this.shares = null;
  }

  get bytes() {
    const words = [this.tables, ...this.pages.flatMap(({ geometry, rows }) => [geometry, rows])];
    return words.reduce((sum, one) => sum + (one?.buffer.size ?? 0), this.table.size);
  }

  /**
   * Write the tile of blocks. A block that is part of no tile may refer to any: it has none of its splats.
   *
   * @param {number} tile
   * @param {number} first block
   * @param {number} count
   */
  #putBlocks(tile, first, count) {
    this.#write(16 * this.blockTable + 4 * first, new Uint32Array(count).fill(tile));
  }

  /**
   * @param {number} offset
   * @param {Uint32Array<ArrayBuffer> | Float32Array<ArrayBuffer>} content
   */
  #write(offset, content) {
    if (content.length) this.device.device.queue.writeBuffer(this.table, offset, content);
  }

  /**
   * @param {number} slot
   * @returns {Page & {geometry: Words, rows: Words}}
   */
  #pageOf(slot) {
    const block = slot / BLOCK_SPLATS;
    const page = this.pages.find(({ first, blocks }) => first <= block && block < first + blocks);
    if (!page) throw new RangeError(`slot ${slot} of ${BLOCK_SPLATS * this.blockCount}`);
    if (page.geometry === null) {
      page.geometry = new Words(this.device, USUAL_WORDS * BLOCK_SPLATS * page.blocks, this.replaced);
      page.rows = new Words(this.device, BLOCK_SPLATS * page.blocks, this.replaced);
      this.replaced();
    }
    return /** @type {Page & {geometry: Words, rows: Words}} */ (page);
  }

  /**
   * @param {number} tile
   * @param {GeometryTexels} texels
   * @param {number} slot of its first splat
   */
  putGeometry(tile, texels, slot) {
    const { antialiased, opacityLevels, opacitySquare, quatLevels } = this.layout;
    const { count, bits, scales, sh0 } = texels;
    const page = this.#pageOf(slot);
    const geometry = page.geometry.append(planesOf(texels));
    this.held.set(tile, { page, geometry, rows: [] });
    const flags = (antialiased ? ANTIALIASED : 0) | (opacitySquare ? SQUARED : 0);
    const [x, y, z] = bits.means;
    this.#set(tile, 0, [geometry.start, TEXEL_WORDS + texels.moreWords, slot / BLOCK_SPLATS, count | flags]);
    this.#set(tile, 1, [
      x | (y << 8) | (z << 16) | (bits.opacities << 24),
      bits.scales | (bits.quats << 8) | (bits.sh0 << 16),
      opacityLevels,
      quatLevels,
    ]);
    this.#set(tile, 2, new Uint32Array(Float32Array.of(...scales.offsets, scales.step).buffer));
    this.#set(tile, 3, new Uint32Array(Float32Array.of(...sh0.offsets, sh0.step).buffer));
    this.#putConstants(tile);
    this.#putBlocks(tile, slot / BLOCK_SPLATS, Math.ceil(count / BLOCK_SPLATS));
  }

  /**
   * @param {number} codebook
   * @param {number} layer
   * @param {Rows} rows
   */
  putTable(codebook, layer, rows) {
    this.tableOf.set(`${codebook}.${layer}`, { at: this.tables.append(rows.texels).start, rows });
  }

  /**
   * @param {number} tile
   * @param {number} layer
   * @param {BandTexels} band
   */
  putBand(tile, layer, { rows, codebook }) {
    const held = this.held.get(tile);
    if (!held?.page.rows) return;
    const store = held.page.rows;
    const append = (/** @type {Uint32Array<ArrayBuffer>} */ words) => {
      const range = store.append(words);
      held.rows.push(range);
      return range.start;
    };
    const rowsAt = rows ? append(rows.texels) : 0;
    const table = codebook && this.tableOf.get(`${codebook.id}.${layer}`);
    const key = `${tile}.${codebook?.id}`; // all bands of a codebook have the same indices
    if (codebook && !this.indices.has(key)) this.indices.set(key, append(codebook.index));
    this.#set(tile, 2 + 2 * layer, bandConstants({ rows, codebook }, table, rowsAt, this.indices.get(key)));
    const second = TEXEL_WORDS * (TILE_ROWS * tile + 1) + 1;
    const degree = Math.max(layer, this.constants[second] >>> 24);
    this.constants[second] = (this.constants[second] & 0xffffff) | (degree << 24);
    this.#putConstants(tile);
  }

  /** @param {number} tile that is freed */
  evict(tile) {
    const held = this.held.get(tile);
    if (!held) return;
    this.held.delete(tile);
    held.page.geometry?.give(held.geometry);
    for (const range of held.rows) held.page.rows?.give(range);
    for (const key of this.indices.keys()) if (key.startsWith(`${tile}.`)) this.indices.delete(key);
    this.constants.fill(0, TEXEL_WORDS * TILE_ROWS * tile, TEXEL_WORDS * TILE_ROWS * (tile + 1));
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

  /** @param {number} tile */
  #putConstants(tile) {
    const words = TEXEL_WORDS * TILE_ROWS;
    const constants = this.constants.slice(words * tile, words * (tile + 1));
    const shares = this.shares ? (this.shares.get(tile) ?? 0) : FADE_STEPS;
    constants[3] = shares === 0 ? 0 : constants[3] | ((FADE_STEPS - shares) << FADE_SHIFT); // 0: no splats
    this.#write(16 * (this.tileTable + TILE_ROWS * tile), constants);
  }

  putOrder() {}

  /** @param {Map<number, number>} shares of the tiles to draw */
  setShares(shares) {
    const before = this.shares;
    this.shares = shares;
    for (let tile = 0; tile < this.layout.tiles.length; tile++) {
      if (before === null || before.get(tile) !== shares.get(tile)) this.#putConstants(tile);
    }
  }

  /** Write the corners of tiles, see `putCorners`. @param {View} view */
  place({ viewmat }) {
    putCorners(this.layout.tiles, viewmat, this.places);
    this.#write(0, this.places);
  }

  /** Free reserved memory. */
  trim() {
    for (const words of [this.tables, ...this.pages.flatMap(({ geometry, rows }) => [geometry, rows])]) words?.trim();
  }

  dispose() {
    this.device.free(this.table);
    this.tables.dispose();
    for (const { info, geometry, rows } of this.pages) {
      this.device.free(info);
      geometry?.dispose();
      rows?.dispose();
    }
  }
}

/**
 * Return the words of a tile's splats in blocks: 256 first words, 256 second words, and so on.
 *
 * @param {GeometryTexels} texels
 */
function planesOf({ count, first, more, moreWords }) {
  const blocks = Math.ceil(count / BLOCK_SPLATS);
  const stride = TEXEL_WORDS + moreWords;
  const planes = new Uint32Array(blocks * BLOCK_SPLATS * stride);
  for (let splat = 0; splat < count; splat++) {
    let at = Math.floor(splat / BLOCK_SPLATS) * BLOCK_SPLATS * stride + (splat % BLOCK_SPLATS);
    for (let word = 0; word < TEXEL_WORDS; word++, at += BLOCK_SPLATS) planes[at] = first[TEXEL_WORDS * splat + word];
    for (let word = 0; word < moreWords && more; word++, at += BLOCK_SPLATS)
      planes[at] = more[moreWords * splat + word];
  }
  return planes;
}
