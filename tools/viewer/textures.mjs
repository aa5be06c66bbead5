// SPDX-License-Identifier: Apache-2.0
// Growing textures that are addressed by one number, row by row.

import { Ranges } from '../../codec/js/levels/ranges.mjs';
import { ROW_TEXELS } from './shader_attributes.mjs';

/**
 * The format of a texture.
 *
 * @typedef {{internal: number, format: number, type: number, channels: number, bytes: number}} Format
 * @typedef {Uint32Array | Float32Array} Texels
 */

/**
 * Return the formats that the renderer uses.
 *
 * @param {WebGL2RenderingContext} gl
 */
export function formats(gl) {
  const { RED_INTEGER, RGBA, RGBA_INTEGER, UNSIGNED_INT, FLOAT } = gl;
  return {
    words: { internal: gl.RGBA32UI, format: RGBA_INTEGER, type: UNSIGNED_INT, channels: 4, bytes: 16 },
    word: { internal: gl.R32UI, format: RED_INTEGER, type: UNSIGNED_INT, channels: 1, bytes: 4 },
    floats: { internal: gl.RGBA32F, format: RGBA, type: FLOAT, channels: 4, bytes: 16 },
  };
}

/**
 * Create a texture of fixed size without filtering.
 *
 * @param {WebGL2RenderingContext} gl
 * @param {number} internal internal format
 * @param {number} width
 * @param {number} height
 */
export function makeTexture(gl, internal, width, height) {
  const texture = gl.createTexture();
  gl.activeTexture(gl.TEXTURE0 + SCRATCH_UNIT);
  gl.bindTexture(gl.TEXTURE_2D, texture);
  gl.texStorage2D(gl.TEXTURE_2D, 1, internal, width, height);
  for (const [name, value] of [
    [gl.TEXTURE_MIN_FILTER, gl.NEAREST],
    [gl.TEXTURE_MAG_FILTER, gl.NEAREST],
    [gl.TEXTURE_WRAP_S, gl.CLAMP_TO_EDGE],
    [gl.TEXTURE_WRAP_T, gl.CLAMP_TO_EDGE],
  ]) {
    gl.texParameteri(gl.TEXTURE_2D, name, value);
  }
  return texture;
}

/** The texture unit for uploads; the textures that shaders read are bound to others. */
export const SCRATCH_UNIT = 15;

/** A sequence of texels, split into rows of ROW_TEXELS. */
export class LinearTexture {
  /**
   * @param {WebGL2RenderingContext} gl
   * @param {Format} format
   * @param {number} texels initial capacity
   */
  constructor(gl, format, texels) {
    this.gl = gl;
    this.format = format;
    this.rows = rowsFor(texels);
    this.width = Math.min(ROW_TEXELS, Math.max(1, texels));
    this.texture = makeTexture(gl, format.internal, this.width, this.rows);
  }

  get bytes() {
    return this.width * this.rows * this.format.bytes;
  }

  /**
   * Write texels at a position.
   *
   * @param {number} first texel
   * @param {Texels} data
   */
  write(first, data) {
    const { gl, format, width } = this;
    const { channels } = format;
    gl.activeTexture(gl.TEXTURE0 + SCRATCH_UNIT);
    gl.bindTexture(gl.TEXTURE_2D, this.texture);
    const end = first + data.length / channels;
    for (let at = first; at < end;) {
      const x = at % width;
      const isWhole = x === 0 && end - at >= width;
      const columns = isWhole ? width : Math.min(width - x, end - at);
      const rows = isWhole ? Math.floor((end - at) / width) : 1;
      const from = (at - first) * channels;
      const { format: pixels, type } = format;
      gl.texSubImage2D(gl.TEXTURE_2D, 0, x, Math.floor(at / width), columns, rows, pixels, type, data, from);
      at += columns * rows;
    }
  }

  /**
   * Change the capacity and keep the content.
   *
   * @param {number} texels
   */
  resize(texels) {
    const { gl, format } = this;
    const rows = rowsFor(texels);
    const old = this.texture;
    const kept = Math.min(rows, this.rows);
    this.texture = makeTexture(gl, format.internal, ROW_TEXELS, rows);
    const from = gl.createFramebuffer();
    gl.bindFramebuffer(gl.READ_FRAMEBUFFER, from);
    gl.framebufferTexture2D(gl.READ_FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, old, 0);
    gl.copyTexSubImage2D(gl.TEXTURE_2D, 0, 0, 0, 0, 0, this.width, kept);
    gl.bindFramebuffer(gl.READ_FRAMEBUFFER, null);
    gl.deleteFramebuffer(from);
    gl.deleteTexture(old);
    this.width = ROW_TEXELS;
    this.rows = rows;
  }

  dispose() {
    this.gl.deleteTexture(this.texture);
  }
}

/** @param {number} texels */
const rowsFor = (texels) => Math.max(1, Math.ceil(texels / ROW_TEXELS));

/** A texture of texels in ranges, which grows. */
export class Store {
  /**
   * @param {WebGL2RenderingContext} gl
   * @param {Format} format
   */
  constructor(gl, format) {
    this.ranges = new Ranges();
    this.linear = new LinearTexture(gl, format, ROW_TEXELS);
  }

  /**
   * Append texels.
   *
   * @param {Texels} data
   * @returns {{start: number, size: number}} their place
   */
  append(data) {
    const size = data.length / this.linear.format.channels;
    const start = this.ranges.take(size) ?? 0; // there is always room
    const { end } = this.ranges;
    if (end > this.linear.rows * ROW_TEXELS) this.linear.resize(Math.max(end, 1.5 * this.linear.rows * ROW_TEXELS));
    this.linear.write(start, data);
    return { start, size };
  }

  /** @param {{start: number, size: number}} range that is freed */
  give({ start, size }) {
    this.ranges.give(start, size);
  }

  /** Free unused capacity. */
  trim() {
    if (rowsFor(this.ranges.end) < this.linear.rows) this.linear.resize(this.ranges.end);
  }
}
