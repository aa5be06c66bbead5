// SPDX-License-Identifier: Apache-2.0
// Render targets: records of projected splats and the picture; and the quads that are drawn.

import { UNITS } from './shader_programs.mjs';
import { RECORD_COLUMNS } from './shader_attributes.mjs';
import { makeTexture } from './textures.mjs';

/** @typedef {import('./types.d.ts').PictureFormat} PictureFormat */

/** Maximum number of records at a time, 8 MiB, for any number of splats. */
const RECORDS_MAX = 1 << 18;

/**
 * Create a framebuffer with textures of one size.
 *
 * @param {WebGL2RenderingContext} gl
 * @param {WebGLTexture[]} textures
 */
function makeFramebuffer(gl, textures) {
  const framebuffer = gl.createFramebuffer();
  gl.bindFramebuffer(gl.FRAMEBUFFER, framebuffer);
  textures.forEach((texture, i) => {
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0 + i, gl.TEXTURE_2D, texture, 0);
  });
  gl.drawBuffers(textures.map((_, i) => gl.COLOR_ATTACHMENT0 + i));
  const isComplete = gl.checkFramebufferStatus(gl.FRAMEBUFFER) === gl.FRAMEBUFFER_COMPLETE;
  return { framebuffer, isComplete };
}

/** Projected splats, 32 bytes each, in rows of RECORD_COLUMNS. */
export class Records {
  /**
   * @param {WebGL2RenderingContext} gl
   * @param {number} splatCount
   */
  constructor(gl, splatCount) {
    this.gl = gl;
    this.rows = Math.max(1, Math.ceil(Math.min(splatCount, RECORDS_MAX) / RECORD_COLUMNS));
    this.capacity = this.rows * RECORD_COLUMNS;
    this.bytes = this.capacity * 32;
    this.textures = [0, 1].map(() => makeTexture(gl, gl.RGBA32UI, RECORD_COLUMNS, this.rows));
    this.framebuffer = makeFramebuffer(gl, this.textures).framebuffer;
  }

  bind() {
    const { gl } = this;
    [UNITS.uRecordPlace, UNITS.uRecordLook].forEach((unit, i) => {
      gl.activeTexture(gl.TEXTURE0 + unit);
      gl.bindTexture(gl.TEXTURE_2D, this.textures[i]);
    });
  }

  /** @param {number} rows rows that will be written */
  target(rows) {
    const { gl } = this;
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.framebuffer);
    gl.viewport(0, 0, RECORD_COLUMNS, rows);
    gl.disable(gl.BLEND);
  }

  dispose() {
    this.gl.deleteFramebuffer(this.framebuffer);
    for (const texture of this.textures) this.gl.deleteTexture(texture);
  }
}

/** The picture that splats are blended into, in the best available format. */
export class Picture {
  /**
   * @param {WebGL2RenderingContext} gl
   * @param {PictureFormat} format
   */
  constructor(gl, format) {
    this.gl = gl;
    this.width = 0;
    this.height = 0;
    /** @type {WebGLTexture | null} */
    this.texture = null;
    /** @type {WebGLFramebuffer | null} */
    this.framebuffer = null;
    this.format = format;
  }

  get bytes() {
    return this.width * this.height * BYTES[this.format];
  }

  /**
   * @param {number} width
   * @param {number} height
   */
  resize(width, height) {
    if (width === this.width && height === this.height) return;
    this.dispose();
    const { gl } = this;
    this.texture = makeTexture(gl, gl[this.format], width, height);
    this.framebuffer = makeFramebuffer(gl, [this.texture]).framebuffer;
    [this.width, this.height] = [width, height];
  }

