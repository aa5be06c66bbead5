// SPDX-License-Identifier: Apache-2.0
// Assembles decoded layers into the arrays that the caller gets.

import { FloatArrays, IntegerArrays, arrayBytes } from './arrays.mjs';
import { allocate, fault } from './errors.mjs';
import { ExtraArrays } from './extras.mjs';
import * as spec from './spec.mjs';

/**
 * @typedef {import('./decoder.d.ts').Header} Header
 * @typedef {import('./decoder.d.ts').Limits} Limits
 * @typedef {import('./decoder.d.ts').TileRecord} TileRecord
 * @typedef {import('./tile_blocks.mjs').Layer} Layer
 * @typedef {{shDegree: number, integers: boolean, extra: boolean}} Wanted
 */

/** The arrays of some tiles, concatenated. */
export class Assembly {
  /**
   * @param {Header} header
   * @param {TileRecord[]} tiles
   * @param {Wanted} wanted
   * @param {Required<Limits>} limits
   * @param {number} tableBytes size of all codebooks
   * @param {any} [spare] float fields of another assembly whose memory may be reused
   */
  constructor(header, tiles, wanted, limits, tableBytes, spare) {
    const { shDegree, integers, extra } = wanted;
    const count = tiles.reduce((sum, tile) => sum + tile.splatCount, 0);
    const hasExtras = extra && tiles.every(({ level }) => level === 0); // TIL-5: tiles of coarser levels have none
    const extras = hasExtras ? header.extras : [];
    checkBudget(count, arrayBytes(count, shDegree, extras, integers) + tableBytes, limits);
    this.count = count;
    this.wanted = wanted;
    this.arrays = allocate(() =>
      integers
        ? new IntegerArrays(count, shDegree, tiles, spec.ATTRIBUTE_SH0 + shDegree)
        : new FloatArrays(count, shDegree, spare),
    );
    this.extras = allocate(() => new ExtraArrays(count, extras));
  }

  /**
   * @param {Layer} layer
   * @param {TileRecord} tile
   * @param {number} first index in the arrays of the tile's first splat
   */
  put({ layer, blocks, extra }, tile, first) {
    for (const block of blocks) this.arrays.put(block, tile, first);
    if (extra) this.extras.put(layer, extra, tile.splatCount, first);
  }

  /**
   * Copy the fields of another assembly, which holds one tile and comes from a worker.
   *
   * @param {any} fields floats
   * @param {number} first
   */
  copy(fields, first) {
    const { arrays } = this;
    if (!(arrays instanceof FloatArrays)) return;
    for (const [name, { array, width }] of arrays.columns()) array.set(fields[name], width * first);
    for (const [name, values] of Object.entries(this.extras.byName())) {
      const components = values.length / this.count;
      values.set(fields.extra[name], components * first);
    }
  }

  fields() {
    return { ...this.arrays.fields(), extra: this.extras.byName(), count: this.count, shDegree: this.wanted.shDegree };
  }
}

/**
 * Refuse a decode beyond the budget (LIM-1).
 *
 * @param {number} count splats
 * @param {number} bytes size of arrays and tables
 * @param {Required<Limits>} limits
 */
export function checkBudget(count, bytes, limits) {
  const at = spec.HEADER_SIZE + spec.INDEX_HEAD_OFFSETS.splat_count;
  if (count > limits.splats)
    throw fault(spec.ERROR_LIMIT, at, 'LIM-1', `${count} splats, the budget is ${limits.splats}`);
  if (bytes > limits.bytes) {
    throw fault(spec.ERROR_LIMIT, at, 'LIM-1', `arrays and tables of ${bytes} bytes, the budget is ${limits.bytes}`);
  }
}

/** @param {Header['codebooks']} codebooks */
export const codebooksById = (codebooks) => new Map(codebooks.map((codebook) => [codebook.id, codebook]));
