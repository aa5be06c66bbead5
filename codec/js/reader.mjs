// SPDX-License-Identifier: Apache-2.0
// Reads tiles and layers of a file one by one in any order, over HTTP Range, from a Blob or from memory.
//
// This reader contains two complete decoders: WebAssembly (wasm_decoder.mjs) and JavaScript (tile_blocks.mjs). JavaScript
// decodes if the page's content security policy forbids WebAssembly, for integers, and to locate errors.

import { describe, emptyDescription } from './ancillary.mjs';
import { replaced } from './answers.mjs';
import { FloatArrays, arrayBytes, bandArray } from './arrays.mjs';
import { Assembly, checkBudget, codebooksById } from './assemble.mjs';
import { CRC_SIZE } from './checksums.mjs';
import { readTable, tableBytes } from './codebooks.mjs';
import { WasmDecoder } from './wasm_decoder.mjs';
import { checkFileSize, openChunk, readFileHeader } from './container.mjs';
import { FormatError, InputError } from './errors.mjs';
import { checkIndexBudget, readIndex } from './file_index.mjs';
import { isKnown } from './extras.mjs';
import { checkedInflate, platformInflate } from './inflate.mjs';
import { checkedDegree, checkedForm, checkedLimits, checkedTile } from './options.mjs';
import { packLayer } from './packed_layers.mjs';
import { Payload } from './payload.mjs';
import { openSource } from './source.mjs';
import * as spec from './spec.mjs';
import { Tile } from './tile_blocks.mjs';
import { abortable, wayOf } from './transport.mjs';
import { readNodes } from './tree.mjs';

const OUTDATED = [spec.ERROR_CRC, spec.ERROR_TRUNCATED, spec.ERROR_TRAILING]; // also caused by parts of two files
const FIRST_BYTES = 1 << 16; // bytes; header and index of most files up to about thirty million splats

/**
 * @typedef {import('./decoder.d.ts').ByteSource} ByteSource
 * @typedef {import('./decoder.d.ts').ChunkPlace} ChunkPlace
 * @typedef {import('./decoder.d.ts').CodebookRecord} CodebookRecord
 * @typedef {import('./decoder.d.ts').DirectoryRecord} DirectoryRecord
 * @typedef {import('./decoder.d.ts').Header} Header
 * @typedef {import('./decoder.d.ts').Limits} Limits
 * @typedef {import('./decoder.d.ts').LayerForm} LayerForm
 * @typedef {import('./decoder.d.ts').LayerRecord} LayerRecord
 * @typedef {import('./decoder.d.ts').LayerRequest} LayerRequest
 * @typedef {import('./decoder.d.ts').ReaderOptions} ReaderOptions
 * @typedef {import('./decoder.d.ts').ReadOptions} ReadOptions
 * @typedef {import('./decoder.d.ts').TileRecord} TileRecord
 * @typedef {import('./decoder.d.ts').TreeNode} TreeNode
 * @typedef {import('./codebooks.mjs').Table} Table
 * @typedef {import('./inflate.mjs').Inflate} Inflate
 * @typedef {Uint8Array<ArrayBuffer>} Bytes
 *
 * A source; those of this package can tell whether their file was replaced, and end their requests.
 *
 * @typedef {ByteSource & {transport?: {url: string}, isOther?: (offset: number, bytes: Bytes) => Promise<boolean>, close?: () => void}} Source
 */

/**
 * Return the error of a read: that the file was replaced, if its bytes are wrong because the server has another file by now.
 *
 * @param {unknown} error
 * @param {Source | null} source
 * @param {Map<number, Bytes>} opening header and index by their offsets
 * @returns {Promise<unknown>}
 */
async function explained(error, source, opening) {
  if (!(error instanceof FormatError) || !OUTDATED.includes(error.code) || !source?.isOther) return error;
  const [head, index] = [opening.get(0), opening.get(spec.HEADER_SIZE)];
  // The CRC of the index covers those of all parts.
  const [offset, bytes] = index ? [spec.HEADER_SIZE + index.length - CRC_SIZE, index.subarray(-CRC_SIZE)] : [0, head];
  if (!bytes || !(await source.isOther(offset, bytes))) return error;
  return replaced(source.transport?.url ?? 'the file', error.message, error);
}

/**
 * Select the layers of a tile that a read requires.
 *
 * @param {TileRecord} record
 * @param {{shDegree: number, extra: boolean}} wanted
 * @param {Header} header
 */
