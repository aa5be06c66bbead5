// Tiles and layers of a file, one by one and in any order, over HTTP Range, from a Blob or from memory.

import { describe, emptyDescription } from './ancillary.mjs';
import { arrayBytes, bandArray } from './arrays.mjs';
import { Assembly, checkBudget, codebooksById } from './assemble.mjs';
import { readTable, tableBytes } from './codebooks.mjs';
import { checkFileSize, openChunk, readFileHeader } from './container.mjs';
import { InputError } from './errors.mjs';
import { readIndex } from './index.mjs';
import { platformInflate } from './inflate.mjs';
import { checkedDegree, checkedForm, checkedLimits, checkedTile } from './options.mjs';
import { packLayer } from './packed.mjs';
import { openSource } from './source.mjs';
import * as spec from './spec.mjs';
import { Tile } from './tile.mjs';

const FIRST_BYTES = 1 << 16; // header and index of most files of up to some thirty million splats

/**
 * @typedef {import('./decoder.d.ts').ByteSource} ByteSource
 * @typedef {import('./decoder.d.ts').ChunkPlace} ChunkPlace
 * @typedef {import('./decoder.d.ts').DirectoryRecord} DirectoryRecord
 * @typedef {import('./decoder.d.ts').Header} Header
 * @typedef {import('./decoder.d.ts').Limits} Limits
 * @typedef {import('./decoder.d.ts').LayerForm} LayerForm
 * @typedef {import('./decoder.d.ts').LayerRequest} LayerRequest
 * @typedef {import('./decoder.d.ts').ReaderOptions} ReaderOptions
 * @typedef {import('./decoder.d.ts').ReadOptions} ReadOptions
 * @typedef {import('./decoder.d.ts').TileRecord} TileRecord
 * @typedef {import('./codebooks.mjs').Table} Table
 * @typedef {import('./inflate.mjs').Inflate} Inflate
 */

/** Reads parts of a file, and checks the CRC of each. */
export class CsplatReader {
  /**
   * Open a file: one request for header and index of all but huge files.
   *
   * @param {string | URL | Blob | ArrayBuffer | ByteSource} from
   * @param {ReaderOptions} [options]
   * @returns {Promise<CsplatReader>}
   */
  static async open(from, options = {}) {
    const { signal } = options;
    const limits = checkedLimits(options.limits);
    const progress = { received: 0, fileSize: 0 };
    const source = await openSource(from, {
      fetch: options.fetch ?? ((...request) => globalThis.fetch(...request)),
      init: { ...options.request, signal },
      firstBytes: Math.max(spec.HEADER_SIZE, options.firstBytes ?? FIRST_BYTES),
      limit: limits.bytes,
      received: (size) => options.onProgress?.((progress.received += size), progress.fileSize),
    });
    const known = source.size ?? Infinity;
    const file = readFileHeader(await source.read(0, Math.min(spec.HEADER_SIZE, known), signal));
    if (known !== Infinity) checkFileSize(known, file);
    progress.fileSize = file.fileSize;
    const header = readIndex(await source.read(spec.HEADER_SIZE, file.indexSize, signal), file, limits);
    return new CsplatReader(source, header, limits, options.inflate ?? (await platformInflate()));
  }

  /**
   * @param {ByteSource} source
   * @param {Header} header
   * @param {Required<Limits>} limits
   * @param {Inflate} inflate
   */
  constructor(source, header, limits, inflate) {
    this.source = source;
    this.header = header;
    this.limits = limits;
    this.inflate = inflate;
    /** What has been checked so far; `chunks` counts. */
    this.checks = { header: true, index: true, chunks: 0 };
    /** How long reads have waited for bytes so far, each for itself. */
    this.waitedMs = 0;
    this.codebooks = codebooksById(header.codebooks);
    this.tableBytes = tableBytes(header.directory, this.codebooks);
    /** @type {Map<string, DirectoryRecord>} */
    this.codebookChunks = new Map();
    for (const record of header.directory) {
      if (record.type === spec.CHUNK_CODEBOOK) this.codebookChunks.set(`${record.id}.${record.layer}`, record);
    }
    /** @type {Map<string, Promise<Table>>} */
    this.tables = new Map();
    /** @type {Map<number, Tile>} tiles that hold indices which layers to come need */
    this.open = new Map();
    this.table = this.table.bind(this);
  }

