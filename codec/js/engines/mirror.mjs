// SPDX-License-Identifier: Apache-2.0
// Mirrors packed tiles along axes: for left-handed scenes in engines that can rotate splats but not mirror them, and for
// scenes whose axes become the engine's by signs alone.

/**
 * @typedef {import('../decoder.d.ts').Packed} Packed
 * @typedef {import('../decoder.d.ts').PackedColumns} PackedColumns
 * @typedef {import('../decoder.d.ts').PackedGeometry} PackedGeometry
 */

// Per axis and band, the coefficients whose basis function is odd along the axis.
const ODD = [
  [[], [2], [0, 3], [1, 4, 6]],
  [[], [0], [0, 1], [0, 1, 2]],
  [[], [1], [1, 3], [1, 3, 5]],
];

/** @type {WeakMap<PackedColumns, PackedColumns>} mirrored codebook tables, which many tiles share */
const tables = new WeakMap();

/**
 * @template {PackedGeometry} T
 * @param {T} tile
 * @param {number[]} signs of each axis, −1: mirror along it
 * @returns {T}
 */
export function mirroredGeometry(tile, signs) {
  const handedness = signs[0] * signs[1] * signs[2]; // −1 reverses the angles of rotations
  const negative = (/** @type {number} */ factor) => [0, 1, 2].filter((axis) => factor * signs[axis] < 0);
  return { ...tile, means: negated(tile.means, negative(1)), quats: negated(tile.quats, negative(handedness)) };
}

/**
 * @param {Packed} band
 * @param {number} layer 1 to 3
 * @param {number[]} signs of each axis, −1: mirror along it
 * @returns {Packed}
 */
export function mirroredBand(band, layer, signs) {
  const terms = 2 * layer + 1;
  const signOf = (/** @type {number} */ term) =>
    signs.reduce((sign, one, axis) => (ODD[axis][layer].includes(term) ? sign * one : sign), 1);
  const negative = Array.from({ length: terms }, (_, term) => term).filter((term) => signOf(term) < 0);
  const columns = [0, 1, 2].flatMap((channel) => negative.map((term) => channel * terms + term));
  const mirrored = { ...band, ...negated(band, columns) };
  if (!band.lookup) return mirrored;
  const { table } = band.lookup;
  const known = tables.get(table) ?? negated(table, columns);
  tables.set(table, known);
  return { ...mirrored, lookup: { ...band.lookup, table: known } };
}

/**
 * Negate the values of the columns in `which`, exactly and without widening them.
 *
 * @param {PackedColumns} packed
 * @param {number[]} which
 * @returns {PackedColumns}
 */
function negated({ columns, offsets, step }, which) {
  const out = columns.slice();
  const starts = [...offsets];
  const n = columns.length / offsets.length;
  const most = out instanceof Float64Array ? 0 : 2 ** (8 * out.BYTES_PER_ELEMENT) - 1;
  for (const column of which) {
    for (let i = column * n; i < (column + 1) * n; i++) out[i] = most - columns[i];
    starts[column] = -(offsets[column] + most);
  }
  return { columns: out, offsets: starts, step };
}
