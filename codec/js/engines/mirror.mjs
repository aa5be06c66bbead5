// Packed tiles seen in a mirror, −x for x: for left-handed scenes in engines that can only turn splats.

/**
 * @typedef {import('../decoder.d.ts').Packed} Packed
 * @typedef {import('../decoder.d.ts').PackedColumns} PackedColumns
 * @typedef {import('../decoder.d.ts').PackedGeometry} PackedGeometry
 */

const ODD = [[], [2], [0, 3], [1, 4, 6]]; // coefficients of a band whose function of the direction is odd in x

/** @type {WeakMap<PackedColumns, PackedColumns>} of codebooks' tables, which many tiles have */
const tables = new WeakMap();

/**
 * @template {PackedGeometry} T
 * @param {T} tile
 * @returns {T}
 */
export const mirroredGeometry = (tile) => ({
  ...tile,
  means: negated(tile.means, [0]),
  quats: negated(tile.quats, [1, 2]), // the axis of a rotation is mirrored, its angle turns the other way
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
 * Columns with −(offset + element) where some have offset + element: exactly, and as narrow.
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
