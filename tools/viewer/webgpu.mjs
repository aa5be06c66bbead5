// The WebGPU back end: culling, projection, sort and blending by screen tiles on the GPU, as csplat_render/gpu/renderer.py
// does, with the same shaders. renderer.mjs documents its methods.

import { slopeLimits } from './camera_maths.mjs';
import { Device } from './webgpu_device.mjs';
import { BLOCK, GpuScene } from './webgpu_scene.mjs';
import * as WGSL from './wgsl.mjs';

/**
 * @typedef {import('./texels.mjs').BandTexels} BandTexels
 * @typedef {import('./texels.mjs').GeometryTexels} GeometryTexels
 * @typedef {import('./texels.mjs').Rows} Rows
 * @typedef {import('./renderer.mjs').Capabilities} Capabilities
 * @typedef {import('./renderer.mjs').Renderer} Renderer
 * @typedef {import('./renderer.mjs').SceneLayout} SceneLayout
 * @typedef {import('./types.d.ts').View} View
 * @typedef {import('./webgpu_device.mjs').Call} Call
 *
 * Buffers that depend on the size of the picture, and the passes that use them.
 * @typedef {{width: number, height: number, pairs: number, pixels: GPUBuffer, ranges: GPUBuffer, owned: GPUBuffer[],
 *   clear: Call[], step: Call[], group: GPUBindGroup}} Target
 *
 * Buffers that depend on the number of splats, and the passes of the sort.
 * @typedef {{records: number, blocks: GPUBuffer, ellipses: GPUBuffer, looks: GPUBuffer, keys: GPUBuffer, order: GPUBuffer,
 *   sums: GPUBuffer, owned: GPUBuffer[], sort: Call[]}} Records
 */

const SCREEN_TILE = 16; // pixels
const RECORD_BYTES = 16; // in each of the two buffers of records
const LEAST_PAIRS = 1 << 20;
const MOST_PAIRS = 1 << 26;
const RUN = 4096; // elements per workgroup of a sort
const VIEW_BYTES = 144;
const LAST_KEY = 0x7f7fffff;
const MOST_BANDS = 256;
const [SORT_RECORDS, BLOCKS_OF_RANKS, SORT_PAIRS] = [0, 12, 24]; // offsets in the table of workgroups

/** @implements {Renderer} */
export class WebGpuRenderer {
  /**
   * @param {HTMLCanvasElement} canvas
   * @param {(hasDrawn: boolean) => void} lost called when the GPU is lost
   * @returns {Promise<WebGpuRenderer | null>} null if the browser has no WebGPU
   */
  static async create(canvas, lost) {
    const device = await Device.open().catch(() => null);
    const context = device && canvas.getContext('webgpu');
    if (!device || !context) return null;
    const renderer = new WebGpuRenderer(device, context);
    device.device.lost.then(() => {
      const isNews = !device.isLost; // it was not disposed of
      device.isLost = true;
      if (isNews) lost(renderer.hasDrawn);
    });
    return renderer;
  }

  /**
   * @param {Device} device
   * @param {GPUCanvasContext} context
   */
  constructor(device, context) {
    this.device = device;
    this.context = context;
    const format = navigator.gpu.getPreferredCanvasFormat();
    context.configure({ device: device.device, format, alphaMode: 'opaque' });
    this.pipelines = { canvas: presentPipeline(device, format), bytes: presentPipeline(device, 'rgba8unorm') };
    this.view = device.buffer(VIEW_BYTES, GPUBufferUsage.UNIFORM);
    this.backdrop = device.buffer(32, GPUBufferUsage.UNIFORM);
    this.counters = device.buffer(16);
    this.groups = device.buffer(48, GPUBufferUsage.STORAGE | GPUBufferUsage.INDIRECT);
    /** @type {Capabilities} */
    this.capabilities = {
      name: `${device.name} (WebGPU)`,
      pictureFormat: 'RGBA32F',
      splatsMax: Math.floor(device.bindingMax / RECORD_BYTES),
      sorts: true,
    };
    /** @type {GpuScene | null} */
    this.scene = null;
    /** @type {Records | null} */
    this.records = null;
    /** Passes that use buffers of the scene; null if one was replaced. @type {Call[] | null} */
    this.project = null;
    /** @type {Target | null} */
    this.target = null;
    this.hasDrawn = false;
    /** Pairs of splat and screen tile that the buffers may hold. */
    this.pairsMax = Math.min(device.bindingMax / 4, MOST_PAIRS);
    this.pairsWanted = LEAST_PAIRS;
    this.steps = 1;
    /** @type {{view: View, look: {background: number[], shDegree: number}} | null} */
    this.last = null;
    /** Counters of each band of the last picture. */
    this.counts = device.buffer(16 * MOST_BANDS);
    this.bandCount = 0;
  }

