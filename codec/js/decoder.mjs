// Decoder of the csplat format, from spec/format.md. No dependencies: browsers, workers, Node 20.
//
//   import { CsplatReader, decode, readHeader } from './decoder.mjs';
//   const scene = await decode(bytes);              // the whole scene as Float32Arrays
//   const reader = await CsplatReader.open(url);    // header and index, then the parts that are asked for
//   const tile = await reader.readTile(0, { shDegree: 1 });

import { Assembly } from './assemble.mjs';
import { readFileHeader } from './container.mjs';
import { CsplatError, FormatError, InputError, LimitError, UnsupportedError, fault } from './errors.mjs';
import { readIndex } from './index.mjs';
import { checkedDegree, checkedForm, checkedLimits, checkedTiles, toBytes } from './options.mjs';
import { CsplatReader } from './reader.mjs';
import * as spec from './spec.mjs';
import { MemorySource } from './whole.mjs';
import { byWorkers } from './workers.mjs';

export { CsplatError, CsplatReader, FormatError, InputError, LimitError, UnsupportedError };

/**
 * @typedef {import('./decoder.d.ts').DecodeOptions} DecodeOptions
 * @typedef {import('./decoder.d.ts').Header} Header
 * @typedef {import('./decoder.d.ts').Limits} Limits
 * @typedef {import('./decoder.d.ts').TileRecord} TileRecord
 * @typedef {import('./tile.mjs').SceneContext} SceneContext
 */

/**
 * Read and check header and index.
 *
 * @param {ArrayBuffer | ArrayBufferView} data a file, or the beginning of one with the whole index
 * @param {{limits?: Limits}} [options]
 * @returns {Header}
 */
export function readHeader(data, options = {}) {
  const bytes = toBytes(data);
  const file = readFileHeader(bytes);
  if (bytes.length < file.end) {
    throw fault(
      spec.ERROR_TRUNCATED,
      bytes.length,
      'HDR-5',
      `the index ends at ${file.end}, ${bytes.length} bytes are here`,
    );
  }
  return readIndex(bytes.subarray(spec.HEADER_SIZE, file.end), file, checkedLimits(options.limits));
}

/**
 * Decode a whole file, all of its checksums checked. decoder.d.ts describes the options and what comes back.
 *
 * @param {ArrayBuffer | ArrayBufferView} data
 * @param {DecodeOptions} [options]
 * @returns {Promise<any>} Scene, or IntegerScene for the form 'integers'
 */
export async function decode(data, options = {}) {
  const { limits, inflate, signal, onProgress } = options;
  const source = new MemorySource(toBytes(data));
  const integers = checkedForm(options.form);
  const reader = await CsplatReader.open(source, { limits, inflate });
  const { header } = reader;
  const tiles = checkedTiles(options.tiles, header);
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
    const most = integers || inflate ? 0 : (options.workers ?? 0);
    for await (const { tile, fields, worker } of byWorkers(reader, waiting, wanted, most, signal)) {
      assembly.copy(fields, places.get(tile));
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
  }
}

/**
 * Arrays that tile after tile uses again, and band after band: fresh memory costs more than what is done with it.
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
    const most = band > 0 ? (length / (2 * band + 1)) * (2 * shDegree + 1) : length; // what the highest band takes
    const known = arrays.get(place);
    const array = known && known.length >= length ? known : new Float64Array(most);
    arrays.set(place, array);
    return array.subarray(0, length);
  };
}
