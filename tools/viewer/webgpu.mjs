// SPDX-License-Identifier: Apache-2.0
// The WebGPU back end: culling, projection, sort and blending on the GPU, with the shaders of csplat_render/gpu. Pictures are
// blended by screen tiles or as quads, as options say or a short measurement decides. renderer.mjs documents its methods.

import { E_CONTEXT, E_LIMIT } from './engine_error.mjs';
import { isSound } from './trial_scene.mjs';
import { Device } from './webgpu_device.mjs';
import { Projection } from './webgpu_projection.mjs';
import { Quads } from './webgpu_quads.mjs';
import { BLOCK_SPLATS } from './texels.mjs';
import { GpuScene } from './webgpu_scene.mjs';
import { ScreenTiles } from './webgpu_tiles.mjs';
import * as WGSL from './wgsl.mjs';

/**
 * @typedef {import('./renderer.mjs').Capabilities} Capabilities
 * @typedef {import('./renderer.mjs').Losses} Losses
 * @typedef {import('./renderer.mjs').Renderer} Renderer
 * @typedef {import('./renderer.mjs').SceneLayout} SceneLayout
 * @typedef {import('./types.d.ts').Backend} Backend
 * @typedef {import('./types.d.ts').View} View
 * @typedef {ScreenTiles | Quads} Method
 * @typedef {import('./renderer.mjs').Look} Look
 * @typedef {{view: View, look: Look}} Picture
 */

const COUNTER_BYTES = 16;
const MOST_PARTS = 4096; // bands times slices of a picture
const BLOCK_BYTES = 36; // of the largest buffer with something per block of splats
const TRIES = 3;

/** @implements {Renderer} */
export class WebGpuRenderer {
  /**
   * @param {HTMLCanvasElement} canvas
   * @param {Backend} backend `auto` requires hardware that draws a small scene as it should
   * @param {boolean} alpha whether the canvas may be transparent
   * @param {Losses} losses
   * @returns {Promise<WebGpuRenderer | null>} null if the browser has no WebGPU
   */
  static async create(canvas, backend, alpha, { lost, failed }) {
    const device = await Device.open(backend === 'auto').catch(() => null);
    if (!device) return null;
    const renderer = new WebGpuRenderer(device, backend);
    if ((backend === 'auto' && !(await isSound(renderer))) || !renderer.show(canvas, alpha)) {
      renderer.dispose();
      return null;
    }
    device.device.lost.then(() => {
      const isNews = !device.isLost; // it was not disposed of
      device.isLost = true;
      if (isNews) lost(renderer.hasDrawn);
    });
    device.device.onuncapturederror = ({ error }) =>
      failed(error instanceof GPUOutOfMemoryError ? E_LIMIT : E_CONTEXT, error.message);
    return renderer;
  }

  /**
   * @param {Device} device
   * @param {Backend} backend
   */
  constructor(device, backend) {
    this.device = device;
    this.projection = new Projection(device);
    this.tiles = new ScreenTiles(this.projection);
    this.quads = new Quads(this.projection);
    /** @type {Method} */
    this.method = backend === 'webgpu-quads' ? this.quads : this.tiles;
    /** Whether the method is settled. */
    this.isChosen = backend === 'webgpu-quads' || backend === 'webgpu-tiles';
    this.backdrop = device.buffer(32, GPUBufferUsage.UNIFORM);
    /** Counters of each part of the last picture. */
    this.counts = device.buffer(COUNTER_BYTES * MOST_PARTS);
    this.partCount = 0;
    this.present = presentPipelines(device, 'rgba8unorm');
    this.presentOnCanvas = this.present;
    /** @type {GPUCanvasContext | null} */
    this.context = null;
    /** @type {Capabilities} */
    this.capabilities = {
      name: '',
      pictureFormat: 'RGBA32F',
      splatsMax: Math.floor(device.bindingMax / BLOCK_BYTES) * BLOCK_SPLATS,
      sideMax: device.device.limits.maxTextureDimension2D,
      sorts: true,
    };
    this.use(this.method);
    /** @type {GpuScene | null} */
    this.scene = null;
    this.isWhole = false;
    this.hasDrawn = false;
    /** The last picture. @type {Picture | null} */
    this.last = null;
  }

