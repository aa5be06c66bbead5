// SPDX-License-Identifier: Apache-2.0
// Sorting by depth: two counting passes over 22 bits of the depth's binary32 pattern.

const DIGIT_BITS = 11;
const DIGITS = 1 << DIGIT_BITS;
const KEY_BITS = 2 * DIGIT_BITS;

/** Sorts by depth; keeps its memory between sorts. */
export class DepthSorter {
  constructor() {
    this.keys = new Uint32Array(0);
    this.swap = new Uint32Array(0);
    this.swapKeys = new Uint32Array(0);
    this.low = new Uint32Array(DIGITS);
    this.high = new Uint32Array(DIGITS);
  }

  /**
   * Order slots by depth, farthest first. Of equal keys the later slot comes first, so that the earlier is drawn over it.
   *
   * Positive binary32 numbers sort by their bits. The bits above those of the nearest depth are cut to 22: if depths span
   * a factor of 2^k, the relative resolution is k × 2^−22.
   *
   * @param {Float32Array} depths [count] or longer, above 0 and finite
   * @param {Uint32Array} slots [count] or longer
   * @param {number} count
   * @param {Uint32Array} out [count] or longer
   */
  sort(depths, slots, count, out) {
    this.reserve(count);
    const { keys, swap, swapKeys, low, high } = this;
    const bits = new Uint32Array(depths.buffer, depths.byteOffset, count);
    let nearest = 0xffffffff;
    let farthest = 0;
    for (let i = 0; i < count; i++) {
      const one = bits[i];
      if (one < nearest) nearest = one;
      if (one > farthest) farthest = one;
    }
    const span = count ? farthest - nearest : 0;
    const shift = Math.max(0, 32 - Math.clz32(span) - KEY_BITS);
    low.fill(0);
    high.fill(0);
    for (let i = 0; i < count; i++) {
      const key = (farthest - bits[i]) >>> shift; // farthest first
      keys[i] = key;
      low[key & (DIGITS - 1)]++;
      high[key >>> DIGIT_BITS]++;
    }
    begins(low);
    begins(high);
    // One pass runs backwards, so that of equal keys the later slot comes first.
    for (let i = count - 1; i >= 0; i--) {
      const at = low[keys[i] & (DIGITS - 1)]++;
      swap[at] = slots[i];
      swapKeys[at] = keys[i];
    }
    for (let i = 0; i < count; i++) out[high[swapKeys[i] >>> DIGIT_BITS]++] = swap[i];
  }

  /** @param {number} count */
  reserve(count) {
    if (this.keys.length >= count) return;
    this.keys = new Uint32Array(count);
    this.swap = new Uint32Array(count);
    this.swapKeys = new Uint32Array(count);
  }
}

/**
 * Convert counts to start positions.
 *
 * @param {Uint32Array} counts
 */
function begins(counts) {
  for (let digit = 0, sum = 0; digit < DIGITS; digit++) {
    const count = counts[digit];
    counts[digit] = sum;
    sum += count;
  }
}
