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

/**
 * Return true if this version knows the type of a column; other columns are not returned (ANC-3).
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
    this.buffers = this.records.map(({ bytes }) => new ArrayBuffer(count * bytes));
  }

  /**
   * @param {Elements[]} columns
   * @param {number} first index of the first splat
   */
  put(columns, first) {
    for (const [column, { low, high, width }] of columns.entries()) {
      const buffer = this.buffers[column];
      if (width === 1) new Uint8Array(buffer).set(low, first);
      else if (width === 2) new Uint16Array(buffer).set(low, first);
      else if (high === null) new Uint32Array(buffer).set(low, first);
      else {
        const halves = new Uint32Array(buffer);
        for (let i = 0; i < low.length; i++) {
          halves[2 * (first + i)] = low[i];
          halves[2 * (first + i) + 1] = high[i];
        }
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
