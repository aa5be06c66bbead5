// SPDX-License-Identifier: Apache-2.0
// The arrays that a decoder returns, filled tile by tile: floats (spec sections 3 and 7) or integers (9.2).

import { tableValues } from './codebooks.mjs';
import { columnCount, radicand } from './codings.mjs';
import { copyRows, ldexp, putRows, putWide, scatterRows } from './lattice.mjs';
import * as spec from './spec.mjs';

/**
 * @typedef {import('./decoder.d.ts').Header} Header
 * @typedef {import('./decoder.d.ts').TileRecord} TileRecord
 * @typedef {import('./decoder.d.ts').ExtraRecord} ExtraRecord
 * @typedef {import('./codings.mjs').Block} Block
 */

/** Rows of shN at an SH degree. @param {number} shDegree */
export const shRows = (shDegree) => (shDegree + 1) ** 2 - 1;

/**
 * Bytes of the arrays that the two classes below allocate; LIM-1 compares them with the budget.
 *
 * @param {number} count splats
 * @param {number} shDegree
 * @param {ExtraRecord[]} extras
 * @param {boolean} integers
 */
export function arrayBytes(count, shDegree, extras, integers) {
  const lattice = 3 + 3 + 3 * (shRows(shDegree) + 1);
  const values = integers ? 8 * lattice + 4 + 12 : 4 * (lattice + 1 + 4);
  return count * extras.reduce((sum, extra) => sum + extra.components * extra.bytes, values);
}

/** Arrays of floats. */
export class FloatArrays {
  /**
   * @param {number} count splats
   * @param {number} shDegree
   * @param {Partial<Record<string, Float32Array>>} [spare] arrays whose memory may be reused
   */
  constructor(count, shDegree, spare = {}) {
    const room = (/** @type {string} */ name, /** @type {number} */ length) => {
      const buffer = spare[name]?.buffer;
      if (buffer === undefined || buffer.byteLength < 4 * length) return new Float32Array(length);
      return new Float32Array(buffer, 0, length).fill(0);
    };
    this.means = room('means', 3 * count);
    this.quats = room('quats', 4 * count);
    this.scales = room('scales', 3 * count);
    this.opacities = room('opacities', count);
    this.sh0 = room('sh0', 3 * count);
    this.shN = room('shN', 3 * count * shRows(shDegree)); // zero: "coefficients of a band left out are +0"
    this.shDegree = shDegree;
  }

  /**
   * @param {Block} block
   * @param {TileRecord} tile
   * @param {number} first index in the arrays of the tile's first splat
   */
  put(block, tile, first) {
    const { attribute, columns, exponent } = block;
    const n = tile.splatCount;
    if (attribute.id === spec.ATTRIBUTE_OPACITIES)
      return putOpacities(this.opacities.subarray(first, first + n), block);
    if (attribute.id === spec.ATTRIBUTE_QUATS)
      return putQuats(this.quats.subarray(4 * first, 4 * (first + n)), block, n);
    const s = ldexp(attribute.step, exponent);
    if (attribute.id === spec.ATTRIBUTE_MEANS) return putRows(this.means, 3, 0, first, columns, 1, n, s);
    if (attribute.id === spec.ATTRIBUTE_SCALES) return putRows(this.scales, 3, 0, first, columns, 1, n, s);
    const band = attribute.id - spec.ATTRIBUTE_SH0;
    if (band === 0) return putColour(this.sh0, 3, 0, first, block, n, s);
    return putColour(this.shN, 3 * shRows(this.shDegree), 3 * (band * band - 1), first, block, n, s);
  }

  fields() {
    const { means, quats, scales, opacities, sh0, shN } = this;
    return { means, quats, scales, opacities, sh0, shN };
  }

  /** The arrays, with the number of values per splat of each. */
  columns() {
    const { means, quats, scales, opacities, sh0, shN, shDegree } = this;
    return Object.entries({
      means: { array: means, width: 3 },
      quats: { array: quats, width: 4 },
      scales: { array: scales, width: 3 },
      opacities: { array: opacities, width: 1 },
      sh0: { array: sh0, width: 3 },
      shN: { array: shN, width: 3 * shRows(shDegree) },
    });
  }
}

/**
 * Write opacities (spec 7.3); the array rounds the binary64 quotient once.
 *
 * @param {Float32Array} out
 * @param {Block} block
 */
function putOpacities(out, { attribute, columns }) {
  const { levels, mapping } = attribute;
  if (mapping === spec.MAPPING_NAMES[spec.MAPPING_SQUARE]) {
    const square = levels * levels; // below 2^32
    for (let i = 0; i < out.length; i++) out[i] = (columns[i] * columns[i]) / square;
  } else {
    for (let i = 0; i < out.length; i++) out[i] = columns[i] / levels;
  }
}

/**
 * Write quaternions (spec 7.5).
 *
 * @param {Float32Array} out
 * @param {Block} block
 * @param {number} n
 */
