// SPDX-License-Identifier: Apache-2.0
// Finds the splats in view, projects them into records and sorts these by depth, on the GPU. What exceeds the records is
// drawn in slices of depth, nearest first.

import { slopeLimits } from '../../codec/js/levels/level_cut.mjs';
import { BLOCK_SPLATS } from './texels.mjs';

/**
 * @typedef {import('./types.d.ts').View} View
 * @typedef {import('./webgpu_device.mjs').Call} Call
 * @typedef {import('./webgpu_device.mjs').Device} Device
 * @typedef {import('./webgpu_scene.mjs').GpuScene} GpuScene
 *
 * Buffers that depend on the number of splats, and the passes of the sort.
 * @typedef {{count: number, blocks: GPUBuffer, ellipses: GPUBuffer, looks: GPUBuffer, keys: GPUBuffer, order: GPUBuffer,
 *   sums: GPUBuffer, pairCounts: GPUBuffer, depths: GPUBuffer, owned: GPUBuffer[], sort: Call[]}} Records
 *
 * What the content of `View` in common.wgsl depends on.
 * @typedef {object} Part
 * @property {View} view
 * @property {[number, number]} band first row and number of rows
 * @property {[number, number]} slice first and last depth key
 * @property {number} shDegree
 * @property {number} [pairs] that the buffers hold
 */

export const SCREEN_TILE = 16; // pixels

/** Offsets of the numbers of workgroups and of the arguments of a draw, see dispatch.wgsl. */
export const GROUPS = { sortRecords: 0, blocksOfRanks: 12, sortPairs: 24, drawQuads: 36 };

const RECORD_BYTES = 16; // in each of the two buffers of records
const MOST_RECORDS = 1 << 23; // 400 MB
const RUN = 4096; // elements per workgroup of a sort
const VIEW_BYTES = 144;
const LAST_KEY = 0x7f7fffff; // bits of the largest finite depth
const DEPTH_BITS = 15; // bits of a key that tell slices apart at once
const FILLED = 0.75; // of the records, by a slice, so that a small movement needs no others

export class Projection {
  /** @param {Device} device */
  constructor(device) {
    this.device = device;
    this.view = device.buffer(VIEW_BYTES, GPUBufferUsage.UNIFORM);
    this.counters = device.buffer(16);
    this.groups = device.buffer(64, GPUBufferUsage.STORAGE | GPUBufferUsage.INDIRECT);
    this.recordsMax = Math.min(device.bindingMax / RECORD_BYTES - 1, MOST_RECORDS);
    /** @type {GpuScene | null} */
    this.scene = null;
    /** @type {Records | null} */
    this.known = null;
    /** Passes that use buffers of the scene; null if one was replaced. @type {Call[] | null} */
    this.passes = null;
    /** First and last depth key of each slice. @type {[number, number][]} */
    this.slices = [[0, LAST_KEY]];
  }

  /** @param {GpuScene | null} scene replaces the scene, which is not freed */
  setScene(scene) {
    for (const buffer of this.known?.owned ?? []) this.device.free(buffer);
    this.known = this.passes = null;
    this.slices = [[0, LAST_KEY]];
    this.scene = scene;
  }

  /** @returns {Records} */
  get records() {
    if (this.known) return this.known;
    const { device } = this;
    const blockCount = this.scene?.blockCount ?? 0;
    const drawn = this.scene?.layout.drawn ?? 0;
    const count = Math.max(1, Math.min(blockCount * BLOCK_SPLATS, drawn, this.recordsMax));
    const pair = (/** @type {number} */ bytes) => [device.buffer(bytes * count), device.buffer(bytes * count)];
    const [keys, values] = [pair(4), pair(4)];
    const recordBytes = RECORD_BYTES * (count + 1); // the last record draws nothing, see bin.wgsl
    const [ellipses, looks, pairCounts] = [
      device.buffer(recordBytes),
      device.buffer(recordBytes),
      device.buffer(4 * count),
    ];
    const [blocks, sums] = [device.buffer(36 * blockCount), device.buffer(4 * Math.ceil(count / BLOCK_SPLATS))];
    const depths = device.buffer(4 << DEPTH_BITS);
    const { calls, owned } = this.sortPasses(keys, values, 32, GROUPS.sortRecords, count);
    owned.push(blocks, sums, pairCounts, depths, ellipses, looks, ...keys, ...values);
    this.known = {
      count,
      blocks,
      ellipses,
      looks,
      keys: keys[0],
      order: values[0],
      sums,
      pairCounts,
      depths,
      owned,
      sort: calls,
    };
    return this.known;
  }

