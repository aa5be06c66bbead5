// SPDX-License-Identifier: Apache-2.0
// Packs a tile's integers into texels of four 32-bit words. shaders.mjs and codec/wgsl/layout.wgsl read them.
//
// Geometry is a string of bits per splat: means x y z, opacity, scales (three), quats x y z, sh0 r g b. The tile determines
// the bits of each field. The first 128 bits are a texel; the rest follows in a separate array of words. Colours of SH bands
// are rows of equal fields that do not cross words: entries of a codebook, or one row per splat. Indices of a codebook are
// such fields too. Each of these arrays of words is padded to whole texels.

/**
 * @typedef {import('../../codec/js/decoder.d.ts').AttributeRecord} AttributeRecord
 * @typedef {import('../../codec/js/decoder.d.ts').Packed} Packed
 * @typedef {import('../../codec/js/decoder.d.ts').PackedColumns} PackedColumns
 * @typedef {import('../../codec/js/decoder.d.ts').PackedGeometry} PackedGeometry
 * @typedef {Uint8Array | Uint16Array | Uint32Array | Float64Array} Elements
 *
 * Values are `offset` + field × step, or binary32 patterns if a field has 32 bits (offset and step are then unused).
 *
 * @typedef {object} GeometryTexels
 * @property {number} count splats
 * @property {Uint32Array<ArrayBuffer>} first [4 × count], the first texel of each splat
 * @property {Uint32Array<ArrayBuffer> | null} more [moreWords × count], padded
 * @property {number} moreWords words per splat in `more`
 * @property {{means: number[], quats: number, scales: number, opacities: number, sh0: number}} bits bits per field
 * @property {{offsets: number[], step: number}} scales
 * @property {{offsets: number[], step: number}} sh0
 *
 * Rows of SH coefficients, r g b of each in turn; a value is (offset + field) × step, or a binary32 pattern.
 *
 * @typedef {{texels: Uint32Array<ArrayBuffer>, rowWords: number, rows: number, bits: number, offset: number, step: number}} Rows
 *
 * An SH band of a tile: a row per splat, or indices of rows and a row for each escaped splat (null if there are none). An
 * index of `size` + k refers to the k-th of these.
 *
 * @typedef {{rows: Rows | null, codebook: {id: number, size: number, index: Uint32Array<ArrayBuffer>, indexBits: number} | null}} BandTexels
 */

/** The first slot of a tile is a multiple of this: a workgroup of WebGPU draws a block, and a table gives its tile. */
export const BLOCK_SPLATS = 256;

/** Slots of a page: the buffers of its tiles stay below WebGPU's default limit, whatever their fields. */
const PAGE_SLOTS = BLOCK_SPLATS << 10;

/** Integers of up to this many bits, and their sums with offsets of the same size, are exact in binary32. */
const EXACT_BITS = 23;
const FLOAT_BITS = 32;
const TEXEL_WORDS = 4;

/**
 * Divide slots of splats into pages, which tiles do not cross.
 *
 * @param {{splatCount: number}[]} tiles
 * @param {number} most number of splats beyond which not all tiles are kept
 * @returns {{pages: number[], starts: number[] | null}} slots of each page; first slot of each tile, null if not all are kept
 */
export function pagesOf(tiles, most) {
  if (tiles.reduce((sum, { splatCount }) => sum + splatCount, 0) > most) {
    const count = Math.ceil(most / PAGE_SLOTS);
    const largest = tiles.reduce((slots, { splatCount }) => Math.max(slots, splatCount), most / count);
    return { pages: new Array(count).fill(Math.ceil(largest / BLOCK_SPLATS) * BLOCK_SPLATS), starts: null };
  }
  const pages = [0];
  const starts = [];
  let start = 0;
  for (const { splatCount } of tiles) {
    const slots = Math.ceil(splatCount / BLOCK_SPLATS) * BLOCK_SPLATS;
    if (pages[pages.length - 1] + slots > PAGE_SLOTS) pages.push(0);
    pages[pages.length - 1] += slots;
    starts.push(start);
    start += slots;
  }
  return { pages, starts };
}

/**
 * Pack layer 0 of a tile.
 *
 * @param {PackedGeometry} tile
 * @param {{levels: number}} opacities attribute record
 * @param {{levels: number}} quats attribute record
 * @returns {GeometryTexels}
 */