const wantedLayers = ({ layers }, { shDegree, extra }, { extras }) =>
  layers.filter(
    ({ layer }) => layer <= shDegree || (extra && extras.some((one) => one.layer === layer && isKnown(one))),
  );

/** Reads parts of a file and checks the CRC of each. */
export class Reader {
  /**
   * Open a file, with one request for header and index unless the index is very large.
   *
   * @param {import('./decoder.d.ts').FileSource} from
   * @param {ReaderOptions} [options]
   * @param {boolean} [isWhole] whether all of the file will be read
   * @returns {Promise<Reader>} of the class that `open` is called on
   */
  static async open(from, options = {}, isWhole = false) {
    const limits = checkedLimits(options.limits);
    const progress = { received: 0, fileSize: 0 };
    const way = wayOf(options, {
      firstBytes: Math.max(spec.HEADER_SIZE, options.firstBytes ?? FIRST_BYTES),
      isWhole,
      limit: limits.bytes,
      received: (size) => options.onProgress?.((progress.received += size), progress.fileSize),
    });
    /** @type {Source | null} */
    let source = null;
    const opening = new Map();
    const open = async () => {
      const { signal } = options;
      source = await openSource(from, way);
      const known = source.size ?? Infinity;
      const head = await source.read(0, Math.min(spec.HEADER_SIZE, known), signal);
      const file = readFileHeader(head, limits.resourceLevel);
      if (known !== Infinity) checkFileSize(known, file);
      progress.fileSize = file.fileSize;
      opening.set(0, head);
      checkIndexBudget(file.indexSize, limits);
      const index = await source.read(spec.HEADER_SIZE, file.indexSize, signal);
      const header = readIndex(index, file, limits);
      opening.set(spec.HEADER_SIZE, index);
      const compiled = options.inflate ? null : await WasmDecoder.open(file.fileSize, head, index);
      const inflate = options.inflate ? checkedInflate(options.inflate) : await platformInflate();
      return new this(source, header, limits, inflate, compiled);
    };
    try {
      const reader = await abortable(open(), options.signal);
      reader.inflates = options.inflate !== undefined;
      reader.opening = opening;
      reader.way = way;
      return reader;
    } catch (error) {
      const cause = await explained(error, source, opening);
      /** @type {Source | null} */ (source)?.close?.();
      throw cause;
    }
  }

  /**
   * @param {Source} source
   * @param {Header} header
   * @param {Required<Limits>} limits
   * @param {Inflate} inflate
   * @param {WasmDecoder | null} compiled decodes floats and packed arrays; null without WebAssembly
   */
  constructor(source, header, limits, inflate, compiled) {
    this.source = source;
    this.header = header;
    this.limits = limits;
    this.inflate = inflate;
    this.compiled = compiled;
    /** @type {Map<number, Bytes>} header and index by their offsets */
    this.opening = new Map();
    /** How it fetches. @type {import('./transport.mjs').Way | null} */
    this.way = null;
    /** Whether the caller supplies the inflate, which workers cannot use. */
    this.inflates = false;
    /** @type {Set<number>} offsets of the chunks whose CRC has been checked */
    this.checked = new Set();
    /** Chunks that were fetched for nothing, by offset. @type {Map<number, Bytes>} */
    this.unused = new Map();
    /** Total milliseconds that reads have waited for bytes; concurrent reads count separately. */
    this.waitedMs = 0;
    this.codebooks = codebooksById(header.codebooks);
    this.tableBytes = tableBytes(header.directory, this.codebooks);
    /** @type {Map<string, DirectoryRecord>} */
    this.codebookChunks = new Map();
    for (const record of header.directory) {
      if (record.type === spec.CHUNK_CODEBOOK) this.codebookChunks.set(`${record.id}.${record.layer}`, record);
    }
    /** @type {Map<string, Promise<Bytes>>} fetched codebook chunks */
    this.codebookBytes = new Map();
    /** @type {Map<string, Promise<Table>>} */
    this.tables = new Map();
    /** @type {Map<number, Tile>} tiles with indices that later layers need */
    this.open = new Map();
    /** @type {Map<LayerRecord, Bytes>} layers with such indices, for WebAssembly */
    this.kept = new Map();
    /** @type {Promise<TreeNode[]> | null} */
    this.tree = null;
    this.table = this.table.bind(this);
  }

  /** Retries of a request in a row, until it fails. */
  get retries() {
    return this.way?.retries ?? 0;
  }

