// SPDX-License-Identifier: Apache-2.0
// Converts packed tiles to numbers of any type and layout, for the adapters of engines.

import { FADE_STEPS, fadedAlpha } from '../levels/shown_tiles.mjs';

/**
 * @typedef {import('../decoder.d.ts').AttributeRecord} AttributeRecord
 * @typedef {import('../decoder.d.ts').Header} Header
 * @typedef {import('../decoder.d.ts').Packed} Packed
 * @typedef {import('../decoder.d.ts').PackedColumns} PackedColumns
 * @typedef {import('../decoder.d.ts').PackedTile} PackedTile
 * @typedef {Float32Array | Float64Array | Uint8Array | Uint8ClampedArray | Uint16Array | Uint32Array} Numbers
 * @typedef {{array: Numbers, stride: number, start: number}} Place target of a value: array[i * stride + start] for splat i
 * @typedef {(value: number) => number} Change conversion to the engine's value; receives integers for `opacities`
 */

const SH_C0 = 0.28209479177387814;
const ROWS_AT_ONCE = 1024;

/** Display colour, 0 to 1 within the displayable range. @param {number} sh0 */
export const displayColour = (sh0) => 0.5 + SH_C0 * sh0;

/**
 * Write opacities to an engine's arrays.
 *
 * @param {Pick<PackedTile, 'opacities'>} tile
 * @param {Header} header
 * @param {Place} to
 * @param {number} first splat
 * @param {Change} change receives alpha
 * @param {number} [shares] that are drawn of splats that fade
 */
export function putAlphas({ opacities }, { attributes }, to, first, change, shares = FADE_STEPS) {
  const { levels, mapping } = /** @type {AttributeRecord} */ (attributes.find(({ name }) => name === 'opacities'));
  const alpha = (/** @type {number} */ q) => (mapping === 'square' ? (q * q) / (levels * levels) : q / levels);
  putColumns(opacities, [to], first, (q) => change(fadedAlpha(alpha(q), shares)));
}

/**
 * Return the places of adjacent values.
 *
 * @param {Numbers} array
 * @param {number} stride
 * @param {number} start
 * @param {number} [width]
 * @returns {Place[]}
 */
export const places = (array, stride, start, width = 3) =>
  Array.from({ length: width }, (_, column) => ({ array, stride, start: start + column }));

/**
 * Write the columns of one attribute to an engine's arrays.
 *
 * @param {PackedColumns} packed
 * @param {Place[]} to target of each column
 * @param {number} first splat
 * @param {Change} change
 */
export function putColumns(packed, to, first, change) {
  const n = packed.columns.length / to.length;
  const columns = to.map(({ array }, c) => {
    const column = packed.columns.subarray(c * n, (c + 1) * n);
    const value = valueOf(packed, c, change);
    return { column, value, table: tableOf(column, value, array) };
  });
  inBlocks(n, to, (from, end, { array, stride, start }, c) => {
    const { column, value, table } = columns[c];
    if (table) return gather(array, (first + from) * stride + start, stride, table, column, from, end);
    for (let i = from, at = (first + from) * stride + start; i < end; i++, at += stride) array[at] = value(column[i]);
  });
}

/**
 * Write an SH band to an engine's arrays. Coefficients that are not in the file are left unchanged.
 *
 * @param {Packed} band
 * @param {Place[]} to targets of a splat's values: R, G, B of each coefficient in turn
 * @param {number} first splat
 * @param {Change} change
 */
export function putBand(band, to, first, change) {
  const rows = to.length / 3;
  const columns = to.map((_, c) => to[3 * (c % rows) + Math.floor(c / rows)]);
  if (!band.rows) return putColumns(band, columns, first, change);
  if (band.lookup) {
    const { table, index } = band.lookup;
    const size = table.columns.length / to.length;
    const tables = columns.map(({ array }, c) => {
      const entries = alike(array, size);
      const value = valueOf(table, c, change);
      for (let i = 0; i < size; i++) entries[i] = value(table.columns[c * size + i]);
      return entries;
    });
    inBlocks(index.length, columns, (from, end, { array, stride, start }, c) =>
      gather(array, (first + from) * stride + start, stride, tables[c], index, from, end),
    );
  }
  const n = band.rows.length;
  for (const [c, { array, stride, start }] of columns.entries()) {
    const value = valueOf(band, c, change);
    for (let i = 0; i < n; i++) array[(first + band.rows[i]) * stride + start] = value(band.columns[c * n + i]);
  }
}

