// SPDX-License-Identifier: Apache-2.0
// Blends records by screen tiles, in binary32: lists the screen tiles of each splat, sorts these pairs, and blends each
// screen tile in workgroup memory. What exceeds the buffers is drawn in bands of rows and in steps.

import { BLOCK_SPLATS } from './texels.mjs';
import { GROUPS, SCREEN_TILE } from './webgpu_projection.mjs';

/**
 * @typedef {import('./webgpu_device.mjs').Call} Call
 * @typedef {import('./webgpu_projection.mjs').Projection} Projection
 *
 * Buffers that depend on the size of the picture, and the passes that use them.
 * @typedef {{width: number, height: number, pairs: number, pixels: GPUBuffer, ranges: GPUBuffer, owned: GPUBuffer[],
 *   clear: Call[], step: Call[]}} Target
 */

const LEAST_PAIRS = 1 << 20;
const MOST_PAIRS = 1 << 26;

export class ScreenTiles {
  name = 'screen tiles';
  presents = /** @type {const} */ ('present');
  isFarthestFirst = false;

  /** @param {Projection} projection */
  constructor(projection) {
    this.projection = projection;
    /** Pairs of splat and screen tile that the buffers may hold. */
    this.pairsMax = Math.min(projection.device.bindingMax / 4, MOST_PAIRS);
    this.pairsWanted = LEAST_PAIRS;
    this.steps = 1;
    /** @type {Target | null} */
    this.target = null;
  }

  get pairs() {
    return this.target?.pairs ?? 0;
  }

  /**
   * Divide a picture into bands of rows that fit the buffers, and make room for one.
   *
   * @param {{width: number, height: number}} view
   * @returns {[number, number][]} first row and number of rows
   */
  prepare({ width, height }) {
    const columns = Math.ceil(width / SCREEN_TILE);
    const { bindingMax } = this.projection.device;
    const rows = Math.floor(
      Math.min(bindingMax / (16 * width * SCREEN_TILE), this.pairsMax / (BLOCK_SPLATS * columns)),
    );
    const band = Math.min(height, Math.max(1, rows) * SCREEN_TILE);
    this.#makeRoom(width, band);
    /** @type {[number, number][]} */
    const bands = [];
    for (let first = 0; first < height; first += band) bands.push([first, Math.min(band, height - first)]);
    return bands;
  }

  /**
   * @param {number} width
   * @param {number} height
   */
  #makeRoom(width, height) {
    const [columns, rows] = [Math.ceil(width / SCREEN_TILE), Math.ceil(height / SCREEN_TILE)];
    const pairs = Math.max(Math.min(this.pairsWanted, this.pairsMax), BLOCK_SPLATS * columns * rows);
    const known = this.target;
    if (known && known.width === width && known.height === height && known.pairs === pairs) return;
    this.forget();
    const { device, view, counters, groups, records } = this.projection;
    const { ellipses, looks, order, sums, pairCounts } = records;
    const [pixels, ranges] = [device.buffer(16 * width * height), device.buffer(8 * columns * rows)];
    const keys = [device.buffer(4 * pairs), device.buffer(4 * pairs)];
    const values = [device.buffer(4 * pairs), device.buffer(4 * pairs)];
    const bits = Math.max(1, 32 - Math.clz32(columns * rows - 1));
    const done = Math.ceil(bits / 8) % 2;
    const blocks = { buffer: groups, offset: GROUPS.blocksOfRanks };
    const sort = this.projection.sortPasses(keys, values, bits, GROUPS.sortPairs, pairs);
    const bind = device.bind.bind(device);
    this.target = {
      width,
      height,
      pairs,
      pixels,
      ranges,
      owned: [pixels, ranges, ...keys, ...values, ...sort.owned],
      clear: [
        bind(
          'dispatch',
          'clear_pixels',
          [Math.ceil((width * height) / (64 * BLOCK_SPLATS)), 64],
          view,
          null,
          null,
          pixels,
        ),
      ],
      step: [
        bind('bin', 'count', blocks, view, counters, order, ellipses, looks, sums, pairCounts),
        bind('bin', 'scan', 1, view, counters, null, null, null, sums),
        bind('dispatch', 'after_scan', 1, null, counters, groups),
        bind('bin', 'emit', blocks, view, counters, order, ellipses, looks, sums, pairCounts, keys[0], values[0]),
        ...sort.calls,
        bind('ranges', 'find', { buffer: groups, offset: GROUPS.sortPairs }, counters, keys[done], ranges),
        bind('blend', 'blend', [columns, rows], view, ellipses, looks, values[done], ranges, pixels),
        bind('dispatch', 'next_step', 1, null, counters),
      ],
    };
  }

  /**
   * Blend the records of a slice.
   *
   * @param {GPUCommandEncoder} encoder
   * @param {boolean} isFirst whether the pixels are empty
   */
  encode(encoder, isFirst) {
    const { target } = this;
    const { device } = this.projection;
    if (!target) return;
    if (isFirst) device.encode(encoder, target.clear);
    for (let step = 0; step < this.steps; step++) {
      encoder.clearBuffer(target.ranges);
      device.encode(encoder, target.step);
    }
  }

  /** @returns {GPUBindGroupEntry[]} the pixels, for present.wgsl */
  get entries() {
    return this.target ? [{ binding: 1, resource: { buffer: this.target.pixels } }] : [];
  }

  /** Draw the next picture in larger buffers, or in more steps. */
  enlarge() {
    if (this.pairsWanted < this.pairsMax) this.pairsWanted *= 2;
    else this.steps++;
  }

  /** Free the buffers. */
  forget() {
    for (const buffer of this.target?.owned ?? []) this.projection.device.free(buffer);
    this.target = null;
  }
}
