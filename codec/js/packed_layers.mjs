// SPDX-License-Identifier: Apache-2.0
// The form 'packed', for callers that draw or store integers: in the narrowest type of each tile's layer, codebooks as
// tables.

import { entryColumns } from './codebooks.mjs';
import { columnCount } from './codings.mjs';
import { ldexp } from './lattice.mjs';
import * as spec from './spec.mjs';

/**
 * @typedef {import('./decoder.d.ts').AttributeRecord} AttributeRecord
 * @typedef {import('./decoder.d.ts').Packed} Packed
 * @typedef {import('./decoder.d.ts').PackedColumns} PackedColumns
 * @typedef {import('./codings.mjs').Block} Block
 */

/**
 * Pack the blocks of one layer.
 *
 * @param {Block[]} blocks
 * @param {number} layer
 * @param {number} count number of splats
 * @returns {any} PackedGeometry for layer 0, PackedBand for the others
 */
export function packLayer(blocks, layer, count) {
  if (layer !== spec.LAYER_GEOMETRY) return { count, sh: packBlock(blocks[0]) };
  return { count, ...Object.fromEntries(blocks.map((block) => [block.attribute.name, packBlock(block)])) };
}

/**
 * @param {Block} block
 * @returns {Packed}
 */
function packBlock({ attribute, columns, exponent, lookup, present }) {
  const step = attribute.step === 0 ? 0 : ldexp(attribute.step, exponent);
  const packed = packColumns(columns, columnCount(attribute), step);
  if (lookup === undefined) return present ? { ...packed, rows: present } : packed;
  const { id, index, escaped, table } = lookup;
  // All tiles share the packed table. It belongs to one attribute, since a band has its own chunk.
  table.packed ??= packColumns(entryColumns(table, attribute), columnCount(attribute), attribute.step);
  return { ...packed, rows: escaped, lookup: { codebook: id, table: table.packed, index: narrow(index, table.size) } };
}

/**
 * @param {Float64Array} columns
 * @param {number} count number of columns
 * @param {number} step
 * @returns {PackedColumns}
 */
function packColumns(columns, count, step) {
  const n = columns.length / count;
  const offsets = [];
  let most = 0;
  for (let c = 0; c < count; c++) {
    let low = n ? Infinity : 0;
    let high = n ? -Infinity : 0;
    for (let i = c * n; i < (c + 1) * n; i++) {
      low = Math.min(low, columns[i]);
      high = Math.max(high, columns[i]);
    }
    offsets.push(low);
    most = Math.max(most, high - low);
  }
  // The differences of such integers may need more than 53 bits.
  if (most >= 2 ** 32) return { columns: columns.slice(), offsets: offsets.fill(0), step };
  const out = arrayFor(most, columns.length);
  for (let c = 0; c < count; c++) {
    const offset = offsets[c];
    for (let i = c * n; i < (c + 1) * n; i++) out[i] = columns[i] - offset;
  }
  return { columns: out, offsets, step };
}

/**
 * @param {Uint32Array} index
 * @param {number} most
 */
function narrow(index, most) {
  const out = arrayFor(most, index.length);
  out.set(index);
  return out;
}

/**
 * @param {number} most largest element, an integer below 2^32
 * @param {number} length
 */
function arrayFor(most, length) {
  if (most < 2 ** 8) return new Uint8Array(length);
  return most < 2 ** 16 ? new Uint16Array(length) : new Uint32Array(length);
}
