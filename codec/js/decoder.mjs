// SPDX-License-Identifier: Apache-2.0
// Decoder of the csplat format, from spec/format.md. No dependencies. Runs in browsers, workers and Node 20.
//
//   import { CsplatReader, decode, readHeader } from './decoder.mjs';
//   const scene = await decode(url);                // the whole scene as Float32Arrays; also of bytes, a Response, a stream
//   const reader = await CsplatReader.open(url);    // header and index, then only the parts that are read
//   const tile = await reader.readTile(0, { shDegree: 1 });
//   const tiles = await reader.cut({ maxSplats: 1e6 }); // of a coarser version of the scene, if the file has one

import { Assembly } from './assemble.mjs';
import { readFileHeader } from './container.mjs';
import { CsplatError, FormatError, InputError, LimitError, UnsupportedError, fault } from './errors.mjs';
import { readIndex } from './file_index.mjs';
import { checkedDegree, checkedForm, checkedLimits, checkedTiles, toBytes } from './options.mjs';
import { Reader } from './reader.mjs';
import * as spec from './spec.mjs';
import { allTiles } from './tile_records.mjs';
import { selectTiles } from './tree.mjs';
import { byWorkers } from './workers.mjs';

export { CsplatError, FormatError, InputError, LimitError, UnsupportedError };

/**
 * @typedef {import('./decoder.d.ts').DecodeOptions} DecodeOptions
 * @typedef {import('./decoder.d.ts').Header} Header
 * @typedef {import('./decoder.d.ts').Limits} Limits
 * @typedef {import('./decoder.d.ts').CutOptions} CutOptions
 * @typedef {import('./decoder.d.ts').TileRecord} TileRecord
 * @typedef {import('./decoder.d.ts').TilesOptions} TilesOptions
 * @typedef {import('./tile_blocks.mjs').SceneContext} SceneContext
 */

/**
 * Read and check header and index.
 *
 * @param {ArrayBuffer | ArrayBufferView} data a file, or the beginning of a file up to at least the end of the index
 * @param {{limits?: Limits}} [options]
 * @returns {Header}
 */
export function readHeader(data, options = {}) {
  const bytes = toBytes(data);
  const limits = checkedLimits(options.limits);
  const file = readFileHeader(bytes, limits.resourceLevel);
  if (bytes.length < file.end) {
    throw fault(
      spec.ERROR_TRUNCATED,
      bytes.length,
      'HDR-5',
      `the index ends at ${file.end}, the data has ${bytes.length} bytes`,
    );
  }
  return readIndex(bytes.subarray(spec.HEADER_SIZE, file.end), file, limits);
}

/**
 * Decode a whole file and check all of its checksums. decoder.d.ts describes the options and the result.
 *
 * @param {import('./decoder.d.ts').FileSource} data
 * @param {DecodeOptions} [options]
 * @returns {Promise<any>} Scene, or IntegerScene for the form 'integers'
 */
export async function decode(data, options = {}) {
  const { inflate, signal, onProgress } = options;
  const integers = checkedForm(options.form);
  const reader = await Reader.open(data, { ...options, onProgress: undefined }, true);
  const { header } = reader;
  // 9.2: the integer arrays have "all tiles of all levels concatenated".
  const tiles = integers && options.tiles === undefined ? allTiles(header) : checkedTiles(options.tiles, header);
  const shDegree = checkedDegree(options.shDegree, header);
  const wanted = { shDegree, integers, extra: true };
  const assembly = new Assembly(header, tiles, wanted, reader.limits, reader.tableBytes);
  reader.scratch = reused(shDegree);
  try {
    let filled = 0;
    const done = (/** @type {TileRecord} */ { splatCount }) => {
      filled += splatCount;
      onProgress?.(filled, assembly.count);
    };
    const places = new Map();
    let first = 0;
    for (const tile of tiles) {
      places.set(tile, first);
      first += tile.splatCount;
    }
    const waiting = [...tiles].reverse();
    const workers = new Set();
    /** @type {object[]} */
    const spares = [];
    const most = integers || inflate ? 0 : (options.workers ?? 0);
    for await (const { tile, fields, worker } of byWorkers(reader, waiting, wanted, most, signal, spares)) {
      assembly.copy(fields, places.get(tile));
      spares.push({ ...fields, extra: {} });
      workers.add(worker);
      done(tile);
    }
    for (let tile = waiting.pop(); tile; tile = waiting.pop()) {
      await reader.fill(assembly, tile, places.get(tile), signal);
      done(tile);
    }
    await reader.checkAll();
    const checks = reader.checks;
    return { ...assembly.fields(), header, ...(await reader.describe()), checks, workers: workers.size };
  } finally {
    reader.compiled?.close();
    reader.source.close?.();
  }
}

/** Reads parts of a file and checks the CRC of each. */
export class CsplatReader extends Reader {
  /**
   * @param {Parameters<typeof Reader.open>[0]} from
   * @param {Parameters<typeof Reader.open>[1]} [options]
   * @returns {Promise<CsplatReader>}
   */
  static open(from, options) {
    return /** @type {Promise<CsplatReader>} */ (super.open(from, options));
  }

  /**
   * Select the tiles of a version of the scene, of a part of space if there is a box.
   *
   * @param {CutOptions} [options]
   * @returns {Promise<number[]>} indices, ascending
   */
  async cut(options = {}) {
    return selectTiles(await this.nodes(), this.header, options);
  }

  /**
   * Read tiles in order, or with workers in the order in which they are done.
   *
   * @param {TilesOptions} [options]
   * @returns {AsyncGenerator<any, void>} results of `readTile`, with the tile's `index`
   */
  async *readTiles({ tiles, shDegree, extra = false, form, workers = 0, signal } = {}) {
    const waiting = [...checkedTiles(tiles, this.header)].reverse();
    const wanted = { form, shDegree: checkedDegree(shDegree, this.header), extra: extra && form !== 'packed' };
    const most = (form !== 'packed' && checkedForm(form)) || this.inflates ? 0 : workers;
    for await (const { tile, fields } of byWorkers(this, waiting, wanted, most, signal)) {
      yield { index: tile.index, ...fields };
    }
    for (let tile = waiting.pop(); tile; tile = waiting.pop()) {
      signal?.throwIfAborted();
      yield { index: tile.index, ...(await this.readTile(tile.index, { ...wanted, signal })) };
    }
  }
}

/**
 * Return a function that reuses the same arrays for every tile and band: allocating them costs more than decoding.
 *
 * @param {number} shDegree
 * @returns {(key: number, length: number) => Float64Array<ArrayBuffer>}
 */
function reused(shDegree) {
  /** @type {Map<number, Float64Array<ArrayBuffer>>} */
  const arrays = new Map();
  return (key, length) => {
    const band = Math.abs(key) - spec.ATTRIBUTE_SH0;
    const place = band > 0 ? Math.sign(key) * spec.ATTRIBUTE_SH1 : key;
    const most = band > 0 ? (length / (2 * band + 1)) * (2 * shDegree + 1) : length; // length for the highest band
    const known = arrays.get(place);
    const array = known && known.length >= length ? known : new Float64Array(most);
    arrays.set(place, array);
    return array.subarray(0, length);
  };
}
