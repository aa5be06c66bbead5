// SPDX-License-Identifier: Apache-2.0
// The WebGL 2 back end. renderer.mjs documents its methods.

import { slopeLimits } from '../../codec/js/levels/level_cut.mjs';
import { ShaderPrograms } from './shader_programs.mjs';
import { SceneTextures } from './scene_textures.mjs';
import { RECORD_COLUMNS, ROW_TEXELS } from './shader_attributes.mjs';
import { Picture, Quads, pictureFormat } from './framebuffers.mjs';
import { warmUp } from './trial_scene.mjs';
import { SOFTWARE } from './webgpu_device.mjs';

/**
 * @typedef {import('./renderer.mjs').Capabilities} Capabilities
 * @typedef {import('./renderer.mjs').Renderer} Renderer
 * @typedef {import('./renderer.mjs').SceneLayout} SceneLayout
 * @typedef {import('./types.d.ts').PictureFormat} PictureFormat
 * @typedef {import('./types.d.ts').View} View
 */

/** @implements {Renderer} */
export class WebGl2Renderer {
  /**
   * @param {HTMLCanvasElement} canvas
   * @param {boolean} alpha whether the canvas may be transparent
   * @param {PictureFormat} [format] format of the picture, used if available
   */
  static create(canvas, alpha, format) {
    const gl = canvas.getContext('webgl2', {
      alpha,
      antialias: false,
      depth: false,
      stencil: false,
      powerPreference: 'high-performance',
    });
    const renderer = gl && new WebGl2Renderer(gl, format);
    if (renderer) warmUp(renderer);
    return renderer;
  }

  /**
   * @param {WebGL2RenderingContext} gl
   * @param {PictureFormat} [format]
   */
  constructor(gl, format) {
    const name = deviceName(gl);
    this.gl = gl;
    this.programs = new ShaderPrograms(gl);
    this.picture = new Picture(gl, pictureFormat(gl, SOFTWARE.test(name), format));
    this.quads = new Quads(gl);
    /** @type {Capabilities} */
    this.capabilities = {
      name,
      pictureFormat: this.picture.format,
      splatsMax: gl.getParameter(gl.MAX_TEXTURE_SIZE) * ROW_TEXELS,
      sideMax: Math.min(gl.getParameter(gl.MAX_TEXTURE_SIZE), ...gl.getParameter(gl.MAX_VIEWPORT_DIMS)),
      sorts: false,
    };
    /** @type {SceneTextures | null} */
    this.scene = null;
  }

  get bytes() {
    const work = this.picture.bytes + this.quads.bytes;
    if (this.scene === null) return { attributes: 0, order: 0, work };
    return { attributes: this.scene.bytes, order: this.scene.order.bytes, work: work + this.scene.records.bytes };
  }

  /** @param {SceneLayout | null} layout null for no scene */
  allocate(layout) {
    this.scene?.dispose();
    this.scene = null;
    if (layout) this.scene = new SceneTextures(this.gl, layout, this.capabilities.splatsMax);
  }

  complete() {
    this.scene?.store.trim();
  }

  /**
   * @param {View} view
   * @param {import('./renderer.mjs').Look} look
   */
  draw(view, look) {
    if (this.#blend(view, look)) this.picture.show(null);
  }

  /**
   * @param {View} view
   * @param {import('./renderer.mjs').Look} look
   */
  pixelsOf(view, look) {
    const pixels = this.#blend(view, look) && this.picture.read();
    return pixels && !this.gl.isContextLost() ? pixels : new Uint8Array(0);
  }

  /**
   * @param {View} view
   * @param {import('./renderer.mjs').Look} look
   * @returns {boolean} whether there is a picture
   */
  #blend(view, { background, shDegree }) {
    const { gl, scene, programs, picture } = this;
    if (gl.isContextLost() || !(view.width > 0 && view.height > 0)) return false;
    picture.resize(view.width, view.height);
    picture.clear();
    if (scene !== null && scene.count > 0) {
      scene.putPlaces(view);
      scene.bind();
      programs.setView(view, slopeLimits(view), scene.layout, Math.min(shDegree, scene.layout.shDegree));
      for (let begin = 0; begin < scene.count; begin += scene.records.capacity) {
        const end = Math.min(scene.count, begin + scene.records.capacity);
        const rows = Math.ceil((end - begin) / RECORD_COLUMNS);
        programs.useProject(begin, end);
        scene.records.target(rows);
        gl.drawArrays(gl.TRIANGLES, 0, 3);
        programs.useSplat();
        picture.target();
        this.quads.draw(rows);
      }
    }
    programs.useResolve(background);
    return true;
  }

  finished() {
    const { gl } = this;
    const sync = gl.fenceSync(gl.SYNC_GPU_COMMANDS_COMPLETE, 0);
    gl.flush();
    return new Promise((/** @type {(value: void) => void} */ resolve) => {
      const poll = () => {
        const isDone = sync === null || gl.isContextLost() || gl.getSyncParameter(sync, gl.SYNC_STATUS) === gl.SIGNALED;
        if (!isDone) return void setTimeout(poll, 0);
        gl.deleteSync(sync);
        resolve();
      };
      poll();
    });
  }

  wait() {
    const { gl } = this;
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, new Uint8Array(4)); // in browsers, gl.finish does not wait
  }

  dispose() {
    this.scene?.dispose();
    this.scene = null;
    this.picture.dispose();
    this.quads.dispose();
    this.programs.dispose();
  }
}

/** @param {WebGL2RenderingContext} gl */
function deviceName(gl) {
  const extension = gl.getExtension('WEBGL_debug_renderer_info');
  return String(gl.getParameter(extension ? extension.UNMASKED_RENDERER_WEBGL : gl.RENDERER));
}
