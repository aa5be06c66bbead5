// SPDX-License-Identifier: Apache-2.0
// The encoder in C compiled to WebAssembly (wasm/, codec/c): instances, and the tasks that a thread does with one.

import { WASM } from './wasm_binary.mjs';

/**
 * @typedef {import('./encoder.d.ts').Splats} Splats
 * @typedef {import('./encoder.d.ts').EncodeOptions} EncodeOptions
 * @typedef {import('./encoder.d.ts').PlySplats} PlySplats
 *
 * The exports of wasm/interface.c. Sizes are in bytes, and functions return an address, or 0 on failure.
 *
 * @typedef {object} Exports
 * @property {WebAssembly.Memory} memory
 * @property {() => number} fields
 * @property {() => number} message
 * @property {(size: number) => number} allocate
 * @property {(address: number) => void} release
 * @property {(address: number, size: number) => number} read_ply
 * @property {(sourceIndex: number) => number} encode
 */

/** Places of the fields in memory, doubles, as in wasm/interface.c. */
const FIELDS = {
  count: 0,
  degree: 1,
  means: 2,
  quats: 3,
  scales: 4,
  opacities: 5,
  sh0: 6,
  shN: 7,
  positions: 8,
  origin: 9,
  unitMetres: 12,
  axes: 13,
  antialiased: 16,
  flat: 17,
  colourSpace: 18,
  metadata: 19,
  metadataSize: 20,
  rowCount: 21,
  fileSize: 22,
  code: 23,
};
const ARRAYS = /** @type {const} */ (['means', 'quats', 'scales', 'opacities', 'sh0', 'shN']);
const WIDTHS = { means: 3, quats: 4, scales: 3, opacities: 1, sh0: 3 };
const COEFFICIENTS = [0, 3, 8, 15, 24]; // of bands 1 and above, by degree

/** An error with a code of the specification: E_INPUT, the caller's data is invalid, or E_LIMIT, out of memory. */
export class CsplatError extends Error {
  /** @param {string} message one line, which begins with the code */
  constructor(message) {
    super(message);
    this.name = 'CsplatError';
    this.code = message.slice(0, message.indexOf(':'));
  }
}

/** @type {Promise<WebAssembly.Module> | null} */
let compiling = null;

/** Compile the module once. */
function compiledModule() {
  compiling ??= (async () => {
    const text = atob(WASM);
    const bytes = new Uint8Array(text.length);
    for (let i = 0; i < text.length; i++) bytes[i] = text.charCodeAt(i);
    return WebAssembly.compile(bytes);
  })();
  return compiling;
}

/** An instance, whose memory is freed with it: memory of WebAssembly never shrinks. */
class Instance {
  /**
   * @param {WebAssembly.Module} module
   * @param {EncodeOptions} options
   */
  constructor(module, { onProgress, signal }) {
    const env = {
      progress: (/** @type {number} */ done) => {
        onProgress?.(done);
        return signal?.aborted ? 0 : 1;
      },
    };
    this.signal = signal;
    this.exports = /** @type {Exports} */ (/** @type {unknown} */ (new WebAssembly.Instance(module, { env }).exports));
  }

  /** @param {EncodeOptions} options */
  static async create(options) {
    return new Instance(await compiledModule(), options);
  }

  /** The fields; the view is valid until memory grows. */
  get fields() {
    return new Float64Array(this.exports.memory.buffer, this.exports.fields(), Object.keys(FIELDS).length + 5);
  }

  /** The text of `size` bytes of ASCII at an address, up to a 0. @param {number} at @param {number} [size] */
  text(at, size = Infinity) {
    const bytes = new Uint8Array(this.exports.memory.buffer);
    let text = '';
    for (let i = at; i < at + size && bytes[i]; i++) text += String.fromCharCode(bytes[i]);
    return text;
  }

  /** @param {number} size */
  allocate(size) {
    const at = this.exports.allocate(Math.max(size, 1)) >>> 0;
    if (at === 0) throw new CsplatError(`E_LIMIT: no memory for ${Math.ceil(size / 2 ** 20)} MB`);
    return at;
  }

  /** Copy an array to memory, and return its address. @param {ArrayBufferView} array */
  put(array) {
    const at = this.allocate(array.byteLength);
    const bytes = new Uint8Array(array.buffer, array.byteOffset, array.byteLength);
    new Uint8Array(this.exports.memory.buffer, at, array.byteLength).set(bytes);
    return at;
  }

  /** @returns {never} */
  fail() {
    this.signal?.throwIfAborted();
    throw new CsplatError(this.text(this.exports.message()));
  }

  /** @param {ArrayBuffer | Uint8Array} ply */
  readPly(ply) {
    const bytes = ply instanceof Uint8Array ? ply : new Uint8Array(ply);
    if (!this.exports.read_ply(this.put(bytes), bytes.length)) this.fail();
  }