  set retries(count) {
    if (this.way) this.way.retries = count;
  }

  /** The CRCs checked so far. */
  get checks() {
    return { header: true, index: true, chunks: this.checked.size };
  }

  /**
   * Read a tile with its SH bands up to a degree.
   *
   * @param {number} index
   * @param {{form?: LayerForm, shDegree?: number, extra?: boolean, signal?: AbortSignal}} [options]
   * @param {any} [spare] an earlier result, of floats, whose memory may be reused
   * @returns {Promise<any>} the arrays that `decode` returns, for this tile; for packed tiles see decoder.d.ts
   */
  readTile(index, options = {}, spare) {
    return this.whole(this.decodeTile(index, options, spare), options.signal);
  }

  /**
   * Do the work of a read.
   *
   * @template T
   * @param {Promise<T>} work
   * @param {AbortSignal} [signal] ends it at once, whatever it waits for
   * @returns {Promise<T>}
   */
  async whole(work, signal) {
    try {
      let reading = work;
      for (const one of [...(this.way?.signals ?? []), signal]) reading = abortable(reading, one ?? undefined);
      return await reading;
    } catch (error) {
      throw await explained(error, this.source, this.opening);
    }
  }

  /**
   * @param {number} index
   * @param {{form?: LayerForm, shDegree?: number, extra?: boolean, signal?: AbortSignal}} options
   * @param {any} [spare]
   * @returns {Promise<any>}
   */
  async decodeTile(index, { shDegree, extra = false, form, signal }, spare) {
    const record = checkedTile(index, this.header);
    if (form === 'packed') return this.readPackedTile(record, checkedDegree(shDegree, this.header), signal);
    const wanted = { shDegree: checkedDegree(shDegree, this.header), integers: checkedForm(form), extra };
    const assembly = new Assembly(this.header, [record], wanted, this.limits, this.tableBytes, spare);
    await this.fill(assembly, record, 0, signal);
    return assembly.fields();
  }

  /**
   * @param {TileRecord} record
   * @param {number} shDegree
   * @param {AbortSignal} [signal]
   */
  async readPackedTile(record, shDegree, signal) {
    const bands = Array.from({ length: shDegree }, (_, i) => i + 1);
    const layers = [spec.LAYER_GEOMETRY, ...bands].map((layer) => ({ tile: record.index, layer }));
    this.prefetch(layers, { signal });
    const geometry = await this.decodeLayer(record.index, spec.LAYER_GEOMETRY, { form: 'packed', signal });
    const sh = [];
    for (const band of bands) {
      const read = await this.decodeLayer(record.index, band, { form: 'packed', signal });
      sh.push(read && read.sh);
    }
    this.forget(record.index);
    return { ...geometry, sh };
  }

  /**
   * Decode a tile into arrays.
   *
   * @param {Assembly} assembly
   * @param {TileRecord} record
   * @param {number} first index in the arrays of the tile's first splat
   * @param {AbortSignal} [signal]
   */
  async fill(assembly, record, first, signal) {
    const { integers } = assembly.wanted;
    const places = wantedLayers(record, assembly.wanted, this.header);
    const bytes = await Promise.all(places.map((place) => this.fetch(place, signal)));
    const chunks = new Map(places.map((place, i) => [place, bytes[i]]));
    const { arrays } = assembly;
    const made =
      arrays instanceof FloatArrays &&
      (await this.byCompiled(record, chunks, (decoder) => decoder.readTile(record, arrays, first)));
    const tile = this.tileOf(record);
    for (const [place, chunk] of chunks) {
      if (made && place.layer < spec.LAYER_EXTRA) continue;
      assembly.put(await tile.readLayer(this.opened(chunk, place), place, integers), record, first);
    }
    this.release(tile);
  }

  /**
   * Collect the bytes that a reader in a worker needs, by offset: header, index and codebooks, or the chunks of a tile.
   *
   * @param {{shDegree: number, extra: boolean}} wanted
   * @param {TileRecord} [record]
   * @param {AbortSignal} [signal]
   * @returns {Promise<Map<number, Bytes>>}
   */
  async partsOf(wanted, record, signal) {
    const parts = record ? [] : [...this.opening];
    for (const place of record ? wantedLayers(record, wanted, this.header) : []) {
      parts.push([place.offset, await this.fetch(place, signal)]);
    }
    for (const [key, { layer, offset }] of record ? [] : this.codebookChunks) {
      if (layer <= wanted.shDegree) parts.push([offset, await this.codebookChunk(key)]); // every worker needs them
    }
    return new Map(parts);
  }

