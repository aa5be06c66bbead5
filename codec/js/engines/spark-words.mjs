// SPDX-License-Identifier: Apache-2.0
// Packs tiles into the words of Spark's splats. Independent of the engine, for testing.

import { displayColour, eachThinnest, places, putAlphas, putBand, putColumns, putQuats } from './packed_values.mjs';

/**
 * @typedef {import('../decoder.d.ts').Header} Header
 * @typedef {import('../decoder.d.ts').Packed} Packed
 * @typedef {import('../decoder.d.ts').PackedColumns} PackedColumns
 * @typedef {import('../decoder.d.ts').PackedTile} PackedTile
 * @typedef {import('./scene.mjs').Band} Band
 * @typedef {{rgbMin: number, rgbMax: number, lnScaleMin: number, lnScaleMax: number, sh1Max: number, sh2Max: number, sh3Max: number}} SplatEncoding
 */

const ROW = 2048; // splats per row of a texture; incomplete rows are lost
const LAYER = ROW * 2048;
const LN_SCALE_ZERO = -30;
const SH_BITS = [7, 8, 6];
const SH_WORDS = [2, 4, 4];

/** Number of splats to allocate in Spark's arrays. @param {number} count */
export const paddedCount = (count) => {
  const unit = count > LAYER ? LAYER : ROW;
  return Math.max(1, Math.ceil(count / unit)) * unit;
};

/**
 * Return true if float16 centres, as in PackedSplats, are off by at most one step of the file anywhere in the scene.
 *
 * @param {Header} header
 */
export function halvesSuffice({ tiles }) {
  return tiles.every(({ min, max, step }) => {
    const farthest = Math.max(...min.map(Math.abs), ...max.map(Math.abs));
    return farthest < 65504 && 2 ** (Math.floor(Math.log2(farthest)) - 11) <= step;
  });
}

/** Arrays of ExtSplats: float32 centres, float16 colours, alphas and logarithms of scales, 32 bits of rotation. */
export class ExtWords {
  /** @param {Header} header */
  constructor(header) {
    this.header = header;
    this.extArrays = /** @type {[Uint32Array, Uint32Array]} */ ([this.words(), this.words()]);
    /** @type {Record<string, Uint32Array>} */
    this.extra = {};
  }

  words() {
    return new Uint32Array(4 * paddedCount(this.header.splatCount));
  }

  /**
   * @param {PackedTile} tile
   * @param {number} first splat
   */
  put(tile, first) {
    const { header } = this;
    const [a, b] = this.extArrays;
    const halves = new Uint16Array(b.buffer);
    putColumns(tile.means, places(new Float32Array(a.buffer), 4, 0), first, (mean) => mean);
    this.fade(tile, first);
    putColumns(tile.sh0, places(halves, 8, 0), first, (sh0) => half(displayColour(sh0)));
    putColumns(tile.scales, places(halves, 8, 3), first, half);
    if (header.flat) eachThinnest(tile, (i, c) => (halves[8 * (first + i) + 3 + c] = half(LN_SCALE_ZERO)));
    eachQuat(tile, header, (i, w, x, y, z) => (b[4 * (first + i) + 3] = octahedral(w, x, y, z, 10, 12)));
  }

  /**
   * @param {Pick<PackedTile, 'opacities'>} tile
   * @param {number} first splat
   * @param {number} [shares]
   */
  fade(tile, first, shares) {
    putAlphas(tile, this.header, { array: this.extArrays[0], stride: 4, start: 3 }, first, half, shares);
  }

  /**
   * Make splats invisible, and their SH zero.
   *
   * @param {number} first splat
   * @param {number} count
   */
  clear(first, count) {
    for (const array of [...this.extArrays, ...Object.values(this.extra)])
      array.fill(0, 4 * first, 4 * (first + count));
  }

  /**
   * Add the bands of a layer, lower layers first.
   *
   * @param {number} layer
   * @param {Band[]} bands
   */
  addBands(layer, bands) {
    for (const name of [['sh1'], ['sh2'], ['sh3a', 'sh3b']][layer - 1]) this.extra[name] = this.words();
    for (const band of bands) this.putBand(layer, band);
  }

  /**
   * @param {number} layer
   * @param {Band} band
   */
  putBand(layer, { first, count, sh }) {
    const { sh1, sh2, sh3a, sh3b } = this.extra;
    const targets = [
      [[sh1, 0], [sh1, 1], [sh1, 2]],
      [[sh1, 3], [sh2, 0], [sh2, 1], [sh2, 2], [sh2, 3]],
      [[sh3a, 0], [sh3a, 1], [sh3a, 2], [sh3a, 3], [sh3b, 0], [sh3b, 1], [sh3b, 2]],
    ][layer - 1]; // prettier-ignore
    const values = bandValues(sh, layer, count);
    for (const [m, [array, word]] of /** @type {[Uint32Array, number][]} */ (targets).entries()) {
      for (let i = 0, at = 3 * m, to = 4 * first + word; i < count; i++, at += 3 * targets.length, to += 4) {
        array[to] = sharedExponent(values[at], values[at + 1], values[at + 2]);
      }
    }
  }
}

