// SPDX-License-Identifier: Apache-2.0
// Lattices: exact steps, colour lifting, and the conversion from integers to the arrays (spec 7.1, 7.2).

const ROWS_AT_ONCE = 1024; // rows of shN; keeps the rows that are written column by column in the cache

/** Minimum of step × 2^exponent of means (ATT-6, TIL-9): no product with it is subnormal in binary64. */
export const STEP_MIN = 2 ** -1022;

/** Minimum for scales and colours (ATT-10, LAT-1): no product with it is subnormal in binary32. */
export const SINGLE_MIN = 2 ** -126;

/**
 * Return x × 2^e without computing the power, which may be outside binary64 (spec 7.2).
 *
 * @param {number} x at least 2^−1022 and finite
 * @param {number} exponent an i16
 * @returns {number} exact, or 0 or Infinity if the result is outside [2^−1022, 2^1024)
 */
export function ldexp(x, exponent) {
  const view = new DataView(new ArrayBuffer(8));
  view.setFloat64(0, x);
  const high = view.getUint32(0);
  const biased = ((high >>> 20) & 0x7ff) + exponent;
  if (biased < 1) return 0;
  if (biased > 2046) return Infinity;
  view.setUint32(0, (high & 0x800fffff) | (biased << 20));
  return view.getFloat64(0);
}

/**
 * Convert whole columns of Y, Co, Cg to R, G, B in place (spec 7.1). All operations are exact below 2^53.
 *
 * @param {Float64Array} columns
 * @param {number} third elements per channel
 * @param {number} k chroma shift
 */
export function rgbFromYcocg(columns, third, k) {
  const unit = 2 ** k;
  for (let i = 0; i < third; i++) {
    const co = columns[third + i] * unit;
    const cg = columns[2 * third + i] * unit;
    const t = columns[i] - Math.floor(cg / 2);
    const b = t - Math.floor(co / 2);
    columns[i] = b + co;
    columns[third + i] = cg + t;
    columns[2 * third + i] = b;
  }
}

/**
 * Write columns [channel × rows + row] × s as `out`[splat, row, channel] (spec 7.2); the array rounds once.
 *
 * @param {Float32Array} out
 * @param {number} stride values per splat in `out`
 * @param {number} start position of the first row among them
 * @param {number} first splat
 * @param {Float64Array} columns three per row
 * @param {number} rows
 * @param {number} n splats
 * @param {number} s step
 */
export function putRows(out, stride, start, first, columns, rows, n, s) {
  for (let from = 0; from < n; from += ROWS_AT_ONCE) {
    const to = Math.min(n, from + ROWS_AT_ONCE);
    for (let row = 0; row < rows; row++) {
      const red = row * n,
        green = (rows + row) * n,
        blue = (2 * rows + row) * n;
      let at = (first + from) * stride + start + 3 * row;
      for (let i = from; i < to; i++, at += stride) {
        out[at] = columns[red + i] * s;
        out[at + 1] = columns[green + i] * s;
        out[at + 2] = columns[blue + i] * s;
      }
    }
  }
}

/**
 * Copy to each splat in `out` the row of a table that its index names.
 *
 * @param {Float32Array} out
 * @param {number} stride values per splat in `out`
 * @param {number} start position of the first value among them
 * @param {number} first splat
 * @param {Float32Array} values rows of the table
 * @param {number} width values per row, a multiple of 3
 * @param {Uint32Array} index
 */
export function copyRows(out, stride, start, first, values, width, index) {
  // Copies bits: copying floats would convert each to binary64 and back and take twice as long.
  const to = new Int32Array(out.buffer, out.byteOffset, out.length);
  const table = new Int32Array(values.buffer, values.byteOffset, values.length);
  let at = first * stride + start;
  for (let i = 0; i < index.length; i++, at += stride) {
    const from = index[i] * width;
    for (let j = 0; j < width; j += 3) {
      to[at + j] = table[from + j];
      to[at + j + 1] = table[from + j + 1];
      to[at + j + 2] = table[from + j + 2];
    }
  }
}

/**
 * Do the same as putRows for a list of splats.
 *
 * @param {Float32Array} out
 * @param {number} stride
 * @param {number} start
 * @param {number} first
 * @param {Float64Array} columns one element per listed splat
 * @param {number} rows
 * @param {Uint32Array} splats relative to `first`
 * @param {number} s step
 */
export function scatterRows(out, stride, start, first, columns, rows, splats, s) {
  const n = splats.length;
  for (let from = 0; from < n; from += ROWS_AT_ONCE) {
    const to = Math.min(n, from + ROWS_AT_ONCE);
    for (let column = 0; column < 3 * rows; column++) {
      const place = first * stride + start + 3 * (column % rows) + Math.floor(column / rows);
      for (let i = from; i < to; i++) out[splats[i] * stride + place] = columns[column * n + i] * s;
    }
  }
}

/**
 * Write columns [channel × rows + row] as `out`[splat, row, channel]. The halves of each integer are written separately:
 * creating a BigInt per value would take ten times as long.
 *
 * @param {BigInt64Array} out
 * @param {number} first splat
 * @param {Float64Array} columns
 * @param {number} rows
 * @param {number} n
 */
export function putWide(out, first, columns, rows, n) {
  const halves = new Int32Array(out.buffer); // low, high; this module only runs on little-endian platforms
  for (let channel = 0; channel < 3; channel++) {
    for (let row = 0; row < rows; row++) {
      const column = (channel * rows + row) * n;
      for (let i = 0; i < n; i++) {
        const value = columns[column + i]; // at most 2^53
        const at = 2 * (((first + i) * rows + row) * 3 + channel);
        halves[at] = value; // modulo 2^32
        halves[at + 1] = Math.floor(value / 4294967296);
      }
    }
  }
}