  get bytes() {
    const attributes = this.scene?.bytes ?? 0;
    return { attributes, order: 0, work: this.device.bytes - attributes };
  }

  /** @param {SceneLayout} layout */
  allocate(layout) {
    this.#forget();
    this.scene?.dispose();
    this.scene = null;
    const scene = new GpuScene(this.device, layout, () => (this.project = null));
    if (scene.blockCount * BLOCK > this.capabilities.splatsMax) {
      scene.dispose();
      throw new RangeError(`${scene.blockCount * BLOCK} splats, this GPU can hold ${this.capabilities.splatsMax}`);
    }
    this.scene = scene;
  }

  /**
   * @param {number} tile
   * @param {GeometryTexels} texels
   */
  uploadGeometry(tile, texels) {
    this.scene?.putGeometry(tile, texels);
  }

  /**
   * @param {number} codebook
   * @param {number} layer
   * @param {Rows} rows
   */
  uploadTable(codebook, layer, rows) {
    this.scene?.putTable(codebook, layer, rows);
  }

  /**
   * @param {number} tile
   * @param {number} layer
   * @param {BandTexels} band
   */
  uploadBand(tile, layer, band) {
    this.scene?.putBand(tile, layer, band);
  }

  complete() {
    this.scene?.trim();
  }

  setOrder() {}

  /**
   * @param {View} view
   * @param {{background: number[], shDegree: number}} look
   */
  draw(view, look) {
    if (this.device.isLost || !(view.width > 0 && view.height > 0)) return;
    this.last = { view, look };
    this.#drawTo(this.pipelines.canvas, this.context.getCurrentTexture());
  }