/** Arrays of PackedSplats: float16 centres and bytes for the rest, which hold the file's integers if they fit. */
export class PackedWords {
  /**
   * @param {Header} header
   * @param {PackedTile[]} tiles all tiles, for their ranges
   */
  constructor(header, tiles) {
    this.header = header;
    this.packedArray = new Uint32Array(4 * paddedCount(header.splatCount));
    /** @type {Record<string, Uint32Array>} */
    this.extra = {};
    const [rgbMin, rgbMax] = span(tiles.map(({ sh0 }) => sh0), 255).map(displayColour); // prettier-ignore
    const [lnScaleMin, lnScaleMax] = span(tiles.map(({ scales }) => scales), 254); // prettier-ignore
    /** @type {SplatEncoding} */
    this.splatEncoding = { rgbMin, rgbMax, lnScaleMin, lnScaleMax, sh1Max: 1, sh2Max: 1, sh3Max: 1 };
  }

  /**
   * @param {PackedTile} tile
   * @param {number} first splat
   */
  put(tile, first) {
    const { header, packedArray } = this;
    const { rgbMin, rgbMax, lnScaleMin, lnScaleMax } = this.splatEncoding;
    const bytes = new Uint8ClampedArray(packedArray.buffer); // rounds when written
    putColumns(
      tile.sh0,
      places(bytes, 16, 0),
      first,
      (sh0) => (255 * (displayColour(sh0) - rgbMin)) / (rgbMax - rgbMin),
    );
    putAlphas(tile, header, { array: bytes, stride: 16, start: 3 }, first, (alpha) => 255 * alpha);
    putColumns(tile.means, places(new Uint16Array(packedArray.buffer), 8, 2), first, half);
    const perScale = 254 / (lnScaleMax - lnScaleMin);
    putColumns(tile.scales, places(bytes, 16, 12), first, (scale) => Math.max(1, 1 + (scale - lnScaleMin) * perScale));
    if (header.flat) eachThinnest(tile, (i, c) => (bytes[16 * (first + i) + 12 + c] = 0));
    eachQuat(tile, header, (i, w, x, y, z) => {
      const word = octahedral(w, x, y, z, 8, 8);
      const at = 16 * (first + i);
      bytes[at + 10] = word & 255;
      bytes[at + 11] = (word >>> 8) & 255;
      bytes[at + 15] = (word >>> 16) & 255;
    });
  }

  /**
   * @param {1 | 2 | 3} layer
   * @param {Band[]} bands all bands of the layer, for their range
   */
  addBands(layer, bands) {
    const columns = bands.flatMap(({ sh }) => [sh, ...(sh.lookup ? [sh.lookup.table] : [])]);
    this.splatEncoding[`sh${layer}Max`] = largest(columns, 2 ** (SH_BITS[layer - 1] - 1) - 1);
    this.extra[`sh${layer}`] = new Uint32Array(SH_WORDS[layer - 1] * paddedCount(this.header.splatCount));
    for (const band of bands) this.putBand(layer, band);
  }

  /**
   * @param {1 | 2 | 3} layer
   * @param {Band} band
   */
  putBand(layer, { first, count, sh }) {
    const values = bandValues(sh, layer, count);
    const width = 3 * (2 * layer + 1);
    const bits = SH_BITS[layer - 1];
    const limit = 2 ** (bits - 1) - 1;
    const scale = limit / this.splatEncoding[`sh${layer}Max`];
    const out = this.extra[`sh${layer}`];
    const words = SH_WORDS[layer - 1];
    for (let i = 0; i < count; i++) {
      for (let c = 0, place = 0; c < width; c++, place += bits) {
        const integer = Math.max(-limit, Math.min(limit, Math.round(values[i * width + c] * scale))) & (2 ** bits - 1);
        const at = words * (first + i) + (place >> 5);
        out[at] |= integer << (place & 31);
        if ((place & 31) + bits > 32) out[at + 1] |= integer >>> (32 - (place & 31));
      }
    }
  }
}

/**
 * Return the lowest and highest value. If possible, the highest is raised so that `levels` steps cover the range exactly.
 *
 * @param {PackedColumns[]} all
 * @param {number} levels
 */
function span(all, levels) {
  let [low, high, step] = [Infinity, -Infinity, Infinity];
  for (const columns of all) {
    const [least, most] = range(columns);
    low = Math.min(low, least * columns.step);
    high = Math.max(high, most * columns.step);
    step = Math.min(step, columns.step);
  }
  return low > high ? [0, 1] : [low, Math.max(high, low + levels * step)];
}

/**
 * Return the value of the integer `limit`: `limit` steps, or the largest magnitude if that is larger.
 *
 * @param {PackedColumns[]} all
 * @param {number} limit
 */
function largest(all, limit) {
  let [most, step] = [0, Infinity];
  for (const columns of new Set(all)) {
    most = Math.max(most, ...range(columns).map((integer) => Math.abs(integer * columns.step)));
    step = Math.min(step, columns.step);
  }
  return most === 0 ? 1 : Math.max(most, limit * step);
}

