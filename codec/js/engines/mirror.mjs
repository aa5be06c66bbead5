// SPDX-License-Identifier: Apache-2.0
// Mirrors packed tiles in x, for left-handed scenes in engines that can rotate splats but not mirror them.

/**
 * @typedef {import('../decoder.d.ts').Packed} Packed
 * @typedef {import('../decoder.d.ts').PackedColumns} PackedColumns
 * @typedef {import('../decoder.d.ts').PackedGeometry} PackedGeometry
 */

const ODD = [[], [2], [0, 3], [1, 4, 6]]; // per band, the coefficients whose basis function is odd in x

/** @type {WeakMap<PackedColumns, PackedColumns>} mirrored codebook tables, which many tiles share */
const tables = new WeakMap();

/**
 * @template {PackedGeometry} T
 * @param {T} tile
 * @returns {T}
 */
export const mirroredGeometry = (tile) => ({
  ...tile,
  means: negated(tile.means, [0]),
  quats: negated(tile.quats, [1, 2]), // mirrors the axis and reverses the angle
});

/**
 * @param {Packed} band
 * @param {number} layer 1 to 3
 * @returns {Packed}
 */
export function mirroredBand(band, layer) {
  const terms = 2 * layer + 1;
  const columns = [0, 1, 2].flatMap((channel) => ODD[layer].map((term) => channel * terms + term));
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
