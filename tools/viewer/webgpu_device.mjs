// SPDX-License-Identifier: Apache-2.0
// A WebGPU device with its compiled passes and growing buffers. The shaders are those of csplat_render/gpu.

import { Ranges } from '../../codec/js/levels/ranges.mjs';
import * as WGSL from './wgsl.mjs';

/**
 * Number of workgroups: of one or two dimensions, or three numbers at an offset of a buffer.
 *
 * @typedef {number | [number, number] | {buffer: GPUBuffer, offset: number}} Count
 *
 * A pass with its buffers.
 * @typedef {{pipeline: GPUComputePipeline, group: GPUBindGroup, count: Count}} Call
 */

/** Source files of each pass; common.wgsl precedes them all. */
const PASSES = {
  cull: [WGSL.LAYOUT, WGSL.CULL],
  compact: [WGSL.SCAN, WGSL.COMPACT],
  project: [WGSL.LAYOUT, WGSL.PROJECT],
  sort: [WGSL.SCAN, WGSL.SORT],
  bin: [WGSL.SCAN, WGSL.BIN],
  ranges: [WGSL.RANGES],
  blend: [WGSL.BLEND],
  dispatch: [WGSL.DISPATCH],
};

/** Bytes of the largest buffers that csplat uses. */
const MOST_BYTES = 1 << 30;

/** Names of software that acts as a GPU. */
export const SOFTWARE = /swiftshader|llvmpipe|lavapipe|softpipe|software|basic render/i;

/** What WebGPU guarantees, bytes. */
const DEFAULT_BINDING = 1 << 27;

export class Device {
  /**
   * Open the GPU that the browser prefers.
   *
   * @param {boolean} hardware whether it must not be software
   * @returns {Promise<Device | null>} null if there is none
   */
  static async open(hardware) {
    const adapter = await navigator.gpu?.requestAdapter({ powerPreference: 'high-performance' });
    if (!adapter || (hardware && isSoftware(adapter))) return null;
    const { maxStorageBufferBindingSize, maxBufferSize } = adapter.limits;
    const most = Math.min(maxStorageBufferBindingSize, maxBufferSize, MOST_BYTES);
    const requiredLimits =
      most > DEFAULT_BINDING ? { maxStorageBufferBindingSize: most, maxBufferSize: Math.max(most, 1 << 28) } : {};
    const device = await adapter.requestDevice({ requiredLimits });
    return new Device(device, adapter.info, most);
  }

  /**
   * @param {GPUDevice} device
   * @param {GPUAdapterInfo} info
   * @param {number} bindingMax bytes of the largest buffer that a shader can read
   */
  constructor(device, info, bindingMax) {
    this.device = device;
    this.bindingMax = bindingMax;
    this.name = info.description || [info.vendor, info.architecture].filter(Boolean).join(' ') || 'unnamed GPU';
    this.bytes = 0;
    this.isLost = false;
    /** @type {Map<string, GPUComputePipeline>} */
    this.pipelines = new Map();
  }

  /**
   * @param {number} bytes
   * @param {GPUBufferUsageFlags} [usage] in addition to that of buffers of shaders
   */
  buffer(bytes, usage = GPUBufferUsage.STORAGE) {
    const size = Math.max(16, Math.ceil(bytes / 16) * 16);
    this.bytes += size;
    return this.device.createBuffer({ size, usage: usage | GPUBufferUsage.COPY_DST | GPUBufferUsage.COPY_SRC });
  }

  /** @param {Uint32Array<ArrayBuffer>} content */
  uniform(content) {
    const buffer = this.buffer(content.byteLength, GPUBufferUsage.UNIFORM);
    this.device.queue.writeBuffer(buffer, 0, content);
    return buffer;
  }

  /**
   * Return a texture to draw on.
   *
   * @param {number} width
   * @param {number} height
   * @param {'rgba8unorm' | 'rgba16float'} format
   */
  picture(width, height, format) {
    const usage = GPUTextureUsage.RENDER_ATTACHMENT | GPUTextureUsage.COPY_SRC | GPUTextureUsage.TEXTURE_BINDING;
    const texture = this.device.createTexture({ size: [width, height], format, usage });
    this.bytes += textureBytes(texture);
    return texture;
  }

  /** @param {GPUBuffer | GPUTexture | null} owned */
  free(owned) {
    if (owned === null) return;
    this.bytes -= 'size' in owned ? owned.size : textureBytes(owned);
    owned.destroy();
  }