/**
 * Return the smallest and largest integer.
 *
 * @param {PackedColumns} packed
 */
function range({ columns, offsets }) {
  const n = columns.length / offsets.length;
  let [low, high] = [Infinity, -Infinity];
  for (let c = 0; c < offsets.length; c++) {
    for (let i = c * n; i < (c + 1) * n; i++) {
      const integer = offsets[c] + columns[i];
      if (integer < low) low = integer;
      if (integer > high) high = integer;
    }
  }
  return n ? [low, high] : [0, 0];
}

/**
 * @param {Packed} sh
 * @param {number} layer
 * @param {number} count
 * @returns {Float32Array} [count, 2·layer + 1, 3]
 */
function bandValues(sh, layer, count) {
  const width = 3 * (2 * layer + 1);
  const values = new Float32Array(width * count);
  putBand(sh, places(values, width, 0, width), 0, (value) => value);
  return values;
}

/**
 * @param {PackedTile} tile
 * @param {Header} header
 * @param {(splat: number, w: number, x: number, y: number, z: number) => void} put
 */
function eachQuat(tile, header, put) {
  const quats = new Float32Array(4 * tile.count);
  putQuats(tile.quats, header, places(quats, 4, 0, 4), 0, (value) => value);
  for (let i = 0; i < tile.count; i++) put(i, quats[4 * i], quats[4 * i + 1], quats[4 * i + 2], quats[4 * i + 3]);
}

const float = new Float32Array(1);
const floatBits = new Uint32Array(float.buffer);
const SHARED_SCALES = Float64Array.from({ length: 32 }, (_, exponent) => 255 * 2 ** (15 - exponent));

/** Return the bits of the nearest float16. @param {number} value */
export function half(value) {
  float[0] = value;
  const sign = (floatBits[0] >>> 16) & 0x8000;
  const magnitude = Math.abs(float[0]);
  if (!(magnitude < 65520)) return sign | 0x7c00;
  // Subnormal float16: multiples of 2^-24
  if (magnitude < 2 ** -14) return sign | roundEven(magnitude * 2 ** 24);
  const bits = floatBits[0] & 0x7fffffff;
  return sign | ((bits + 0xfff + ((bits >>> 13) & 1) - 0x38000000) >>> 13);
}

/** @param {number} value */
function roundEven(value) {
  const low = Math.floor(value);
  const over = value - low;
  return over > 0.5 || (over === 0.5 && low % 2 === 1) ? low + 1 : low;
}

/**
 * Encode three numbers as signed bytes with a shared exponent. Spark's own encoder uses the exponent below the largest of
 * them, and so clips values above that power of two.
 *
 * @param {number} r
 * @param {number} g
 * @param {number} b
 */
export function sharedExponent(r, g, b) {
  const x = Math.abs(r);
  const y = Math.abs(g);
  const z = Math.abs(b);
  float[0] = x > y ? (x > z ? x : z) : y > z ? y : z;
  const bits = floatBits[0];
  const above = (bits >>> 23) - 112 + ((bits & 0x7fffff) > 0 ? 1 : 0); // exponent of the smallest power of two that is not less, plus 15
  const exponent = above < 0 ? 0 : above > 31 ? 31 : above;
  const scale = SHARED_SCALES[exponent];
  const signs = (r < 0 ? 1 : 0) | (g < 0 ? 2 : 0) | (b < 0 ? 4 : 0);
  const high = (exponent << 3) | signs;
  return (sharedByte(x, scale) | (sharedByte(y, scale) << 8) | (sharedByte(z, scale) << 16) | (high << 24)) >>> 0;
}

/**
 * @param {number} value
 * @param {number} scale
 */
function sharedByte(value, scale) {
  const byte = (value * scale + 0.5) | 0;
  return byte > 255 ? 255 : byte;
}

/**
 * Encode a rotation as an octahedral axis and an angle.
 *
 * @param {number} w at least 0
 * @param {number} x
 * @param {number} y
 * @param {number} z
 * @param {number} axisBits bits for each of two numbers
 * @param {number} angleBits
 */
export function octahedral(w, x, y, z, axisBits, angleBits) {
  const norm = Math.sqrt(x * x + y * y + z * z);
  const sum = Math.abs(x) + Math.abs(y) + Math.abs(z);
  let u = norm < 1e-6 ? 1 : x / sum;
  let v = norm < 1e-6 ? 0 : y / sum;
  if (z < 0 && norm >= 1e-6) {
    const before = u;
    u = (1 - Math.abs(v)) * (u >= 0 ? 1 : -1);
    v = (1 - Math.abs(before)) * (v >= 0 ? 1 : -1);
  }
  const most = 2 ** axisBits - 1;
  const angle = Math.round((2 * Math.atan2(norm, w) * (2 ** angleBits - 1)) / Math.PI);
  const axis = (Math.round((0.5 * v + 0.5) * most) << axisBits) | Math.round((0.5 * u + 0.5) * most);
  return ((angle << (2 * axisBits)) | axis) >>> 0;
}
