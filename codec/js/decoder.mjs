// Decoder of the csplat format, from spec/format.md. No dependencies: browsers, workers, Node 20.
//
//   import { CsplatReader, decode, readHeader } from './decoder.mjs';
//   const scene = await decode(bytes);              // the whole scene as Float32Arrays
//   const reader = await CsplatReader.open(url);    // header and index, then the parts that are asked for
//   const tile = await reader.readTile(0, { shDegree: 1 });

import { describe, emptyDescription } from './ancillary.mjs';
import { Assembly, codebooksById } from './assemble.mjs';
import { readTable, tableBytes } from './codebooks.mjs';
import { checkFileSize, openChunk, readFileHeader } from './container.mjs';
import { CsplatError, FormatError, InputError, LimitError, UnsupportedError, fault } from './errors.mjs';
import { readIndex } from './index.mjs';
import { platformInflate } from './inflate.mjs';
import { checkedDegree, checkedForm, checkedLimits, checkedTiles, toBytes } from './options.mjs';
import { CsplatReader } from './reader.mjs';
import * as spec from './spec.mjs';
import { Tile } from './tile.mjs';

export { CsplatError, CsplatReader, FormatError, InputError, LimitError, UnsupportedError };

/**
 * @typedef {import('./decoder.d.ts').DecodeOptions} DecodeOptions
 * @typedef {import('./decoder.d.ts').Header} Header
 * @typedef {import('./decoder.d.ts').Limits} Limits
 * @typedef {import('./codebooks.mjs').Table} Table
 * @typedef {import('./tile.mjs').SceneContext} SceneContext
 * @typedef {Uint8Array<ArrayBuffer>} Bytes
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
  const bytes = toBytes(data);
  const limits = checkedLimits(options.limits);
  const integers = checkedForm(options.form);
  const file = readFileHeader(bytes);
  checkFileSize(bytes.length, file);
  const header = readIndex(bytes.subarray(spec.HEADER_SIZE, file.end), file, limits);
  const tiles = checkedTiles(options.tiles, header);
  const shDegree = checkedDegree(options.shDegree, header);
  const codebooks = codebooksById(header.codebooks);
  const wanted = { shDegree, integers, extra: true };
  const assembly = new Assembly(header, tiles, wanted, limits, tableBytes(header.directory, codebooks));
  const payloads = openChunks(bytes, header);
  const scene = { header, codebooks, inflate: options.inflate ?? (await platformInflate()) };
  const { table, description } = await readDirectory(scene, payloads, limits.jsonBytes);
  const scratch = reused(shDegree);
  let first = 0;
  for (const record of tiles) {
    options.signal?.throwIfAborted();
    const tile = new Tile({ ...scene, table, scratch }, record, async () => {}); // lower layers have been decoded before
    for (const place of record.layers) {
      if (place.layer > shDegree && place.layer !== spec.LAYER_EXTRA) continue;
      assembly.put(await tile.readLayer(payloads(place), place, integers), record, first);
    }
    first += record.splatCount;
    options.onProgress?.(first, assembly.count);
  }
  const chunks = header.directory.length + header.tiles.reduce((sum, { layers }) => sum + layers.length, 0);
  return { ...assembly.fields(), header, ...description, checks: { header: true, index: true, chunks } };
}

/**
 * CHK-2: "A decoder of a whole file MUST check the CRC of all chunks, known or not."
 *
 * @param {Bytes} bytes
 * @param {Header} header
 * @returns {(place: {offset: number}) => Bytes} the payload of a chunk of the index
 */
function openChunks(bytes, header) {
  /** @type {Map<number, Bytes>} */
  const payloads = new Map();
  for (const places of [header.directory, ...header.tiles.map(({ layers }) => layers)]) {
    for (const place of places) {
      payloads.set(place.offset, openChunk(bytes.subarray(place.offset, place.offset + place.size), place));
    }
  }
  return ({ offset }) => /** @type {Bytes} */ (payloads.get(offset));
}

/**
 * Read every chunk of the directory that this version knows. CHK-2: "read all CODB chunks, used or not".
 *
 * @param {Pick<SceneContext, 'header' | 'codebooks' | 'inflate'>} scene
 * @param {ReturnType<typeof openChunks>} payloads
 * @param {number} jsonBytes
 */
async function readDirectory({ header, codebooks, inflate }, payloads, jsonBytes) {
  const description = emptyDescription();
  /** @type {Map<string, Table>} */
  const tables = new Map();
  for (const record of header.directory) {
    const codebook = codebooks.get(record.id);
    if (record.type === spec.CHUNK_CODEBOOK && codebook) {
      const { attributes } = header;
      const table = await readTable(payloads(record), record, codebook, attributes, inflate);
      tables.set(`${record.id}.${record.layer}`, table);
    } else if (Object.hasOwn(spec.CHUNK_NAMES, record.type)) {
      await describe(description, record, payloads(record), { splatCount: header.splatCount, jsonBytes, inflate });
    }
  }
  /** @type {SceneContext['table']} */
  const table = async (id, layer) => /** @type {Table} */ (tables.get(`${id}.${layer}`)); // DIR-5: there is one
  return { description, table };
}

/**
 * Arrays that tile after tile uses again, and band after band: fresh memory costs more than what is done with it.
 *
 * @param {number} shDegree
 * @returns {SceneContext['scratch']}
 */
function reused(shDegree) {
  /** @type {Map<number, Float64Array>} */
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