/**
 * Write rotations as unit quaternions, w x y z.
 *
 * @param {PackedColumns} quats
 * @param {Header} header
 * @param {Place[]} to targets of w, x, y, z
 * @param {number} first splat
 * @param {Change} change
 */
export function putQuats(quats, header, to, first, change) {
  const n = quats.columns.length / 3;
  const read = quatReader(quats, header);
  const quat = new Float64Array(4);
  for (let i = 0; i < n; i++) {
    read(i, quat);
    for (let c = 0; c < 4; c++) to[c].array[(first + i) * to[c].stride + to[c].start] = change(quat[c]);
  }
}

/**
 * Write covariance matrices as xx, xy, xz, yy, yz, zz per splat.
 *
 * @param {Pick<PackedTile, 'count' | 'quats' | 'scales'>} tile
 * @param {Header} header
 * @param {Float32Array} out
 * @param {number} first splat
 */
export function putCovariances({ count, quats, scales }, header, out, first) {
  const variances = new Float64Array(3 * count);
  for (let c = 0; c < 3; c++) {
    const column = scales.columns.subarray(c * count, (c + 1) * count);
    const value = valueOf(scales, c, (scale) => Math.exp(2 * scale));
    const table = tableOf(column, value, variances);
    for (let i = 0; i < count; i++) variances[c * count + i] = table ? table[column[i]] : value(column[i]);
  }
  if (header.flat) eachThinnest({ count, scales }, (i, c) => (variances[c * count + i] = 0));
  const read = quatReader(quats, header);
  const quat = new Float64Array(4);
  for (let i = 0, at = 6 * first; i < count; i++, at += 6) {
    read(i, quat);
    const w = quat[0],
      x = quat[1],
      y = quat[2],
      z = quat[3];
    const a = variances[i],
      b = variances[count + i],
      c = variances[2 * count + i];
    const xx = 1 - 2 * (y * y + z * z),
      xy = 2 * (x * y - w * z),
      xz = 2 * (x * z + w * y),
      yx = 2 * (x * y + w * z),
      yy = 1 - 2 * (x * x + z * z),
      yz = 2 * (y * z - w * x),
      zx = 2 * (x * z - w * y),
      zy = 2 * (y * z + w * x),
      zz = 1 - 2 * (x * x + y * y);
    out[at] = a * xx * xx + b * xy * xy + c * xz * xz;
    out[at + 1] = a * xx * yx + b * xy * yy + c * xz * yz;
    out[at + 2] = a * xx * zx + b * xy * zy + c * xz * zz;
    out[at + 3] = a * yx * yx + b * yy * yy + c * yz * yz;
    out[at + 4] = a * yx * zx + b * yy * zy + c * yz * zz;
    out[at + 5] = a * zx * zx + b * zy * zy + c * zz * zz;
  }
}

/**
 * Call `put` with the column of each splat's smallest scale, which counts as zero in flat scenes.
 *
 * @param {Pick<PackedTile, 'count' | 'scales'>} tile
 * @param {(splat: number, column: number) => void} put
 */
export function eachThinnest({ count, scales: { columns, offsets } }, put) {
  const [a, b, c] = offsets;
  for (let i = 0; i < count; i++) {
    const [x, y, z] = [a + columns[i], b + columns[count + i], c + columns[2 * count + i]];
    put(i, x <= y && x <= z ? 0 : y <= z ? 1 : 2);
  }
}

/**
 * Return the linear map that makes a scene upright in an engine whose +y is up. It converts the axes of the file, RDF if they
 * are unknown, and then applies the shortest rotation of the metadata's `up` to +y.
 *
 * @param {Header} header
 * @param {Record<string, unknown> | null} metadata
 * @param {'RUB' | 'RUF'} engine letters of the engine's directions +x, +y, +z
 * @returns {number[][]} 3 × 3, by rows; with determinant −1 if exactly one of the two is left-handed
 */