  /**
   * Draw the last view again into a texture.
   *
   * @param {GPURenderPipeline} pipeline
   * @param {GPUTexture} texture
   */
  #drawTo(pipeline, texture) {
    if (!this.last) return;
    const { device, scene } = this;
    const { view, look } = this.last;
    const { queue } = device.device;
    scene?.place(view);
    const bands = this.#bands(view);
    this.bandCount = bands.length;
    bands.forEach(([first, rows], band) => {
      const target = this.#targetOf(view.width, bands[0][1]);
      const { records } = this.#recordsOf();
      queue.writeBuffer(this.view, 0, viewOf(view, first, rows, scene, records, target.pairs, look.shDegree));
      queue.writeBuffer(this.backdrop, 0, backdropOf(look.background, view.width, first));
      const encoder = device.device.createCommandEncoder();
      device.encode(encoder, [...target.clear, ...this.#projectPasses()]);
      for (let step = 0; step < this.steps; step++) {
        encoder.clearBuffer(target.ranges);
        device.encode(encoder, target.step);
      }
      encoder.copyBufferToBuffer(this.counters, 0, this.counts, 16 * band, 16);
      const pass = encoder.beginRenderPass({
        colorAttachments: [{ view: texture.createView(), loadOp: band === 0 ? 'clear' : 'load', storeOp: 'store' }],
      });
      pass.setPipeline(pipeline);
      pass.setBindGroup(0, this.#presentGroup(pipeline, target));
      pass.setScissorRect(0, first, view.width, rows);
      pass.draw(3);
      pass.end();
      queue.submit([encoder.finish()]);
    });
  }

  async readPixels() {
    if (!this.last || this.device.isLost) return new Uint8Array(0);
    await this.finished();
    const { device } = this.device;
    const { width, height } = this.last.view;
    const bytesPerRow = Math.ceil((4 * width) / 256) * 256;
    const usage = GPUTextureUsage.RENDER_ATTACHMENT | GPUTextureUsage.COPY_SRC;
    const texture = device.createTexture({ size: [width, height], format: 'rgba8unorm', usage });
    this.#drawTo(this.pipelines.bytes, texture);
    const buffer = device.createBuffer({
      size: bytesPerRow * height,
      usage: GPUBufferUsage.MAP_READ | GPUBufferUsage.COPY_DST,
    });
    const encoder = device.createCommandEncoder();
    encoder.copyTextureToBuffer({ texture }, { buffer, bytesPerRow }, [width, height]);
    device.queue.submit([encoder.finish()]);
    await buffer.mapAsync(GPUMapMode.READ);
    const rows = new Uint8Array(buffer.getMappedRange());
    const pixels = new Uint8Array(4 * width * height);
    for (let y = 0; y < height; y++)
      pixels.set(rows.subarray(y * bytesPerRow, y * bytesPerRow + 4 * width), 4 * width * y);
    buffer.destroy();
    texture.destroy();
    return pixels;
  }

  /** Resolves when the picture is complete; one that exceeded the buffers is drawn again, in larger ones or more steps. */
  async finished() {
    while (this.last && !this.device.isLost) {
      const isComplete = await this.#isComplete();
      this.hasDrawn ||= !this.device.isLost;
      if (isComplete) return;
      if (this.pairsWanted < this.pairsMax) this.pairsWanted *= 2;
      else this.steps++;
      this.draw(this.last.view, this.last.look);
    }
  }

  async wait() {
    await this.finished();
  }

  /** Return whether the last picture fitted the buffers; true if the GPU is lost. */
  async #isComplete() {
    const { device } = this.device;
    const size = 16 * this.bandCount;
    const buffer = device.createBuffer({ size, usage: GPUBufferUsage.MAP_READ | GPUBufferUsage.COPY_DST });
    const encoder = device.createCommandEncoder();
    encoder.copyBufferToBuffer(this.counts, 0, buffer, 0, size);
    device.queue.submit([encoder.finish()]);
    try {
      await buffer.mapAsync(GPUMapMode.READ);
    } catch {
      return true;
    }
    const counters = new Uint32Array(buffer.getMappedRange().slice(0));
    buffer.destroy();
    for (let band = 0; band < this.bandCount; band++) {
      const [visible, , firstBlock] = counters.subarray(4 * band);
      if (firstBlock * BLOCK < visible) return false;
    }
    return true;
  }

  /**
   * Divide a picture into bands of rows that fit the buffers.
   *
   * @param {View} view
   * @returns {[number, number][]} first row and number of rows
   */
  #bands({ width, height }) {
    const columns = Math.ceil(width / SCREEN_TILE);
    const { bindingMax } = this.device;
    const rows = Math.floor(Math.min(bindingMax / (16 * width * SCREEN_TILE), this.pairsMax / (BLOCK * columns)));
    const band = Math.min(height, Math.max(1, rows) * SCREEN_TILE);
    /** @type {[number, number][]} */
    const bands = [];
    for (let first = 0; first < height; first += band) bands.push([first, Math.min(band, height - first)]);
    return bands;
  }