export function packGeometry(tile, opacities, quats) {
  const { count } = tile;
  const scales = fieldsOf(tile.scales, count);
  const sh0 = fieldsOf(tile.sh0, count);
  const levels = quats.levels;
  const meansBits = [0, 1, 2].map((axis) => bitsFor(largest(tile.means.columns, axis * count, count)));
  const bits = {
    means: meansBits,
    quats: bitsFor(2 * levels),
    scales: scales.bits,
    opacities: bitsFor(opacities.levels),
    sh0: sh0.bits,
  };
  const total = meansBits[0] + meansBits[1] + meansBits[2] + 3 * (bits.quats + bits.scales + bits.sh0) + bits.opacities;
  const words = Math.max(TEXEL_WORDS, Math.ceil(total / 32));
  const writer = new BitWriter(count, words);
  for (let axis = 0; axis < 3; axis++) writer.put(tile.means.columns, axis * count, 0, meansBits[axis]);
  writer.put(tile.opacities.columns, 0, tile.opacities.offsets[0], bits.opacities);
  for (let c = 0; c < 3; c++) writer.put(scales.fields, c * count, 0, bits.scales);
  for (let c = 0; c < 3; c++) writer.put(tile.quats.columns, c * count, tile.quats.offsets[c] + levels, bits.quats);
  for (let c = 0; c < 3; c++) writer.put(sh0.fields, c * count, 0, bits.sh0);
  return { count, ...splitTexels(writer.words, count, words), bits, scales: scales.values, sh0: sh0.values };
}

/** The fields of splats, one string of bits per splat. */
class BitWriter {
  /**
   * @param {number} count splats
   * @param {number} stride words per splat
   */
  constructor(count, stride) {
    this.count = count;
    this.stride = stride;
    this.words = new Uint32Array(count * stride);
    this.bit = 0;
  }

  /**
   * Append a field to every splat.
   *
   * @param {Elements} from
   * @param {number} first element
   * @param {number} add added to each element; the sum is not negative and has `bits` bits
   * @param {number} bits at most 32
   */
  put(from, first, add, bits) {
    const { count, stride, words } = this;
    const word = this.bit >>> 5;
    const shift = this.bit & 31;
    const crosses = shift + bits > 32;
    for (let i = 0, at = word; i < count; i++, at += stride) {
      const value = from[first + i] + add;
      words[at] |= value << shift;
      if (crosses) words[at + 1] = value >>> (32 - shift);
    }
    this.bit += bits;
  }
}

/**
 * @param {Uint32Array<ArrayBuffer>} words
 * @param {number} count
 * @param {number} stride words per splat
 */
function splitTexels(words, count, stride) {
  const moreWords = stride - TEXEL_WORDS;
  if (moreWords === 0) return { first: words, more: null, moreWords };
  const first = new Uint32Array(TEXEL_WORDS * count);
  const more = wholeTexels(moreWords * count);
  for (let i = 0; i < count; i++) {
    first.set(words.subarray(i * stride, i * stride + TEXEL_WORDS), i * TEXEL_WORDS);
    more.set(words.subarray(i * stride + TEXEL_WORDS, (i + 1) * stride), i * moreWords);
  }
  return { first, more, moreWords };
}

/** Return an array of at least `words` words, in whole texels. @param {number} words */
const wholeTexels = (words) => new Uint32Array(Math.ceil(words / TEXEL_WORDS) * TEXEL_WORDS);

/**
 * Return the fields of columns with a common width: integers relative to each column's offset, or binary32 patterns if
 * those would be too wide.
 *
 * @param {PackedColumns} packed
 * @param {number} count splats
 * @returns {{fields: Elements, bits: number, values: {offsets: number[], step: number}}}
 */
function fieldsOf({ columns, offsets, step }, count) {
  const bits = columns instanceof Float64Array ? FLOAT_BITS : bitsFor(largest(columns, 0, columns.length));
  if (bits <= EXACT_BITS) {
    return { fields: columns, bits, values: { offsets: offsets.map((offset) => offset * step), step } };
  }
  const floats = new Float32Array(columns.length);
  for (let i = 0; i < columns.length; i++) floats[i] = (offsets[Math.floor(i / count)] + columns[i]) * step;
  return {
    fields: new Uint32Array(floats.buffer),
    bits: FLOAT_BITS,
    values: { offsets: offsets.map(() => 0), step: 0 },
  };
}

