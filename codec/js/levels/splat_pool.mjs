// SPDX-License-Identifier: Apache-2.0
// Tiles in the arrays of an engine: a pool of splats, parts of which are taken by tiles and given back.

import { Ranges } from './ranges.mjs';
import { FADE_STEPS } from './shown_tiles.mjs';

/**
 * @typedef {import('../decoder.d.ts').Packed} Packed
 * @typedef {import('./level_scene.mjs').LoadedTile} LoadedTile
 *
 * Arrays of an engine. `put` and `putBand` write from a splat on, `fade` opacities alone, see `fadedAlpha`; `clear` makes splats
 * invisible and their SH zero; `flush` is called with the ranges that have changed, as first splat and count, those of which
 * only opacities have, and the number of splats up to the last that was ever used.
 *
 * @typedef {object} SplatArrays
 * @property {(tile: LoadedTile, first: number) => void} put
 * @property {(tile: LoadedTile, first: number, shares: number) => void} fade
 * @property {(layer: number, band: Packed, first: number, count: number) => void} putBand
 * @property {(first: number, count: number) => void} clear
 * @property {(changed: [number, number][], faded: [number, number][], end: number) => void} flush
 */

const SLACK = 1.125; // room beyond the splats that are drawn, since free ranges may be too small

/**
 * Return the number of splats of a pool.
 *
 * @param {import('./tile_stream.mjs').TileStream} stream
 */
export function poolSize({ budget, all: tiles }) {
  const counts = tiles.map(({ splatCount }) => splatCount);
  const all = counts.reduce((sum, count) => sum + count, 0);
  return Math.min(all, Math.ceil(SLACK * budget) + counts.reduce((most, count) => Math.max(most, count), 0));
}

/** A pool of splats; the target of a LevelScene. */
export class SplatPool {
  /**
   * @param {number} size splats
   * @param {SplatArrays} arrays initially clear
   */
  constructor(size, arrays) {
    this.size = size;
    this.arrays = arrays;
    this.ranges = new Ranges([size]);
    /** Tiles and their places. @type {Map<number, {tile: LoadedTile, shares: number, first: number}>} */
    this.places = new Map();
    /** @type {[number, number][]} */
    this.changed = [];
    /** @type {[number, number][]} */
    this.faded = [];
  }

  /** @param {number} index */
  hide(index) {
    const place = this.places.get(index);
    if (!place) return;
    this.places.delete(index);
    this.#free(place);
  }

  /**
   * @param {number} index
   * @param {LoadedTile} tile
   * @param {number} shares
   */
  show(index, tile, shares) {
    if (this.#put(index, tile, shares)) return;
    const all = [...this.places, /** @type {const} */ ([index, { tile, shares, first: 0 }])]; // there is no free range
    for (const place of this.places.values()) this.#free(place);
    this.places.clear();
    for (const [one, place] of all) this.#put(one, place.tile, place.shares);
  }

  /**
   * @param {number} index
   * @param {number} shares
   */
  fade(index, shares) {
    const place = this.places.get(index);
    if (!place) return;
    place.shares = shares;
    this.arrays.fade(place.tile, place.first, shares);
    this.faded.push([place.first, place.tile.count]);
  }

  /**
   * @param {number} index
   * @param {number} layer
   * @param {Packed} band
   */
  band(index, layer, band) {
    const place = this.places.get(index);
    if (!place) return;
    this.arrays.putBand(layer, band, place.first, place.tile.count);
    this.changed.push([place.first, place.tile.count]);
  }

  flush() {
    this.arrays.flush(this.changed, this.faded, this.ranges.end);
    this.changed = [];
    this.faded = [];
  }

  /**
   * @param {number} index
   * @param {LoadedTile} tile
   * @param {number} shares
   * @returns {boolean} whether there is room for it
   */
  #put(index, tile, shares) {
    const first = this.ranges.take(tile.count);
    if (first === null) return false;
    this.places.set(index, { tile, shares, first });
    this.arrays.put(tile, first);
    if (shares < FADE_STEPS) this.arrays.fade(tile, first, shares);
    for (const [i, band] of tile.sh.entries()) if (band) this.arrays.putBand(i + 1, band, first, tile.count);
    this.changed.push([first, tile.count]);
    return true;
  }

  /** @param {{tile: LoadedTile, first: number}} place */
  #free({ tile: { count }, first }) {
    this.arrays.clear(first, count);
    this.ranges.give(first, count);
    this.changed.push([first, count]);
  }
}
