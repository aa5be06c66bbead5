// From decoded layers to what the caller gets.

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

/** The arrays of some tiles, one after the other. */
export class Assembly {
  /**
   * @param {Header} header
   * @param {TileRecord[]} tiles
   * @param {Wanted} wanted
   * @param {Required<Limits>} limits
   * @param {number} tableBytes of all codebooks
   * @param {any} [spare] fields of another one, of floats, whose memory may be used again
   */
  constructor(header, tiles, wanted, limits, tableBytes, spare) {
    const { shDegree, integers, extra } = wanted;
    const count = tiles.reduce((sum, tile) => sum + tile.splatCount, 0);
    const extras = extra ? header.extras : [];
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
   * @param {number} first splat of the arrays that is the tile's first
   */
  put({ blocks, extras }, tile, first) {
    for (const block of blocks) this.arrays.put(block, tile, first);
    this.extras.put(extras, first);
  }

  /**
   * Copy what another assembly has of one tile, which comes from a worker.
   *
   * @param {any} fields of floats
   * @param {number} first
   */
  copy(fields, first) {
    const { arrays } = this;
    if (!(arrays instanceof FloatArrays)) return;
    for (const [name, { array, width }] of arrays.columns()) array.set(fields[name], width * first);
    for (const [name, values] of Object.entries(this.extras.byName())) values.set(fields.extra[name], first);
  }

  fields() {
    return { ...this.arrays.fields(), extra: this.extras.byName(), count: this.count, shDegree: this.wanted.shDegree };
  }
}

/**
 * LIM-1
 *
 * @param {number} count splats
 * @param {number} bytes of arrays and tables
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