/** @param {number} a @param {number} b */
const lesser = (a, b) => Math.min(a, b);

/**
 * Pack an SH band of a tile.
 *
 * @param {Packed} packed
 * @param {number} count splats
 * @returns {BandTexels}
 */
export function packBand(packed, count) {
  if (packed.lookup === undefined) return { rows: packRows(everySplat(packed, count)), codebook: null };
  const { codebook: id, table, index } = packed.lookup;
  const escaped = packed.rows ?? [];
  const size = table.columns.length / packed.offsets.length - 1; // without the last row, for escaped splats
  const full = Uint32Array.from(index);
  for (let k = 0; k < escaped.length; k++) full[escaped[k]] = size + k;
  const indexBits = bitsFor(Math.max(0, size + escaped.length - 1));
  const words = packFields(full, count, indexBits);
  const rows = escaped.length ? packRows(packed) : null;
  return { rows, codebook: { id, size, index: words, indexBits } };
}

/**
 * Expand packed columns to one row per splat.
 *
 * @param {Packed} packed without a codebook
 * @param {number} count splats
 * @returns {PackedColumns}
 */
function everySplat({ columns, offsets, step, rows }, count) {
  if (rows === undefined) return { columns, offsets, step };
  const all = new Float64Array(offsets.length * count);
  for (let c = 0; c < offsets.length; c++)
    for (let k = 0; k < rows.length; k++) all[c * count + rows[k]] = offsets[c] + columns[c * rows.length + k];
  const least = offsets.map((_, c) => all.subarray(c * count, (c + 1) * count).reduce(lesser));
  const narrow = new Uint32Array(all.length);
  for (let i = 0; i < all.length; i++) narrow[i] = all[i] - least[Math.floor(i / count)]; // below 2^24: LAT-4
  return { columns: narrow, offsets: least, step };
}

/**
 * Pack rows of colours, each starting at a word.
 *
 * @param {PackedColumns} packed
 * @returns {Rows}
 */
export function packRows({ columns, offsets, step }) {
  const width = offsets.length;
  const rows = columns.length / width;
  const offset = offsets.reduce(lesser);
  let high = -Infinity;
  for (let c = 0; c < width; c++) high = Math.max(high, offsets[c] + largest(columns, c * rows, rows));
  const isNarrow = !(columns instanceof Float64Array) && high - offset < 2 ** EXACT_BITS;
  const isExact = isNarrow && Math.abs(offset) < 2 ** EXACT_BITS;
  const bits = isExact ? bitsFor(high - offset) : FLOAT_BITS;
  const perWord = Math.floor(32 / bits);
  const rowWords = Math.ceil(width / perWord);
  const words = wholeTexels(rows * rowWords);
  const pattern = new Float32Array(1);
  const patternBits = new Uint32Array(pattern.buffer);
  for (let c = 0; c < width; c++) {
    const field = 3 * (c % (width / 3)) + Math.floor((3 * c) / width); // columns are channel by channel
    const shift = (field % perWord) * bits;
    let at = Math.floor(field / perWord);
    const add = offsets[c] - offset;
    for (let i = 0; i < rows; i++, at += rowWords) {
      if (isExact) words[at] |= (columns[c * rows + i] + add) << shift;
      else {
        pattern[0] = (offsets[c] + columns[c * rows + i]) * step;
        words[at] = patternBits[0];
      }
    }
  }
  return { texels: words, rowWords, rows, bits, offset: isExact ? offset : 0, step };
}

/**
 * Pack one field per splat, as many per word as fit.
 *
 * @param {Uint32Array} values
 * @param {number} count
 * @param {number} bits
 */
function packFields(values, count, bits) {
  const perWord = Math.floor(32 / bits);
  const words = wholeTexels(Math.ceil(count / perWord));
  for (let i = 0; i < count; i++) words[Math.floor(i / perWord)] |= values[i] << ((i % perWord) * bits);
  return words;
}

/** Return the number of bits of an unsigned integer below 2^32, at least 1. @param {number} most */
export const bitsFor = (most) => Math.max(1, 32 - Math.clz32(most));

/**
 * @param {Elements} elements not negative
 * @param {number} first
 * @param {number} count
 */
function largest(elements, first, count) {
  let most = 0;
  for (let i = first; i < first + count; i++) if (elements[i] > most) most = elements[i];
  return most;
}