  /**
   * Read the beginning of a buffer after all work so far.
   *
   * @param {GPUBuffer} buffer
   * @param {number} bytes
   * @returns {Promise<Uint32Array<ArrayBuffer> | null>} null if the GPU is lost
   */
  async read(buffer, bytes) {
    const copy = this.device.createBuffer({ size: bytes, usage: GPUBufferUsage.MAP_READ | GPUBufferUsage.COPY_DST });
    const encoder = this.device.createCommandEncoder();
    encoder.copyBufferToBuffer(buffer, 0, copy, 0, bytes);
    this.device.queue.submit([encoder.finish()]);
    try {
      await copy.mapAsync(GPUMapMode.READ);
    } catch {
      return null;
    }
    const words = new Uint32Array(copy.getMappedRange().slice(0));
    copy.destroy();
    return words;
  }

  /**
   * @param {keyof typeof PASSES} name
   * @param {string} entry
   * @param {Count} count
   * @param {(GPUBuffer | null)[]} buffers of the bindings from 0 on; null for those that the entry point does not use
   * @returns {Call}
   */
  bind(name, entry, count, ...buffers) {
    const key = `${name}.${entry}`;
    let pipeline = this.pipelines.get(key);
    if (!pipeline) {
      const module = this.device.createShaderModule({ label: name, code: [WGSL.COMMON, ...PASSES[name]].join('\n') });
      pipeline = this.device.createComputePipeline({ layout: 'auto', compute: { module, entryPoint: entry } });
      this.pipelines.set(key, pipeline);
    }
    const entries = buffers.flatMap((buffer, binding) => (buffer ? [{ binding, resource: { buffer } }] : []));
    const group = this.device.createBindGroup({ layout: pipeline.getBindGroupLayout(0), entries });
    return { pipeline, group, count };
  }

  /**
   * Encode passes one after the other.
   *
   * @param {GPUCommandEncoder} encoder
   * @param {Call[]} calls
   */
  encode(encoder, calls) {
    const pass = encoder.beginComputePass();
    for (const { pipeline, group, count } of calls) {
      pass.setPipeline(pipeline);
      pass.setBindGroup(0, group);
      if (typeof count === 'number') pass.dispatchWorkgroups(count);
      else if (Array.isArray(count)) pass.dispatchWorkgroups(...count);
      else pass.dispatchWorkgroupsIndirect(count.buffer, count.offset);
    }
    pass.end();
  }

  dispose() {
    this.isLost = true;
    this.device.destroy();
  }
}

/** @param {GPUTexture} texture */
const textureBytes = ({ width, height, format }) => width * height * (format === 'rgba16float' ? 8 : 4);

/** @param {GPUAdapter & {isFallbackAdapter?: boolean}} adapter */
function isSoftware({ info, isFallbackAdapter }) {
  return (
    info.isFallbackAdapter ||
    isFallbackAdapter ||
    SOFTWARE.test(`${info.vendor} ${info.architecture} ${info.description}`)
  );
}

/** Words on the GPU, in ranges; a larger buffer replaces a full one. */
export class Words {
  /**
   * @param {Device} device
   * @param {number} capacity words at first
   * @param {() => void} replaced called when bind groups of the buffer are outdated
   */
  constructor(device, capacity, replaced) {
    this.device = device;
    this.replaced = replaced;
    this.ranges = new Ranges();
    this.buffer = device.buffer(4 * capacity);
  }

  /**
   * @param {Uint32Array<ArrayBuffer>} words
   * @returns {{start: number, size: number}} their place
   */
  append(words) {
    const { device, ranges } = this;
    const start = ranges.take(words.length) ?? 0; // there is always room
    this.#reserve(ranges.end);
    device.device.queue.writeBuffer(this.buffer, 4 * start, words);
    return { start, size: words.length };
  }

  /** @param {{start: number, size: number}} range that is freed */
  give({ start, size }) {
    this.ranges.give(start, size);
  }

  /** @param {number} words */
  #reserve(words) {
    if (4 * words <= this.buffer.size) return;
    const { device } = this;
    if (4 * words > device.bindingMax)
      throw new RangeError(`${4 * words} bytes in a buffer, this GPU allows ${device.bindingMax}`);
    this.#move(Math.min(device.bindingMax, Math.max(4 * words, 1.5 * this.buffer.size)));
  }

  /** Free reserved memory. */
  trim() {
    const { end } = this.ranges;
    if (this.buffer.size > 4 * end + 1024) this.#move(4 * end);
  }

  /** @param {number} bytes */
  #move(bytes) {
    const { device, buffer } = this;
    this.buffer = device.buffer(bytes);
    const encoder = device.device.createCommandEncoder();
    encoder.copyBufferToBuffer(buffer, 0, this.buffer, 0, Math.min(buffer.size, this.buffer.size));
    device.device.queue.submit([encoder.finish()]);
    device.free(buffer);
    this.replaced();
  }

  dispose() {
    this.device.free(this.buffer);
  }
}