  /**
   * @param {number} width
   * @param {number} height
   * @returns {Target}
   */
  #targetOf(width, height) {
    const [columns, rows] = [Math.ceil(width / SCREEN_TILE), Math.ceil(height / SCREEN_TILE)];
    const pairs = Math.max(Math.min(this.pairsWanted, this.pairsMax), BLOCK * columns * rows);
    const { ellipses, looks, order, sums } = this.#recordsOf();
    const known = this.target;
    if (known && known.width === width && known.height === height && known.pairs === pairs) return known;
    this.#freeTarget();
    const { device } = this;
    const [pixels, ranges] = [device.buffer(16 * width * height), device.buffer(8 * columns * rows)];
    const keys = [device.buffer(4 * pairs), device.buffer(4 * pairs)];
    const values = [device.buffer(4 * pairs), device.buffer(4 * pairs)];
    const bits = Math.max(1, 32 - Math.clz32(columns * rows - 1));
    const done = Math.ceil(bits / 8) % 2;
    const blocks = { buffer: this.groups, offset: BLOCKS_OF_RANKS };
    const sort = this.#sortPasses(keys, values, bits, SORT_PAIRS, pairs);
    const { view, counters, groups } = this;
    const bind = device.bind.bind(device);
    const group = device.device.createBindGroup({
      layout: this.pipelines.canvas.getBindGroupLayout(0),
      entries: [this.backdrop, pixels].map((buffer, binding) => ({ binding, resource: { buffer } })),
    });
    this.target = {
      width,
      height,
      pairs,
      pixels,
      ranges,
      owned: [pixels, ranges, ...keys, ...values, ...sort.owned],
      clear: [
        bind('dispatch', 'clear_pixels', [Math.ceil((width * height) / (64 * BLOCK)), 64], view, null, null, pixels),
      ],
      step: [
        bind('bin', 'count', blocks, view, counters, order, ellipses, looks, sums),
        bind('bin', 'scan', 1, view, counters, null, null, null, sums),
        bind('dispatch', 'after_scan', 1, null, counters, groups),
        bind('bin', 'emit', blocks, view, counters, order, ellipses, looks, sums, keys[0], values[0]),
        ...sort.calls,
        bind('ranges', 'find', { buffer: groups, offset: SORT_PAIRS }, counters, keys[done], ranges),
        bind('blend', 'blend', [columns, rows], view, ellipses, looks, values[done], ranges, pixels),
        bind('dispatch', 'next_step', 1, null, counters),
      ],
      group,
    };
    return this.target;
  }

  /**
   * @param {GPURenderPipeline} pipeline
   * @param {Target} target
   */
  #presentGroup(pipeline, target) {
    if (pipeline === this.pipelines.canvas) return target.group;
    return this.device.device.createBindGroup({
      layout: pipeline.getBindGroupLayout(0),
      entries: [this.backdrop, target.pixels].map((buffer, binding) => ({ binding, resource: { buffer } })),
    });
  }

  /** @returns {Records} */
  #recordsOf() {
    if (this.records) return this.records;
    const { device } = this;
    const blockCount = this.scene?.blockCount ?? 0;
    const count = Math.max(1, blockCount * BLOCK);
    const pair = (/** @type {number} */ bytes) => [device.buffer(bytes * count), device.buffer(bytes * count)];
    const [[ellipses, looks], keys, values] = [pair(RECORD_BYTES), pair(4), pair(4)];
    const [blocks, sums] = [device.buffer(36 * blockCount), device.buffer(4 * Math.ceil(count / BLOCK))];
    const { calls, owned } = this.#sortPasses(keys, values, 32, SORT_RECORDS, count);
    this.records = {
      records: count,
      blocks,
      ellipses,
      looks,
      keys: keys[0],
      order: values[0],
      sums,
      owned: [blocks, sums, ellipses, looks, ...keys, ...values, ...owned],
      sort: calls,
    };
    return this.records;
  }

  /** Return the passes that find the splats in view, project them and sort them by depth. */
  #projectPasses() {
    if (this.project) return this.project;
    const { device, scene, view, counters, groups } = this;
    const { blocks, ellipses, looks, keys, sort } = this.#recordsOf();
    const bind = device.bind.bind(device);
    const pages = (scene?.pages ?? []).filter((page) => page.blocks > 0);
    const table = scene?.table ?? null;
    const tables = scene?.tables.buffer ?? null;
    this.project = [
      ...pages.map((page) => bind('cull', 'cull', page.blocks, view, page.info, table, page.geometry.buffer, blocks)),
      bind('compact', 'compact', 1, view, counters, blocks),
      bind('dispatch', 'after_compact', 1, view, counters, groups),
      ...pages.map(({ blocks: count, info, geometry, rows }) => {
        const source = [view, info, table, geometry.buffer, rows.buffer, tables];
        return bind('project', 'project', count, ...source, blocks, ellipses, looks, keys);
      }),
      ...sort,
    ];
    return this.project;
  }

  /**
   * Return the passes of a sort by some bits, and the buffers that they own.
   *
   * @param {GPUBuffer[]} keys two
   * @param {GPUBuffer[]} values two
   * @param {number} bits
   * @param {number} offset of the number of workgroups
   * @param {number} count elements at most
   */
  #sortPasses(keys, values, bits, offset, count) {
    const { device, counters } = this;
    const ofPairs = offset === SORT_PAIRS;
    const table = device.buffer(4 * 256 * (1 + Math.ceil(count / RUN)));
    const owned = [table];
    const here = { buffer: this.groups, offset };
    /** @type {Call[]} */
    const calls = [];
    for (let digit = 0; digit < Math.ceil(bits / 8); digit++) {
      const radix = device.uniform(new Uint32Array([8 * digit, ofPairs ? 1 : 0, digit === 0 && !ofPairs ? 1 : 0, 0]));
      owned.push(radix);
      const [a, b] = [digit % 2, 1 - (digit % 2)];
      calls.push(
        device.bind('sort', 'count', here, radix, counters, keys[a], null, null, null, table),
        device.bind('sort', 'scan', 256, radix, counters, keys[a], null, null, null, table),
        device.bind('sort', 'scatter', here, radix, counters, keys[a], values[a], keys[b], values[b], table),
      );
    }
    return { calls, owned };
  }

  #freeTarget() {
    for (const buffer of this.target?.owned ?? []) this.device.free(buffer);
    this.target = null;
  }

  /** Free what depends on the number of splats. */
  #forget() {
    this.#freeTarget();
    for (const buffer of this.records?.owned ?? []) this.device.free(buffer);
    this.records = this.project = null;
  }

  dispose() {
    this.context.unconfigure();
    this.device.dispose();
  }
}

