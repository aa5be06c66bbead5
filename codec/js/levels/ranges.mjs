// SPDX-License-Identifier: Apache-2.0
// Allocation of ranges in memory that is written piece by piece: slots of splats, words and texels of tiles.

/** Free ranges of some memory. */
export class Ranges {
  /** @param {number[]} pages sizes; a range never crosses the end of a page, and the last page may be infinite */
  constructor(pages = [Infinity]) {
    /** First elements of the pages. @type {Set<number>} */
    this.starts = new Set();
    /** Ascending, not adjacent within a page. @type {{start: number, size: number}[]} */
    this.free = [];
    /** One past the last element that was ever taken. */
    this.end = 0;
    let start = 0;
    for (const size of pages) {
      this.starts.add(start);
      this.free.push({ start, size });
      start += size;
    }
  }

  /**
   * Take the first free range that is large enough.
   *
   * @param {number} size
   * @returns {number | null} its first element, or null if there is none
   */
  take(size) {
    if (size === 0) return 0;
    const at = this.free.findIndex((one) => one.size >= size);
    if (at < 0) return null;
    const range = this.free[at];
    const { start } = range;
    range.start += size;
    range.size -= size;
    if (range.size === 0) this.free.splice(at, 1);
    this.end = Math.max(this.end, start + size);
    return start;
  }

  /**
   * Return a range that was taken.
   *
   * @param {number} start
   * @param {number} size
   */
  give(start, size) {
    if (size === 0) return;
    let at = this.free.findIndex((one) => one.start > start);
    if (at < 0) at = this.free.length;
    const before = this.free[at - 1];
    const after = this.free[at];
    const joinsBefore = before && before.start + before.size === start && !this.starts.has(start);
    const joinsAfter = after && start + size === after.start && !this.starts.has(after.start);
    if (joinsBefore) {
      before.size += size + (joinsAfter ? after.size : 0);
      if (joinsAfter) this.free.splice(at, 1);
    } else if (joinsAfter) {
      after.start = start;
      after.size += size;
    } else this.free.splice(at, 0, { start, size });
  }
}