  /**
   * Keep chunks that were fetched for nothing, until they are wanted again.
   *
   * @param {Map<number, Bytes>} parts by offset
   */
  keep(parts) {
    for (const [offset, bytes] of parts) this.unused.set(offset, bytes);
  }

  /**
   * Read one layer of a tile: 0 is geometry and base colour, 1 to 4 are the SH bands. Layers can be read in any order and
   * repeatedly.
   *
   * @param {number} index
   * @param {number} layer
   * @param {{form?: LayerForm, signal?: AbortSignal}} [options] packed: integers, see decoder.d.ts
   * @returns {Promise<any>} the arrays by name, an SH band as `sh` [count, 2l + 1, 3]; null if the tile leaves the band
   *   out and its coefficients are 0
   */
  readLayer(index, layer, options = {}) {
    return this.whole(this.decodeLayer(index, layer, options), options.signal);
  }

  /**
   * @param {number} index
   * @param {number} layer
   * @param {{form?: LayerForm, signal?: AbortSignal}} options
   * @returns {Promise<any>}
   */
  async decodeLayer(index, layer, { form, signal }) {
    const record = checkedTile(index, this.header);
    const packed = form === 'packed';
    const integers = !packed && checkedForm(form);
    if (layer === spec.LAYER_GEOMETRY && !packed) return this.decodeTile(index, { shDegree: 0, form, signal });
    if (layer >= spec.LAYER_EXTRA || !Object.hasOwn(spec.LAYER_NAMES, layer)) {
      throw new InputError(`layer ${layer}: the layers of colour are 0 to ${spec.SH_DEGREE_MAX}`);
    }
    const place = record.layers.find((one) => one.layer === layer);
    if (place === undefined) return null;
    const count = record.splatCount;
    if (packed) checkBudget(count, arrayBytes(count, layer, [], true) + this.tableBytes, this.limits);
    const chunk = await this.fetch(place, signal);
    const made = !integers && (await this.layerByCompiled(record, place, chunk, packed, signal));
    if (made) return made;
    const tile = this.tileOf(record);
    const { blocks } = await tile.readLayer(this.opened(chunk, place), place, integers);
    this.release(tile);
    return packed ? packLayer(blocks, layer, count) : { sh: bandArray(blocks[0], count, integers), count };
  }

  /**
   * @param {TileRecord} record
   * @param {LayerRecord} place
   * @param {Bytes} chunk
   * @param {boolean} packed
   * @param {AbortSignal} [signal]
   */
  async layerByCompiled(record, place, chunk, packed, signal) {
    if (this.compiled === null) return null;
    const { layer } = place;
    const chunks = await this.layerChunks(record, place, chunk, signal);
    return this.byCompiled(record, chunks, (decoder) => {
      if (layer === spec.LAYER_GEOMETRY) return decoder.readPacked(record);
      const sh = packed ? decoder.readPackedBand(record, layer) : decoder.readBand(record, layer);
      return sh && { sh, count: record.splatCount };
    });
  }

  /**
   * Return the chunks that a layer is decoded from. Bands with the same codebook share the indices in the lowest of them,
   * whose chunk is kept for the others.
   *
   * @param {TileRecord} record
   * @param {LayerRecord} place
   * @param {Bytes} chunk its own
   * @param {AbortSignal} [signal]
   */
  async layerChunks(record, place, chunk, signal) {
    const { layer } = place;
    const chunks = new Map([[place, chunk]]);
    for (const { bandFirst, bandLast } of record.tables.flatMap((id) => this.codebooks.get(id) ?? [])) {
      if (bandFirst === bandLast || layer < bandFirst || layer > bandLast) continue;
      const lowest = record.layers.find((one) => one.layer === bandFirst);
      if (lowest === undefined) continue;
      const bytes = lowest === place ? chunk.slice() : (this.kept.get(lowest) ?? (await this.fetch(lowest, signal)));
      this.kept.set(lowest, bytes);
      chunks.set(lowest, bytes);
    }
    return chunks;
  }