export function uprightIn({ axes }, metadata, engine) {
  const opposite = /** @type {Record<string, string>} */ ({ R: 'L', L: 'R', U: 'D', D: 'U', F: 'B', B: 'F' });
  const from = [...(axes || 'RDF')];
  const map = [...engine].map((to) => from.map((one) => (one === to ? 1 : one === opposite[to] ? -1 : 0)));
  const up = upOf(metadata);
  if (up === null) return map;
  const [x, y, z] = map.map((row) => row[0] * up[0] + row[1] * up[1] + row[2] * up[2]);
  const a = y > -1 + 1e-9 ? 1 / (1 + y) : 0; // half a turn about x
  const turn = [
    [1 - a * x * x, -x, -a * x * z],
    [x, y, z],
    [-a * x * z, -z, y > -1 + 1e-9 ? 1 - a * z * z : -1],
  ];
  return turn.map((row) => [0, 1, 2].map((c) => row[0] * map[0][c] + row[1] * map[1][c] + row[2] * map[2][c]));
}

/**
 * Return the up direction in the metadata, normalised, or null if there is none.
 *
 * @param {Record<string, unknown> | null} metadata
 * @returns {number[] | null}
 */
function upOf(metadata) {
  const up = metadata?.up;
  if (!Array.isArray(up) || up.length !== 3 || !up.every((one) => Number.isFinite(one))) return null;
  const length = Math.hypot(...up);
  return length > 0 && length < Infinity ? up.map((one) => one / length) : null;
}

/** @type {Set<string>} */
const said = new Set();

/**
 * Log a message to the console, once.
 *
 * @param {string} name name of the adapter
 * @param {string} text
 */
export function onceSaid(name, text) {
  const line = `${name}: ${text}`;
  if (!said.has(line)) console.warn(line);
  said.add(line);
}

/**
 * Return a function from a column's elements to the engine's values.
 *
 * @param {PackedColumns} packed
 * @param {number} column
 * @param {Change} change
 * @returns {Change}
 */
function valueOf({ offsets, step }, column, change) {
  const offset = offsets[column];
  return step === 0
    ? (element) => change(offset + element)
    : (element) => change(Math.fround((offset + element) * step));
}

/**
 * Return a table of the values of all possible elements, if the column is long enough to make up for the cost.
 *
 * @param {PackedColumns['columns']} column
 * @param {Change} value
 * @param {Numbers} target
 */
function tableOf(column, value, target) {
  const size = 2 ** (8 * column.BYTES_PER_ELEMENT);
  if (size > Math.min(column.length, 65536)) return null;
  const table = alike(target, size);
  for (let element = 0; element < size; element++) table[element] = value(element);
  return table;
}

/** A new array of the same type, so that copies are exact. @param {Numbers} array @param {number} length @returns {Numbers} */
const alike = (array, length) => new /** @type {any} */ (array.constructor)(length);

/**
 * Call `put` for each column of a block of rows that fits the cache, block after block.
 *
 * @param {number} n number of rows
 * @param {Place[]} to
 * @param {(from: number, end: number, place: Place, column: number) => void} put
 */
function inBlocks(n, to, put) {
  for (let from = 0; from < n; from += ROWS_AT_ONCE) {
    for (const [c, place] of to.entries()) put(from, Math.min(n, from + ROWS_AT_ONCE), place, c);
  }
}

/**
 * @param {Numbers} array
 * @param {number} at
 * @param {number} stride
 * @param {Numbers} table
 * @param {PackedColumns['columns']} index
 * @param {number} from
 * @param {number} end
 */
function gather(array, at, stride, table, index, from, end) {
  for (let i = from; i < end; i++, at += stride) array[at] = table[index[i]];
}

/**
 * @param {PackedColumns} quats
 * @param {Header} header
 * @returns {(splat: number, out: Float64Array) => void} writes w x y z
 */
function quatReader({ columns, offsets: [x0, y0, z0] }, { attributes }) {
  const { levels } = /** @type {AttributeRecord} */ (attributes.find(({ name }) => name === 'quats'));
  const n = columns.length / 3;
  const square = 2 * levels * levels;
  const unit = 1 / (levels * Math.SQRT2);
  return (i, out) => {
    const x = x0 + columns[i],
      y = y0 + columns[n + i],
      z = z0 + columns[2 * n + i];
    out[0] = Math.sqrt(square - x * x - y * y - z * z) * unit;
    out[1] = x * unit;
    out[2] = y * unit;
    out[3] = z * unit;
  };
}
