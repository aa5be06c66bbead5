// SPDX-License-Identifier: Apache-2.0
// The C decoder compiled to WebAssembly (wasm/, codec/c), for floats and packed arrays. Files that it refuses are decoded
// again by the JavaScript modules, which report the error and its offset.

import { shRows } from './arrays.mjs';
import { platformInflate } from './inflate.mjs';
import * as spec from './spec.mjs';
import { WASM, WASM_BYTES } from './wasm_binary.mjs';

/**
 * @typedef {import('./arrays.mjs').FloatArrays} FloatArrays
 * @typedef {import('./decoder.d.ts').Packed} Packed
 * @typedef {import('./decoder.d.ts').PackedColumns} PackedColumns
 * @typedef {import('./decoder.d.ts').PackedGeometry} PackedGeometry
 * @typedef {import('./decoder.d.ts').TileRecord} TileRecord
 * @typedef {Uint8Array<ArrayBuffer>} Bytes
 * @typedef {Map<number, Bytes>} Parts chunks by their offset in the file
 *
 * The exports of wasm/interface.c. Functions return an address, or 0 if they refuse the data.
 *
 * @typedef {object} Exports
 * @property {WebAssembly.Memory} memory
 * @property {(size: number) => number} open
 * @property {() => void} close
 * @property {() => number} check
 * @property {(index: number, degree: number) => number} read_tile
 * @property {(degree: number, from: number, to: number) => number} read_rows
 * @property {(index: number, band: number) => number} read_band
 * @property {(index: number) => number} read_packed
 * @property {(index: number, band: number) => number} read_packed_band
 * @property {(id: number, band: number) => number} read_packed_codebook
 */

/** The layout in memory of csplat_columns and csplat_packed of csplat.h. */
const COLUMNS = { data: 0, width: 4, columns: 8, count: 12, offset: 16, step: 232 };
const PACKED = { rows: 240, index: 244, indexWidth: 248, codebook: 252, size: 256 };
const GEOMETRY = ['opacities', 'scales', 'quats', 'means', 'sh0'];
const SH_ROWS = 512; // as in wasm/interface.c
const ARRAYS = { 1: Uint8Array, 2: Uint16Array, 4: Uint32Array };

/** @type {Promise<WebAssembly.Module | null> | null} */
let compiling = null;

/** @type {WeakRef<WasmDecoder> | null} a closed decoder, whose memory can be reused */
let spare = null;

/** Compile the module; null if the platform or the page's policy does not allow it. */
function compiledModule() {
  compiling ??= (async () => {
    try {
      const text = atob(WASM);
      const coded = new Uint8Array(text.length);
      for (let i = 0; i < text.length; i++) coded[i] = text.charCodeAt(i); // Uint8Array.from is several times slower
      const inflate = await platformInflate();
      const module = await WebAssembly.compile(new Uint8Array(await inflate(coded, WASM_BYTES)));
      spare = new WeakRef(new WasmDecoder(module)); // WebKit applies the policy only when the module is instantiated
      return module;
    } catch {
      return null;
    }
  })();
  return compiling;
}

/** Decodes tiles of one file. */
export class WasmDecoder {
  /**
   * @param {number} fileSize
   * @param {Bytes} head the file's first bytes
   * @param {Bytes} index
   * @returns {Promise<WasmDecoder | null>} null if the platform has no WebAssembly, or the file is refused
   */
  static async open(fileSize, head, index) {
    const module = await compiledModule();
    if (module === null) return null;
    const decoder = spare?.deref() ?? new WasmDecoder(module);
    spare = null;
    const parts = new Map([
      [0, head],
      [spec.HEADER_SIZE, index],
    ]);
    return decoder.reading(parts, new Set(), () => decoder.exports.open(fileSize)) ? decoder : null;
  }

  /** @param {WebAssembly.Module} module */
  constructor(module) {
    /** @type {Parts} */
    this.parts = new Map();
    const read = (/** @type {number} */ offset, /** @type {number} */ size, /** @type {number} */ into) => {
      const bytes = this.parts.get(offset);
      if (bytes?.length !== size) return 0;
      new Uint8Array(this.exports.memory.buffer, into, size).set(bytes);
      this.seen.add(offset);
      return 1;
    };
    const { exports } = new WebAssembly.Instance(module, { env: { read } });
    this.exports = /** @type {Exports} */ (/** @type {unknown} */ (exports));
    /** @type {Set<number>} */
    this.seen = new Set();
    this.isBroken = false;
    /** @type {Map<string, PackedColumns>} codebook entries by id and band */
    this.codebooks = new Map();
  }