  /**
   * Collect the bytes of chunks and of the codebooks that they refer to, by offset.
   *
   * @param {TileRecord} record
   * @param {Map<LayerRecord, Bytes>} chunks
   * @returns {Promise<Map<number, Bytes>>}
   */
  async withTables({ tables }, chunks) {
    const parts = new Map([...chunks].map(([{ offset }, bytes]) => [offset, bytes]));
    const layers = [...chunks.keys()].map(({ layer }) => layer);
    for (const [key, { id, layer, offset }] of this.codebookChunks) {
      if (tables.includes(id) && layers.includes(layer)) parts.set(offset, await this.codebookChunk(key));
    }
    return parts;
  }

  /**
   * Collect the bytes that a reader in a worker needs for a layer, by offset.
   *
   * @param {TileRecord} record
   * @param {LayerRecord} place
   * @param {AbortSignal} [signal]
   */
  async layerParts(record, place, signal) {
    return this.withTables(record, await this.layerChunks(record, place, await this.fetch(place, signal), signal));
  }

  /**
   * Decode layers of a tile with WebAssembly.
   *
   * @template T
   * @param {TileRecord} record
   * @param {Map<LayerRecord, Bytes>} chunks chunks of the layers
   * @param {(decoder: WasmDecoder) => T} decode
   * @returns {Promise<T | null>} null or false if WebAssembly cannot decode them: then the JavaScript modules do
   */
  async byCompiled(record, chunks, decode) {
    if (this.compiled === null) return null;
    const parts = await this.withTables(record, chunks);
    return this.compiled.reading(parts, this.checked, decode);
  }

  /**
   * Read metadata, cameras, encoder options and declared errors; null for what the file does not have.
   *
   * @param {{signal?: AbortSignal}} [options]
   */
  describe({ signal } = {}) {
    return this.whole(this.describeFile(signal), signal);
  }

  /** @param {AbortSignal} [signal] */
  async describeFile(signal) {
    const description = emptyDescription();
    const scene = { splatCount: this.header.splatCount, jsonBytes: this.limits.jsonBytes, inflate: this.inflate };
    const records = this.header.directory.filter(
      ({ type }) => type !== spec.CHUNK_CODEBOOK && type !== spec.CHUNK_TREE && Object.hasOwn(spec.CHUNK_NAMES, type),
    );
    for (const record of records) this.source.prefetch?.([record], signal); // at once, without what is between them
    for (const record of records) {
      await describe(description, record, this.opened(await this.fetch(record, signal), record), scene);
    }
    return description;
  }

  /**
   * Return the nodes of the levels of detail, read once.
   *
   * @returns {Promise<TreeNode[]>}
   */
  nodes() {
    if (this.tree === null) {
      this.tree = this.whole(this.fetchNodes());
      this.tree.catch(() => (this.tree = null)); // allows another try
    }
    return this.tree;
  }

  async fetchNodes() {
    const record = this.header.directory.find(({ type }) => type === spec.CHUNK_TREE);
    if (record === undefined) return readNodes(null, this.header);
    const payload = this.opened(await this.fetch(record), record);
    return readNodes(new Payload(payload, record.offset + spec.CHUNK_HEADER_SIZE, 'TRE-2'), this.header);
  }

  /**
   * Check everything that has not been read yet. CHK-2: a decoder of a whole file checks "the CRC of all chunks, known or
   * not", and reads "TREE and all CODB chunks, used or not". The payloads of tiles remain unread (CHK-8).
   */
  async checkAll() {
    const { directory, tiles, coarseTiles } = this.header;
    const layersOf = (/** @type {TileRecord[]} */ some) => some.flatMap(({ layers }) => layers);
    await this.nodes();
    const chunks = new Map();
    for (const place of [...directory, ...layersOf(tiles), ...layersOf(coarseTiles)]) {
      if (!this.checked.has(place.offset)) chunks.set(place, await this.fetch(place));
    }
    const parts = new Map();
    for (const place of [...directory, ...layersOf(coarseTiles)]) parts.set(place.offset, await this.fetch(place));
    if (!this.compiled?.reading(parts, this.checked, (decoder) => decoder.check())) {
      for (const { id, layer } of this.codebookChunks.values()) await this.table(id, layer);
    }
    for (const [place, chunk] of chunks) if (!this.checked.has(place.offset)) this.opened(chunk, place);
  }