  /**
   * Read a tile with its SH bands up to a degree.
   *
   * @param {number} index
   * @param {ReadOptions & {shDegree?: number, extra?: boolean}} [options]
   * @returns {Promise<any>} the arrays that `decode` gives, of the one tile
   */
  async readTile(index, { shDegree, extra = false, form, signal } = {}) {
    const record = checkedTile(index, this.header);
    const degree = checkedDegree(shDegree, this.header);
    const places = record.layers.filter(({ layer }) => (layer === spec.LAYER_EXTRA ? extra : layer <= degree));
    const integers = checkedForm(form);
    const wanted = { shDegree: degree, integers, extra };
    const assembly = new Assembly(this.header, [record], wanted, this.limits, this.tableBytes);
    const payloads = await Promise.all(places.map((place) => this.readChunk(place, signal)));
    const tile = this.tileOf(record);
    for (const [i, place] of places.entries())
      assembly.put(await tile.readLayer(payloads[i], place, integers), record, 0);
    this.release(tile);
    return assembly.fields();
  }

  /**
   * Read one layer of a tile: 0 is geometry and base colour, 1 to 3 are the SH bands. In any order, as often as wanted.
   *
   * @param {number} index
   * @param {number} layer
   * @param {{form?: LayerForm, signal?: AbortSignal}} [options] packed: integers, see decoder.d.ts
   * @returns {Promise<any>} the arrays by name, an SH band as `sh` [count, 2l + 1, 3]; null where the tile leaves the
   *   band out: its coefficients are 0
   */
  async readLayer(index, layer, { form, signal } = {}) {
    const record = checkedTile(index, this.header);
    const packed = form === 'packed';
    const integers = !packed && checkedForm(form);
    if (layer === spec.LAYER_GEOMETRY && !packed) return this.readTile(index, { shDegree: 0, form, signal });
    if (layer === spec.LAYER_EXTRA || !Object.hasOwn(spec.LAYER_NAMES, layer)) {
      throw new InputError(`layer ${layer}: the layers of colour are 0 to ${spec.SH_DEGREE_MAX}`);
    }
    const place = record.layers.find((one) => one.layer === layer);
    if (place === undefined) return null;
    if (packed) {
      const bytes = arrayBytes(record.splatCount, layer, [], true);
      checkBudget(record.splatCount, bytes + this.tableBytes, this.limits);
    }
    const payload = await this.readChunk(place, signal);
    const tile = this.tileOf(record);
    const { blocks } = await tile.readLayer(payload, place, integers);
    this.release(tile);
    if (packed) return packLayer(blocks, layer, record.splatCount);
    return { sh: bandArray(blocks[0], record.splatCount, integers), count: record.splatCount };
  }

  /**
   * Metadata, cameras, the encoder's options, stated errors; null for what the file does not have.
   *
   * @param {{signal?: AbortSignal}} [options]
   */
  async describe({ signal } = {}) {
    const description = emptyDescription();
    const scene = { splatCount: this.header.splatCount, jsonBytes: this.limits.jsonBytes, inflate: this.inflate };
    for (const record of this.header.directory) {
      if (record.type === spec.CHUNK_CODEBOOK || !Object.hasOwn(spec.CHUNK_NAMES, record.type)) continue;
      await describe(description, record, await this.readChunk(record, signal), scene);
    }
    return description;
  }

  /**
   * Begin to fetch layers that will be read soon, neighbours in the file with one request, and the codebooks that lie
   * between them.
   *
   * @param {Iterable<LayerRequest>} wanted each is to be read once afterwards
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
        const chunk = this.tables.has(key) ? undefined : this.codebookChunks.get(key);
        if (chunk) places.add(chunk);
      }
    }
    this.source.prefetch?.([...places], signal);
  }

  /**
   * @param {ChunkPlace} place
   * @param {AbortSignal} [signal]
   */
  async readChunk(place, signal) {
    signal?.throwIfAborted();
    const before = performance.now();
    const bytes = await this.source.read(place.offset, place.size, signal);
    this.waitedMs += performance.now() - before;
    const payload = openChunk(bytes, place);
    this.checks.chunks++;
    return payload;
  }

  /**
   * The table of a codebook's chunk, fetched once. Without a signal: others may wait for the same table.
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
      table.catch(() => this.tables.delete(key)); // may be tried again
    }
    return table;
  }

  /**
   * Tiles may be decoded at the same time, so that none can use another's arrays.
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
    const record = this.codebookChunks.get(key);
    const codebook = this.codebooks.get(id);
    if (!record || !codebook) throw new InputError(`no codebook ${key}`); // DIR-5 and CBK-1 leave no way here
    return readTable(await this.readChunk(record), record, codebook, this.header.attributes, this.inflate);
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
        if (place) await /** @type {Tile} */ (tile).readLayer(await this.readChunk(place), place, false);
      };
      tile = new Tile(this, record, needLayer);
      this.open.set(record.index, tile);
    }
    return tile;
  }

  /**
   * Forget a tile that holds no indices for other layers.
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