  /**
   * Draw on a canvas from now on.
   *
   * @param {HTMLCanvasElement} canvas
   * @param {boolean} alpha whether it may be transparent
   * @returns {boolean} whether it can
   */
  show(canvas, alpha) {
    const { device } = this;
    this.context = canvas.getContext('webgpu');
    const format = navigator.gpu.getPreferredCanvasFormat();
    this.context?.configure({ device: device.device, format, alphaMode: alpha ? 'premultiplied' : 'opaque' });
    this.presentOnCanvas = presentPipelines(device, format);
    return this.context !== null;
  }

  /** @param {Method} method of blending, from now on */
  use(method) {
    this.method = method;
    this.capabilities.name = `${this.device.name} (WebGPU, ${method.name})`;
    this.capabilities.pictureFormat = method === this.quads ? 'RGBA16F' : 'RGBA32F';
  }

  get bytes() {
    const attributes = this.scene?.bytes ?? 0;
    return { attributes, order: 0, work: this.device.bytes - attributes };
  }

  /** @param {SceneLayout | null} layout null for no scene */
  allocate(layout) {
    const { device, projection } = this;
    this.tiles.forget();
    this.quads.forget();
    projection.setScene(null);
    this.scene?.dispose();
    this.scene = null;
    this.isWhole = false;
    if (!layout) return;
    const scene = new GpuScene(device, layout, () => (projection.passes = null));
    if (scene.blockCount * BLOCK_SPLATS > this.capabilities.splatsMax) {
      scene.dispose();
      throw new RangeError(
        `${scene.blockCount * BLOCK_SPLATS} splats, this GPU can hold ${this.capabilities.splatsMax}`,
      );
    }
    this.scene = scene;
    projection.setScene(scene);
  }

  complete() {
    this.scene?.trim();
    this.isWhole = true;
  }

  /**
   * @param {View} view
   * @param {Look} look
   */
  draw(view, look) {
    if (this.device.isLost || !this.context || !(view.width > 0 && view.height > 0)) return;
    this.last = { view, look };
    this.#drawTo(this.context.getCurrentTexture(), this.presentOnCanvas, this.method, this.last);
  }