  /**
   * Start to fetch layers that will be read soon and the codebooks between them. Neighbours in the file share a
   * request.
   *
   * @param {Iterable<LayerRequest>} wanted each must be read once afterwards
   * @param {{signal?: AbortSignal}} [options]
   */
  prefetch(wanted, { signal } = {}) {
    /** @type {Set<ChunkPlace>} */
    const places = new Set();
    for (const { tile, layer } of wanted) {
      const record = checkedTile(tile, this.header);
      const place = record.layers.find((one) => one.layer === layer);
      if (place === undefined) continue;
      places.add(place);
      for (const id of record.tables) {
        const key = `${id}.${layer}`;
        const chunk = this.codebookBytes.has(key) ? undefined : this.codebookChunks.get(key);
        if (chunk) places.add(chunk);
      }
    }
    this.source.prefetch?.([...places], signal);
  }

  /** Whether parts near the end of the file arrive later than others: the server sends it from its beginning. */
  get arrivesInOrder() {
    return this.source.isSequential ?? false;
  }

  /**
   * Forget what reads of a tile have left for its other layers.
   *
   * @param {number} index
   */
  forget(index) {
    for (const place of checkedTile(index, this.header).layers) {
      this.kept.delete(place);
      this.unused.delete(place.offset);
    }
    this.open.delete(index);
  }

  /**
   * @param {ChunkPlace} place
   * @param {AbortSignal} [signal]
   * @returns {Promise<Bytes>}
   */
  async fetch(place, signal) {
    signal?.throwIfAborted();
    const kept = this.unused.get(place.offset);
    if (kept !== undefined) {
      this.unused.delete(place.offset);
      return kept;
    }
    const before = performance.now();
    const bytes = await this.source.read(place.offset, place.size, signal);
    this.waitedMs += performance.now() - before;
    return bytes;
  }

  /**
   * @param {Bytes} chunk
   * @param {ChunkPlace} place
   */
  opened(chunk, place) {
    const payload = openChunk(chunk, place);
    this.checked.add(place.offset);
    return payload;
  }

  /**
   * Fetch a chunk of a codebook once. Without a signal, since others may wait for the same chunk.
   *
   * @param {string} key
   */
  codebookChunk(key) {
    let bytes = this.codebookBytes.get(key);
    if (bytes === undefined) {
      const record = this.codebookChunks.get(key);
      if (!record) throw new InputError(`no codebook ${key}`); // unreachable by DIR-5 and CBK-1
      bytes = this.fetch(record);
      this.codebookBytes.set(key, bytes);
      bytes.catch(() => this.codebookBytes.delete(key)); // allows another try
    }
    return bytes;
  }

  /**
   * Return the table of a codebook's chunk, decoded once.
   *
   * @param {number} id
   * @param {number} layer
   * @returns {Promise<Table>}
   */
  table(id, layer) {
    const key = `${id}.${layer}`;
    let table = this.tables.get(key);
    if (table === undefined) {
      table = this.fetchTable(key, id);
      this.tables.set(key, table);
      table.catch(() => this.tables.delete(key)); // allows another try
    }
    return table;
  }

  /**
   * Return a new array: tiles may be decoded concurrently, so they cannot share arrays.
   *
   * @param {number} _key
   * @param {number} length
   */
  scratch(_key, length) {
    return new Float64Array(length);
  }

  /**
   * @param {string} key
   * @param {number} id
   */
  async fetchTable(key, id) {
    const record = /** @type {DirectoryRecord} */ (this.codebookChunks.get(key));
    const payload = this.opened(await this.codebookChunk(key), record);
    return readTable(
      payload,
      record,
      /** @type {CodebookRecord} */ (this.codebooks.get(id)),
      this.header.attributes,
      this.inflate,
    );
  }

  /**
   * @param {TileRecord} record
   * @returns {Tile}
   */
  tileOf(record) {
    let tile = this.open.get(record.index);
    if (tile === undefined) {
      const needLayer = async (/** @type {number} */ layer) => {
        const place = record.layers.find((one) => one.layer === layer);
        if (!place) return;
        const payload = this.opened(await this.fetch(place), place);
        await /** @type {Tile} */ (tile).readLayer(payload, place, false);
      };
      tile = new Tile(this, record, needLayer);
      this.open.set(record.index, tile);
    }
    return tile;
  }

  /**
   * Forget a tile without indices that other layers need.
   *
   * @param {Tile} tile
   */
  release(tile) {
    for (const id of tile.indices.keys()) {
      const codebook = this.codebooks.get(id);
      if (codebook === undefined || codebook.bandFirst === codebook.bandLast) tile.indices.delete(id);
    }
    if (tile.indices.size === 0) this.open.delete(tile.record.index);
  }
}