  clear() {
    const { gl } = this;
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.framebuffer);
    gl.clearBufferfv(gl.COLOR, 0, [0, 0, 0, 0]);
  }

  /** Blend over the existing content; colours are premultiplied by alpha. */
  target() {
    const { gl } = this;
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.framebuffer);
    gl.viewport(0, 0, this.width, this.height);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
  }

  /** @param {WebGLFramebuffer | null} target where to draw it; null for the canvas */
  show(target) {
    const { gl } = this;
    gl.bindFramebuffer(gl.FRAMEBUFFER, target);
    gl.viewport(0, 0, this.width, this.height);
    gl.disable(gl.BLEND);
    gl.activeTexture(gl.TEXTURE0 + UNITS.uPicture);
    gl.bindTexture(gl.TEXTURE_2D, this.texture);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }

  /**
   * Return it as bytes, top row first.
   *
   * @throws {RangeError} too little memory on the GPU
   */
  read() {
    const { gl, width, height } = this;
    const texture = makeTexture(gl, gl.RGBA8, width, height);
    const { framebuffer } = makeFramebuffer(gl, [texture]);
    this.show(framebuffer);
    const stride = 4 * width;
    const pixels = new Uint8Array(stride * height);
    gl.readPixels(0, 0, width, height, gl.RGBA, gl.UNSIGNED_BYTE, pixels);
    for (let low = 0, high = height - 1; low < high; low++, high--) {
      const row = pixels.slice(low * stride, (low + 1) * stride);
      pixels.copyWithin(low * stride, high * stride, (high + 1) * stride);
      pixels.set(row, high * stride);
    }
    gl.deleteFramebuffer(framebuffer);
    gl.deleteTexture(texture);
    if (gl.getError() === gl.OUT_OF_MEMORY) throw new RangeError('the GPU has too little memory');
    return pixels;
  }

  dispose() {
    this.gl.deleteFramebuffer(this.framebuffer);
    this.gl.deleteTexture(this.texture);
  }
}

/** Bytes per pixel. */
const BYTES = Object.freeze({ RGBA32F: 16, RGBA16F: 8, RGBA8: 4 });

/**
 * Choose the format of the picture: half floats, or floats for software renderers, in which they are several times
 * faster. If neither can be blended, bytes, which are rounded after each layer.
 *
 * @param {WebGL2RenderingContext} gl
 * @param {boolean} isSoftware
 * @param {PictureFormat} [wanted] used if available
 * @returns {PictureFormat}
 */
export function pictureFormat(gl, isSoftware, wanted) {
  const float = gl.getExtension('EXT_color_buffer_float');
  const half = gl.getExtension('EXT_color_buffer_half_float');
  /** @type {PictureFormat[]} */
  const possible = ['RGBA8'];
  if ((float || half) && canBeTarget(gl, gl.RGBA16F)) possible.unshift('RGBA16F');
  if (float && gl.getExtension('EXT_float_blend') && canBeTarget(gl, gl.RGBA32F)) possible.push('RGBA32F');
  const preferred = wanted ?? (isSoftware ? 'RGBA32F' : 'RGBA16F');
  return possible.includes(preferred) ? preferred : possible[0];
}

/**
 * @param {WebGL2RenderingContext} gl
 * @param {number} internal internal format
 */
function canBeTarget(gl, internal) {
  const texture = makeTexture(gl, internal, 1, 1);
  const { framebuffer, isComplete } = makeFramebuffer(gl, [texture]);
  gl.deleteFramebuffer(framebuffer);
  gl.deleteTexture(texture);
  return isComplete;
}

/** Quads, RECORD_COLUMNS per instance: a few large instances are faster than one per quad. */
export class Quads {
  /** @param {WebGL2RenderingContext} gl */
  constructor(gl) {
    this.gl = gl;
    const indices = new Uint16Array(6 * RECORD_COLUMNS);
    for (let quad = 0; quad < RECORD_COLUMNS; quad++) {
      indices.set(
        [0, 1, 2, 2, 1, 3].map((corner) => 4 * quad + corner),
        6 * quad,
      );
    }
    this.bytes = indices.byteLength;
    this.array = gl.createVertexArray();
    this.buffer = gl.createBuffer();
    gl.bindVertexArray(this.array);
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, this.buffer);
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, indices, gl.STATIC_DRAW);
  }

  /** @param {number} rows rows of records */
  draw(rows) {
    this.gl.drawElementsInstanced(this.gl.TRIANGLES, 6 * RECORD_COLUMNS, this.gl.UNSIGNED_SHORT, 0, rows);
  }

  dispose() {
    this.gl.deleteVertexArray(this.array);
    this.gl.deleteBuffer(this.buffer);
  }
}