  /** Passes that find the splats in view, project them and sort them by depth. */
  get calls() {
    if (this.passes) return this.passes;
    const { device, scene, view, counters, groups } = this;
    const { blocks, ellipses, looks, keys, sort } = this.records;
    const bind = device.bind.bind(device);
    const pages = this.#pages();
    const tables = scene?.tables.buffer ?? null;
    this.passes = [
      ...pages.map((page) => bind('cull', 'cull', page.blocks, ...this.#source(page), blocks)),
      bind('compact', 'compact', 1, view, counters, blocks),
      bind('dispatch', 'after_compact', 1, view, counters, groups),
      ...pages.map((page) => {
        const source = [...this.#source(page), page.rows?.buffer ?? null, tables];
        return bind('project', 'project', page.blocks, ...source, blocks, ellipses, looks, keys);
      }),
      ...sort,
    ];
    return this.passes;
  }

  #pages() {
    return (this.scene?.pages ?? []).filter((page) => page.geometry !== null);
  }

  /** @param {import('./webgpu_scene.mjs').Page} page */
  #source(page) {
    return [this.view, page.info, this.scene?.table ?? null, page.geometry?.buffer ?? null];
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
  sortPasses(keys, values, bits, offset, count) {
    const { device, counters } = this;
    const ofPairs = offset === GROUPS.sortPairs;
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

  /**
   * Write what the shaders read of a view.
   *
   * @param {Part} part
   * @param {number} [depthShift] for the passes of `divide`
   */
  setView({ view, band, slice, shDegree, pairs = 0 }, depthShift = 0) {
    const { viewmat: m, fx, fy, cx, cy, width, near } = view;
    const [first, rows] = band;
    const words = new Uint32Array(VIEW_BYTES / 4);
    const floats = new Float32Array(words.buffer);
    floats.set([m[0], m[1], m[2], 0, m[4], m[5], m[6], 0, m[8], m[9], m[10], 0]);
    floats.set([fx, fy, cx, cy - first], 12);
    floats.set(slopeLimits(view), 16);
    floats.set([width, rows, near], 20);
    const columns = Math.ceil(width / SCREEN_TILE);
    const { blockCount = 0, blockTable = 0, tileTable = 0 } = this.scene ?? {};
    words.set([...slice, columns, columns * Math.ceil(rows / SCREEN_TILE), this.records.count, pairs], 23);
    words.set([blockCount, blockTable, tileTable, depthShift, Math.min(shDegree, 4)], 29);
    this.device.device.queue.writeBuffer(this.view, 0, words);
  }

  /**
   * Divide the depths into slices, each with fewer splats in view than there are records.
   *
   * @param {View} view
   * @returns {Promise<void>} rejects with a RangeError if too many splats have the same depth
   */
  async divide(view) {
    const { records } = this;
    const most = FILLED * records.count;
    const starts = [0];
    let sum = 0; // splats since the last start
    /** @type {(first: number, last: number, shift: number) => Promise<void>} */
    const search = async (first, last, shift) => {
      const counts = await this.#countDepths(view, [first, last], shift);
      for (let place = 0; place < counts.length; place++) {
        const key = first + place * 2 ** shift;
        if (sum + counts[place] <= most) sum += counts[place];
        else if (shift > 0) {
          await search(key, Math.min(last, key + 2 ** shift - 1), Math.max(0, shift - DEPTH_BITS));
        } else {
          if (counts[place] > records.count) {
            throw new RangeError(`${counts[place]} splats of the same depth, this GPU can draw ${records.count}`);
          }
          if (sum > 0) starts.push(key);
          sum = counts[place];
        }
      }
    };
    await search(0, LAST_KEY, 31 - DEPTH_BITS);
    if (this.known !== records) return; // of a scene that has been replaced
    this.slices = starts.map((start, i) => [start, (starts[i + 1] ?? LAST_KEY + 1) - 1]);
  }

  /**
   * Count the splats in view by depth; none if the GPU is lost or the scene was replaced.
   *
   * @param {View} view
   * @param {[number, number]} slice
   * @param {number} shift
   */
  async #countDepths(view, slice, shift) {
    const { device, records, scene } = this;
    if (device.isLost) return new Uint32Array(0);
    const { depths } = records;
    scene?.place(view);
    this.setView({ view, band: [0, view.height], slice, shDegree: 0 }, shift);
    const encoder = device.device.createCommandEncoder();
    encoder.clearBuffer(depths);
    const calls = this.#pages().map((page) =>
      device.bind('cull', 'count_depths', page.blocks, ...this.#source(page), null, depths),
    );
    device.encode(encoder, calls);
    device.device.queue.submit([encoder.finish()]);
    const counts = await device.read(depths, depths.size);
    return counts && this.known === records ? counts : new Uint32Array(0);
  }
}