  /** Copy the splats of a PLY out of memory. @returns {PlySplats} */
  takeSplats() {
    const { fields } = this;
    const { buffer } = this.exports.memory;
    const count = fields[FIELDS.count];
    const take = (/** @type {number} */ field, /** @type {number} */ width) =>
      new Float32Array(buffer, fields[field], count * width).slice();
    const positions = fields[FIELDS.positions];
    return {
      means: take(FIELDS.means, 3),
      quats: take(FIELDS.quats, 4),
      scales: take(FIELDS.scales, 3),
      opacities: take(FIELDS.opacities, 1),
      sh0: take(FIELDS.sh0, 3),
      shN: take(FIELDS.shN, 3 * COEFFICIENTS[fields[FIELDS.degree]]),
      positions: positions ? new Float64Array(buffer, positions, 3 * count).slice() : null,
      origin: [...fields.subarray(FIELDS.origin, FIELDS.origin + 3)],
      unitMetres: fields[FIELDS.unitMetres],
      axes: fields[FIELDS.axes] ? String.fromCharCode(...fields.subarray(FIELDS.axes, FIELDS.axes + 3)) : '',
      antialiased: fields[FIELDS.antialiased] > 0,
      flat: fields[FIELDS.flat] > 0,
      colourSpace: fields[FIELDS.colourSpace],
      rowCount: fields[FIELDS.rowCount],
    };
  }

  /** Copy splats to memory. @param {Splats} splats */
  putSplats(splats) {
    const degree = checkSplats(splats);
    const { positions = null, origin = [0, 0, 0], axes = '', metadata = null } = splats;
    const text = metadata === null ? new Uint8Array() : new TextEncoder().encode(JSON.stringify(metadata));
    /** @type {Record<string, number>} */
    const addresses = Object.fromEntries(ARRAYS.map((name) => [name, this.put(splats[name] ?? new Float32Array())]));
    addresses.positions = positions === null ? 0 : this.put(positions);
    addresses.metadata = this.put(text);
    const { fields } = this; // after all allocations
    fields.fill(0);
    for (const [name, at] of Object.entries(addresses)) fields[FIELDS[/** @type {keyof FIELDS} */ (name)]] = at;
    fields.set(origin, FIELDS.origin);
    fields.set(
      [...axes].map((letter) => letter.charCodeAt(0)),
      FIELDS.axes,
    );
    fields[FIELDS.count] = splats.opacities.length;
    fields[FIELDS.degree] = degree;
    fields[FIELDS.unitMetres] = splats.unitMetres ?? 0;
    fields[FIELDS.antialiased] = Number(splats.antialiased ?? false);
    fields[FIELDS.flat] = Number(splats.flat ?? false);
    fields[FIELDS.colourSpace] = splats.colourSpace ?? 0;
    fields[FIELDS.metadataSize] = text.length;
  }

  /** Encode the splats in memory. @param {Uint32Array | undefined} sourceIndex */
  encode(sourceIndex) {
    const count = this.fields[FIELDS.count];
    if (sourceIndex && sourceIndex.length !== count) {
      throw new CsplatError(`E_INPUT: sourceIndex has ${sourceIndex.length} elements, expected ${count}`);
    }
    const index = sourceIndex ? this.allocate(4 * count) : 0;
    const at = this.exports.encode(index) >>> 0;
    if (at === 0) this.fail();
    const { buffer } = this.exports.memory;
    sourceIndex?.set(new Uint32Array(buffer, index, count));
    return new Uint8Array(buffer, at, this.fields[FIELDS.fileSize]).slice();
  }
}

/**
 * Check types and lengths; the encoder checks the values.
 *
 * @param {Splats} splats
 * @returns {number} the SH degree
 */
function checkSplats(splats) {
  const count = splats.opacities?.length;
  for (const [name, width] of Object.entries(WIDTHS)) {
    const array = splats[/** @type {keyof typeof WIDTHS} */ (name)];
    if (!(array instanceof Float32Array) || array.length !== count * width) {
      throw new CsplatError(`E_INPUT: ${name} is not a Float32Array of ${count * width || 'the splats'}`);
    }
  }
  const { shN = new Float32Array(), positions = null, axes = '', origin = [0, 0, 0] } = splats;
  const degree = COEFFICIENTS.findIndex((coefficients) => shN.length === 3 * coefficients * count);
  if (!(shN instanceof Float32Array) || degree < 0) {
    throw new CsplatError(`E_INPUT: shN has ${shN.length} elements, which match no SH degree from 0 to 4`);
  }
  if (positions !== null && !(positions instanceof Float64Array && positions.length === 3 * count)) {
    throw new CsplatError(`E_INPUT: positions is not a Float64Array of ${3 * count}`);
  }
  if (origin.length !== 3 || (axes !== '' && axes.length !== 3)) {
    throw new CsplatError('E_INPUT: origin is not three numbers, or axes are not three letters');
  }
  return degree;
}

/** What a thread is asked to do, by name. */
export const TASKS = {
  /** @param {EncodeOptions} options @param {Splats} splats */
  async encode(options, splats) {
    const instance = await Instance.create(options);
    instance.putSplats(splats);
    return instance.encode(options.sourceIndex);
  },

  /** @param {EncodeOptions} options @param {ArrayBuffer | Uint8Array} ply */
  async readPly(options, ply) {
    const instance = await Instance.create(options);
    instance.readPly(ply);
    return instance.takeSplats();
  },

  /** @param {EncodeOptions} options @param {ArrayBuffer | Uint8Array} ply */
  async encodePly({ onProgress, signal }, ply) {
    let share = 0.2; // of the work, that reading takes
    const instance = await Instance.create({
      signal,
      onProgress: (done) => onProgress?.(share < 1 ? done * share : 0.2 + 0.8 * done),
    });
    instance.readPly(ply);
    share = 1;
    const [splatCount, rowCount] = [instance.fields[FIELDS.count], instance.fields[FIELDS.rowCount]];
    return { file: instance.encode(undefined), splatCount, rowCount };
  },
};