  /**
   * @param {GPUTexture} texture
   * @param {ReturnType<typeof presentPipelines>} present
   * @param {Method} method
   * @param {Picture} picture
   */
  #drawTo(texture, present, method, { view, look }) {
    const { projection, scene, device } = this;
    const { queue } = device.device;
    scene?.place(view);
    const bands = method.prepare(view);
    const slices = method.isFarthestFirst ? [...projection.slices].reverse() : projection.slices;
    this.partCount = bands.length * slices.length;
    bands.forEach((band, b) => {
      queue.writeBuffer(this.backdrop, 0, backdropOf(look.background, view.width, band[0]));
      slices.forEach((slice, s) => {
        projection.setView({ view, band, slice, shDegree: look.shDegree, pairs: method.pairs });
        const encoder = device.device.createCommandEncoder();
        device.encode(encoder, projection.calls);
        method.encode(encoder, s === 0);
        const part = b * slices.length + s;
        if (part < MOST_PARTS) {
          encoder.copyBufferToBuffer(projection.counters, 0, this.counts, COUNTER_BYTES * part, COUNTER_BYTES);
        }
        if (s === slices.length - 1) this.#presentBand(encoder, texture, present[method.presents], method, band);
        queue.submit([encoder.finish()]);
      });
    });
  }

  /**
   * @param {GPUCommandEncoder} encoder
   * @param {GPUTexture} texture
   * @param {GPURenderPipeline} pipeline
   * @param {Method} method
   * @param {[number, number]} band
   */
  #presentBand(encoder, texture, pipeline, method, [first, rows]) {
    const group = this.device.device.createBindGroup({
      layout: pipeline.getBindGroupLayout(0),
      entries: [{ binding: 0, resource: { buffer: this.backdrop } }, ...method.entries],
    });
    const pass = encoder.beginRenderPass({
      colorAttachments: [{ view: texture.createView(), loadOp: first === 0 ? 'clear' : 'load', storeOp: 'store' }],
    });
    pass.setPipeline(pipeline);
    pass.setBindGroup(0, group);
    pass.setScissorRect(0, first, texture.width, rows);
    pass.draw(3);
    pass.end();
  }

  /**
   * @param {View} view
   * @param {Look} look
   * @param {number} [tries] how often it is drawn until it fits the buffers, which a GPU that does not work may never report
   */
  async pixelsOf(view, look, tries = Infinity) {
    const { device } = this;
    const { width, height } = view;
    if (device.isLost || !(width > 0 && height > 0)) return new Uint8Array(0);
    const texture = device.picture(width, height, 'rgba8unorm');
    const bytesPerRow = Math.ceil((4 * width) / 256) * 256;
    const buffer = device.buffer(bytesPerRow * height);
    try {
      do this.#drawTo(texture, this.present, this.method, { view, look });
      while (--tries > 0 && !(await this.#isComplete(view)));
      const encoder = device.device.createCommandEncoder();
      encoder.copyTextureToBuffer({ texture }, { buffer, bytesPerRow }, [width, height]);
      device.device.queue.submit([encoder.finish()]);
      const words = await device.read(buffer, bytesPerRow * height);
      if (!words) return new Uint8Array(0);
      const pixels = new Uint8Array(4 * width * height);
      const rows = new Uint8Array(words.buffer);
      for (let y = 0; y < height; y++)
        pixels.set(rows.subarray(y * bytesPerRow, y * bytesPerRow + 4 * width), 4 * width * y);
      return pixels;
    } finally {
      device.free(buffer);
      device.free(texture);
    }
  }

  /**
   * Resolves when the picture is complete; one that exceeded the buffers is drawn again, in larger ones or in parts. Rejects
   * with a RangeError if that is impossible.
   */
  async finished() {
    while (this.last && !this.device.isLost) {
      const isComplete = await this.#isComplete(this.last.view);
      this.hasDrawn ||= !this.device.isLost;
      if (isComplete) break;
      this.draw(this.last.view, this.last.look);
    }
    if (this.isWhole && !this.isChosen) await this.#choose();
  }

  async wait() {
    await this.finished();
  }

  /**
   * Return whether the last picture fitted the buffers, after making room for the next; true if the GPU is lost.
   *
   * @param {View} view of the picture
   */
  async #isComplete(view) {
    const { projection, partCount, method } = this;
    const counters = await this.device.read(this.counts, COUNTER_BYTES * Math.min(partCount, MOST_PARTS));
    if (!counters) return true;
    const { count } = projection.records;
    let isComplete = true;
    for (let at = 0; at < counters.length; at += COUNTER_BYTES / 4) {
      const [visible, , firstBlock] = counters.subarray(at);
      if (visible > count) {
        await projection.divide(view);
        return false;
      }
      if (method === this.tiles && firstBlock * BLOCK_SPLATS < visible) isComplete = false;
    }
    if (!isComplete) this.tiles.enlarge();
    return isComplete;
  }

  /** Draw the last view by both methods, and use the faster from now on. */
  async #choose() {
    const { device, last } = this;
    if (!last || device.isLost) return;
    this.isChosen = true;
    const texture = device.picture(last.view.width, last.view.height, 'rgba8unorm');
    const times = [];
    for (const method of [this.tiles, this.quads]) {
      let least = Infinity; // the first try compiles
      for (let n = 0; n < TRIES && !device.isLost; n++) {
        const start = performance.now();
        this.#drawTo(texture, this.present, method, last);
        await device.device.queue.onSubmittedWorkDone();
        least = Math.min(least, performance.now() - start);
      }
      times.push(least);
    }
    device.free(texture);
    const [chosen, other] = times[1] < times[0] ? [this.quads, this.tiles] : [this.tiles, this.quads];
    this.use(chosen);
    other.forget();
  }

  dispose() {
    this.context?.unconfigure();
    this.device.dispose();
  }
}

/**
 * @param {Device} device
 * @param {GPUTextureFormat} format
 */
function presentPipelines({ device }, format) {
  const module = device.createShaderModule({ label: 'present', code: WGSL.PRESENT });
  const pipeline = (/** @type {string} */ entryPoint) =>
    device.createRenderPipeline({
      layout: 'auto',
      vertex: { module, entryPoint: 'cover' },
      fragment: { module, entryPoint, targets: [{ format }] },
    });
  return { present: pipeline('present'), present_quads: pipeline('present_quads') };
}

/**
 * Return the content of `Backdrop` in present.wgsl.
 *
 * @param {number[]} background red, green, blue, alpha
 * @param {number} width
 * @param {number} first
 */
function backdropOf(background, width, first) {
  const words = new Uint32Array(8);
  new Float32Array(words.buffer).set(background);
  words.set([width, first], 4);
  return words;
}