  /**
   * Call `decode` with access to `parts`. All other methods must be called from it.
   *
   * @template T
   * @param {Parts} parts the chunks that may be read
   * @param {Set<number>} checked receives the offsets of the chunks that were read, unless any was refused
   * @param {(decoder: WasmDecoder) => T} decode
   * @returns {T | null} null after a trap
   */
  reading(parts, checked, decode) {
    if (this.isBroken) return null;
    this.parts = parts;
    try {
      const made = decode(this);
      if (made) for (const offset of this.seen) checked.add(offset);
      return made;
    } catch (error) {
      if (!(error instanceof WebAssembly.RuntimeError)) throw error;
      this.isBroken = true; // after a trap the memory is in an undefined state
      return null;
    } finally {
      this.parts = new Map();
      this.seen.clear();
    }
  }

  /** Forget the file. No method may be called afterwards. */
  close() {
    if (this.isBroken) return;
    this.exports.close();
    this.codebooks.clear();
    spare = new WeakRef(this);
  }

  /** Check everything outside the tiles of level 0: nodes, codebooks, texts, and the frames of chunks that are not read. */
  check() {
    return this.exports.check() !== 0;
  }

  /**
   * Decode a tile.
   *
   * @param {TileRecord} tile
   * @param {FloatArrays} arrays filled with the tile
   * @param {number} first index in the arrays of the tile's first splat
   */
  readTile({ index, splatCount: n }, arrays, first) {
    let at = this.exports.read_tile(index, arrays.shDegree);
    if (at === 0) return false;
    const { buffer } = this.exports.memory;
    for (const [name, { array, width }] of arrays.columns()) {
      if (name === 'shN') continue;
      array.set(new Float32Array(buffer, at, width * n), width * first);
      at += 4 * width * n;
    }
    const { shN, shDegree } = arrays;
    const width = 3 * shRows(shDegree);
    for (let from = 0; width && from < n; from += SH_ROWS) {
      const to = Math.min(n, from + SH_ROWS);
      const rows = new Float32Array(buffer, this.exports.read_rows(shDegree, from, to), width * (to - from));
      shN.set(rows, width * (first + from));
    }
    return true;
  }

  /**
   * Decode an SH band.
   *
   * @param {TileRecord} tile
   * @param {number} band
   * @returns {Float32Array | null} [splat, coefficient, channel]
   */
  readBand({ index, splatCount }, band) {
    const at = this.exports.read_band(index, band);
    return at ? new Float32Array(this.exports.memory.buffer, at, 3 * (2 * band + 1) * splatCount).slice() : null;
  }

  /**
   * Decode layer 0 to packed arrays.
   *
   * @param {TileRecord} tile
   * @returns {PackedGeometry | null}
   */
  readPacked({ index, splatCount: count }) {
    const at = this.exports.read_packed(index);
    if (at === 0) return null;
    const columns = GEOMETRY.map((name, i) => [name, this.columnsAt(at + i * PACKED.size)]);
    return { count, ...Object.fromEntries(columns) };
  }

  /**
   * Decode an SH band to packed arrays.
   *
   * @param {TileRecord} tile
   * @param {number} band
   * @returns {Packed | null}
   */
  readPackedBand({ index, splatCount }, band) {
    const at = this.exports.read_packed_band(index, band);
    if (at === 0) return null;
    const packed = this.columnsAt(at);
    const view = new DataView(this.exports.memory.buffer, at);
    const [rows, indices] = [PACKED.rows, PACKED.index].map((place) => view.getUint32(place, true));
    const some = rows || indices ? { rows: this.copy(4, rows, view.getUint32(COLUMNS.count, true)) } : {};
    if (indices === 0) return { ...packed, ...some };
    const codebook = view.getUint16(PACKED.codebook, true);
    const entry = this.copy(view.getUint32(PACKED.indexWidth, true), indices, splatCount);
    const table = this.codebook(codebook, band);
    return table && { ...packed, ...some, lookup: { codebook, table, index: entry } };
  }

  /**
   * @param {number} id
   * @param {number} band
   * @returns {PackedColumns | null}
   */
  codebook(id, band) {
    const key = `${id}.${band}`;
    const known = this.codebooks.get(key);
    if (known) return known;
    const at = this.exports.read_packed_codebook(id, band);
    if (at === 0) return null;
    const table = this.columnsAt(at);
    this.codebooks.set(key, table);
    return table;
  }

  /** @param {number} at address of a csplat_columns */
  columnsAt(at) {
    const view = new DataView(this.exports.memory.buffer, at);
    const [data, width, columns, count] = [COLUMNS.data, COLUMNS.width, COLUMNS.columns, COLUMNS.count].map((place) =>
      view.getUint32(place, true),
    );
    const offsets = Array.from({ length: columns }, (_, i) => Number(view.getBigInt64(COLUMNS.offset + 8 * i, true)));
    return {
      columns: this.copy(width, data, columns * count),
      offsets,
      step: view.getFloat64(COLUMNS.step, true),
    };
  }

  /**
   * @param {number} width bytes per element
   * @param {number} at
   * @param {number} length
   * @returns {any}
   */
  copy(width, at, length) {
    return new ARRAYS[/** @type {1 | 2 | 4} */ (width)](this.exports.memory.buffer, at, length).slice();
  }
}
