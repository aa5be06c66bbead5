// SPDX-License-Identifier: Apache-2.0
// Extra columns (spec 4.3.3, 6.4.6): carried bit for bit.

/**
 * @typedef {import('./decoder.d.ts').ExtraRecord} ExtraRecord
 * @typedef {import('./decoder.d.ts').ExtraArray} ExtraArray
 * @typedef {import('./streams.mjs').Elements} Elements
 */

/** @type {Record<string, (buffer: ArrayBuffer) => ExtraArray>} */
const EXTRA_VIEWS = {
  u8: (buffer) => new Uint8Array(buffer),
  i8: (buffer) => new Int8Array(buffer),
  u16: (buffer) => new Uint16Array(buffer),
  i16: (buffer) => new Int16Array(buffer),
  u32: (buffer) => new Uint32Array(buffer),
  i32: (buffer) => new Int32Array(buffer),
  f32: (buffer) => new Float32Array(buffer),
  f64: (buffer) => new Float64Array(buffer),
};

/** Unsigned integers by width; those of eight bytes are two halves. @type {Record<number, any>} */
const WORDS = { 1: Uint8Array, 2: Uint16Array, 4: Uint32Array, 8: Uint32Array };

/**
 * Return true if this version knows type and coding of a column; other columns are not returned (ANC-3).
 *
 * @param {ExtraRecord} record
 * @returns {record is ExtraRecord & {dtype: string}}
 */
export const isKnown = (record) => record.dtype !== null;

/** Extra columns as raw bits: floats are never read as numbers, so that NaN keep their bits. */
export class ExtraArrays {
  /**
   * @param {number} count splats
   * @param {ExtraRecord[]} records
   */
  constructor(count, records) {
    this.records = records.filter(isKnown);
    this.buffers = this.records.map(({ components, bytes }) => new ArrayBuffer(count * components * bytes));
  }

  /**
   * @param {number} layer of the column
   * @param {Elements} elements those of component 0 of all splats, then those of component 1, and so on
   * @param {number} count splats
   * @param {number} first index of the first splat
   */
  put(layer, { low, high, width }, count, first) {
    const column = this.records.findIndex((record) => record.layer === layer);
    if (column < 0) return; // some of the tiles are coarser and have none
    const { components } = this.records[column];
    const array = new WORDS[width](this.buffers[column]);
    const stride = high === null ? 1 : 2;
    for (let component = 0, from = 0; component < components; component++) {
      for (let to = components * first + component, i = 0; i < count; i++, from++, to += components) {
        array[stride * to] = low[from];
        if (high !== null) array[stride * to + 1] = high[from];
      }
    }
  }

  /** @returns {Record<string, ExtraArray>} without a prototype, since a column may have any name */
  byName() {
    const columns = Object.create(null);
    for (const [i, { name, dtype }] of this.records.entries()) columns[name] = EXTRA_VIEWS[dtype](this.buffers[i]);
    return columns;
  }
}