/**
 * @param {Device} device
 * @param {GPUTextureFormat} format
 */
function presentPipeline({ device }, format) {
  const module = device.createShaderModule({ label: 'present', code: WGSL.PRESENT });
  return device.createRenderPipeline({
    layout: 'auto',
    vertex: { module, entryPoint: 'cover' },
    fragment: { module, entryPoint: 'present', targets: [{ format }] },
  });
}

/**
 * Return the content of `View` in common.wgsl.
 *
 * @param {View} view
 * @param {number} first first row of the band
 * @param {number} rows
 * @param {GpuScene | null} scene
 * @param {number} records
 * @param {number} pairs
 * @param {number} shDegree
 */
function viewOf(view, first, rows, scene, records, pairs, shDegree) {
  const { viewmat: m, fx, fy, cx, cy, width, near } = view;
  const words = new Uint32Array(VIEW_BYTES / 4);
  const floats = new Float32Array(words.buffer);
  floats.set([m[0], m[1], m[2], 0, m[4], m[5], m[6], 0, m[8], m[9], m[10], 0]);
  floats.set([fx, fy, cx, cy - first], 12);
  floats.set(slopeLimits(view), 16);
  floats.set([width, rows, near], 20);
  const columns = Math.ceil(width / SCREEN_TILE);
  const { blockCount = 0, blockTable = 0, tileTable = 0 } = scene ?? {};
  const degree = Math.min(shDegree, 4);
  words.set([0, LAST_KEY, columns, columns * Math.ceil(rows / SCREEN_TILE), records, pairs], 23);
  words.set([blockCount, blockTable, tileTable, 0, degree], 29);
  return words;
}

/**
 * Return the content of `Backdrop` in present.wgsl.
 *
 * @param {number[]} background
 * @param {number} width
 * @param {number} first
 */
function backdropOf(background, width, first) {
  const words = new Uint32Array(8);
  new Float32Array(words.buffer).set(background.slice(0, 3));
  words.set([width, first], 4);
  return words;
}
