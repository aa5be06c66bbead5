// SPDX-License-Identifier: Apache-2.0
// The textures of one scene: attributes as the tiles' integers, codebooks as tables, constants of tiles, and the order.

import { FADE_STEPS } from '../../codec/js/levels/shown_tiles.mjs';
import { putCorners } from './camera_maths.mjs';
import { BLOCK_SPLATS } from './texels.mjs';
import { UNITS } from './shader_programs.mjs';
import { FADE_SHIFT, bandConstants, tileTexels } from './shader_attributes.mjs';
import { Records } from './framebuffers.mjs';
import { LinearTexture, Store, formats } from './textures.mjs';

/**
 * @typedef {import('./texels.mjs').BandTexels} BandTexels
 * @typedef {import('./texels.mjs').GeometryTexels} GeometryTexels
 * @typedef {import('./texels.mjs').Rows} Rows
 * @typedef {import('./renderer.mjs').SceneLayout} SceneLayout
 * @typedef {import('./types.d.ts').View} View
 */

export class SceneTextures {
  /**
   * @param {WebGL2RenderingContext} gl
   * @param {SceneLayout} layout
   * @param {number} splatsMax
   */
  constructor(gl, layout, splatsMax) {
    const { tiles } = layout;
    const slotCount = layout.pages.reduce((sum, slots) => sum + slots, 0);
    if (slotCount > splatsMax) throw new RangeError(`${slotCount} splats, this GPU can hold ${splatsMax}`);
    const { words, word, floats } = formats(gl);
    this.gl = gl;
    this.layout = layout;
    this.first = new LinearTexture(gl, words, slotCount);
    this.store = new Store(gl, words);
    this.tileTexels = tileTexels(layout.shDegree);
    this.tiles = new LinearTexture(gl, words, this.tileTexels * tiles.length);
    this.places = new LinearTexture(gl, floats, tiles.length);
    this.blocks = new LinearTexture(gl, word, slotCount / BLOCK_SPLATS);
    this.order = new LinearTexture(gl, word, Math.min(slotCount, layout.drawn));
    this.records = new Records(gl, Math.min(slotCount, layout.drawn));
    this.count = 0; // number of splats in the order
    this.constants = new Uint32Array(4 * this.tileTexels * tiles.length);
    this.constantFloats = new Float32Array(this.constants.buffer);
    this.corners = new Float32Array(4 * tiles.length);
    /** @type {Map<string, {at: number, rows: Rows}>} by codebook and layer */
    this.tables = new Map();
    /** @type {Map<string, number>} offsets of the indices, by tile and codebook */
    this.indices = new Map();
    /** Ranges of the store that each tile takes. @type {Map<number, {start: number, size: number}[]>} */
    this.held = new Map();
  }

  get bytes() {
    const textures = [this.first, this.store.linear, this.tiles, this.places, this.blocks];
    return textures.reduce((sum, { bytes }) => sum + bytes, 0);
  }

  /**
   * @param {number} tile
   * @param {GeometryTexels} texels
   * @param {number} slot of its first splat
   */
  putGeometry(tile, { count, first, more, moreWords, bits, scales, sh0 }, slot) {
    const block = slot / BLOCK_SPLATS;
    this.first.write(slot, first);
    this.blocks.write(block, new Uint32Array(Math.ceil(count / BLOCK_SPLATS)).fill(tile));
    const [x, y, z] = bits.means;
    const at = 4 * this.tileTexels * tile;
    this.constants.set(
      [
        x | (y << 5) | (z << 10) | (bits.quats << 15) | (bits.opacities << 20),
        bits.scales | (bits.sh0 << 8),
        more ? this.#append(tile, more) : 0,
        moreWords | (block << 4),
      ],
      at,
    );
    this.constantFloats.set([...scales.offsets, scales.step, ...sh0.offsets, sh0.step], at + 4);
    this.putConstants(tile);
  }

  /**
   * @param {number} codebook
   * @param {number} layer
   * @param {Rows} rows
   */
  putTable(codebook, layer, rows) {
    this.tables.set(`${codebook}.${layer}`, { at: this.store.append(rows.texels).start, rows });
  }

  /**
   * @param {number} tile
   * @param {number} layer
   * @param {BandTexels} band
   */
  putBand(tile, layer, { rows, codebook }) {
    const rowsAt = rows ? this.#append(tile, rows.texels) : 0;
    const table = codebook && this.tables.get(`${codebook.id}.${layer}`);
    const key = `${tile}.${codebook?.id}`; // all bands of a codebook have the same indices
    if (codebook && !this.indices.has(key)) this.indices.set(key, this.#append(tile, codebook.index));
    const words = bandConstants({ rows, codebook }, table, rowsAt, this.indices.get(key));
    this.constants.set(words, 4 * (this.tileTexels * tile + 1 + 2 * layer));
    this.putConstants(tile);
  }

  /**
   * Append texels of a tile to the store, and return the position of the first.
   *
   * @param {number} tile
   * @param {Uint32Array} texels
   */
  #append(tile, texels) {
    const range = this.store.append(texels);
    this.held.set(tile, [...(this.held.get(tile) ?? []), range]);
    return range.start;
  }

  /** @param {number} tile that is freed; the order has none of its splats */
  evict(tile) {
    for (const range of this.held.get(tile) ?? []) this.store.give(range);
    this.held.delete(tile);
    for (const key of this.indices.keys()) if (key.startsWith(`${tile}.`)) this.indices.delete(key);
    const first = 4 * this.tileTexels * tile;
    this.constants.fill(0, first, first + 4 * this.tileTexels);
  }

  /** @param {Map<number, number>} shares of the tiles that are drawn */
  setShares(shares) {
    for (const [tile, some] of shares) {
      const at = 4 * this.tileTexels * tile;
      const word = (this.constants[at] % 2 ** FADE_SHIFT) + (FADE_STEPS - some) * 2 ** FADE_SHIFT;
      if (word === this.constants[at]) continue;
      this.constants[at] = word;
      this.putConstants(tile);
    }
  }

  /** @param {number} tile */
  putConstants(tile) {
    const first = this.tileTexels * tile;
    this.tiles.write(first, this.constants.subarray(4 * first, 4 * (first + this.tileTexels)));
  }

  /**
   * @param {Uint32Array} order
   * @param {number} count
   */
  putOrder(order, count) {
    if (count > this.order.width * this.order.rows) this.order.resize(count);
    this.order.write(0, order.subarray(0, count));
    this.count = count;
  }

  /** Write the corners of tiles, see `putCorners`. @param {View} view */
  putPlaces({ viewmat }) {
    const { corners, layout } = this;
    putCorners(layout.tiles, viewmat, corners);
    this.places.write(0, corners);
  }

  /** Bind all textures that the shaders read. */
  bind() {
    const { gl } = this;
    const textures = {
      uFirst: this.first,
      uStore: this.store.linear,
      uTiles: this.tiles,
      uPlaces: this.places,
      uBlocks: this.blocks,
      uOrder: this.order,
    };
    for (const [name, { texture }] of Object.entries(textures)) {
      gl.activeTexture(gl.TEXTURE0 + UNITS[/** @type {keyof typeof UNITS} */ (name)]);
      gl.bindTexture(gl.TEXTURE_2D, texture);
    }
    this.records.bind();
  }

  dispose() {
    for (const linear of [this.first, this.store.linear, this.tiles, this.places, this.blocks, this.order]) {
      linear.dispose();
    }
    this.records.dispose();
  }
}