function putQuats(out, { attribute: { levels }, columns }, n) {
  const c = 1.0 / (levels * Math.SQRT2); // 0x1.6A09E667F3BCDp+0
  for (let i = 0, at = 0; i < n; i++, at += 4) {
    const q1 = columns[i],
      q2 = columns[n + i],
      q3 = columns[2 * n + i];
    out[at] = Math.sqrt(radicand(q1, q2, q3, levels)) * c;
    out[at + 1] = q1 * c;
    out[at + 2] = q2 * c;
    out[at + 3] = q3 * c;
  }
}

/**
 * Write colours, from columns or from a codebook's table and the escapes.
 *
 * @param {Float32Array} out
 * @param {number} stride values per splat in `out`
 * @param {number} start position of the band among them
 * @param {number} first splat
 * @param {Block} block
 * @param {number} n splats
 * @param {number} s step
 */
function putColour(out, stride, start, first, { attribute, columns, lookup, present }, n, s) {
  const width = columnCount(attribute);
  if (present !== undefined) return scatterRows(out, stride, start, first, columns, width / 3, present, s); // others are +0
  if (lookup === undefined) return putRows(out, stride, start, first, columns, width / 3, n, s);
  copyRows(out, stride, start, first, tableValues(lookup.table, attribute), width, lookup.index);
  scatterRows(out, stride, start, first, columns, width / 3, lookup.escaped, s);
}

/** Arrays of integers. */
export class IntegerArrays {
  /**
   * @param {number} count splats
   * @param {number} shDegree
   * @param {TileRecord[]} tiles the tiles that the arrays will hold, in this order
   * @param {number} attributeCount
   */
  constructor(count, shDegree, tiles, attributeCount) {
    this.opacities = new Uint32Array(count);
    this.scales = new BigInt64Array(3 * count);
    this.quats = new Int32Array(3 * count);
    this.means = new BigInt64Array(3 * count);
    this.sh0 = new BigInt64Array(3 * count);
    this.sh = Array.from({ length: shDegree }, (_, band) => new BigInt64Array(3 * count * (2 * band + 3)));
    this.tile_splats = Uint32Array.from(tiles, (tile) => tile.splatCount);
    this.exponents = new Int32Array(tiles.length * attributeCount);
    this.attributeCount = attributeCount;
    this.places = new Map(tiles.map((tile, place) => [tile, place]));
  }

  /**
   * @param {Block} block
   * @param {TileRecord} tile
   * @param {number} first index in the arrays of the tile's first splat
   */
  put({ attribute, columns, exponent }, tile, first) {
    const n = tile.splatCount;
    const { id } = attribute;
    const place = this.places.get(tile) ?? 0;
    this.exponents[place * this.attributeCount + id - spec.ATTRIBUTE_OPACITIES] = exponent;
    if (id === spec.ATTRIBUTE_OPACITIES) return this.opacities.set(columns, first);
    if (id === spec.ATTRIBUTE_QUATS) {
      for (let i = 0; i < n; i++) for (let c = 0; c < 3; c++) this.quats[3 * (first + i) + c] = columns[c * n + i];
      return;
    }
    const band = id - spec.ATTRIBUTE_SH0;
    const out =
      id === spec.ATTRIBUTE_SCALES
        ? this.scales
        : id === spec.ATTRIBUTE_MEANS
          ? this.means
          : band
            ? this.sh[band - 1]
            : this.sh0;
    putWide(out, first, columns, columnCount(attribute) / 3, n);
  }

  fields() {
    const { opacities, scales, quats, means, sh0, sh, tile_splats, exponents } = this;
    const bands = Object.fromEntries(sh.map((band, i) => [`sh${i + 1}`, band]));
    return { opacities, scales, quats, means, sh0, ...bands, tile_splats, exponents };
  }
}

/**
 * Return one SH band of one tile, [splat, coefficient, channel].
 *
 * @param {Block} block
 * @param {number} n splats
 * @param {boolean} integers
 */
export function bandArray(block, n, integers) {
  const { attribute, columns, exponent } = block;
  const width = columnCount(attribute);
  if (integers) {
    const out = new BigInt64Array(width * n);
    putWide(out, 0, columns, width / 3, n);
    return out;
  }
  const out = new Float32Array(width * n);
  putColour(out, width, 0, 0, block, n, ldexp(attribute.step, exponent));
  return out;
}

/**
 * Collect the buffers of all arrays in a message, except codebook tables, which are not transferred.
 *
 * @param {object} message
 * @returns {ArrayBuffer[]} without duplicates
 */
export function buffersOf(message) {
  /** @type {Set<ArrayBuffer>} */
  const found = new Set();
  const visit = (/** @type {object} */ value) => {
    for (const [name, one] of value instanceof Map ? value : Object.entries(value)) {
      if (ArrayBuffer.isView(one)) found.add(/** @type {ArrayBuffer} */ (one.buffer));
      else if (name !== 'table' && typeof one === 'object' && one !== null) visit(one);
    }
  };
  visit(message);
  return [...found];
}
