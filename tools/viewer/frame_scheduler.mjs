// SPDX-License-Identifier: Apache-2.0
// Draws in the next animation frame, but not before the GPU has finished the previous one.

const SECOND_MS = 1000;

export class FrameScheduler {
  /**
   * @param {() => Promise<void>} draw resolves when the GPU is done
   * @param {(frameMs: number, fps: number) => void} drawn
   */
  constructor(draw, drawn) {
    this.draw = draw;
    this.drawn = drawn;
    this.isWanted = false;
    this.isBusy = false;
    this.isClosed = false;
    this.current = Promise.resolve();
    /** @type {number[]} completion times of the frames of the last second */
    this.done = [];
  }

  /** Request a frame. */
  request() {
    this.isWanted = true;
    if (!this.isBusy && !this.isClosed) this.schedule();
  }

  schedule() {
    if (this.handle !== undefined) return;
    this.handle = requestAnimationFrame(() => {
      this.handle = undefined;
      if (this.isWanted && !this.isBusy && !this.isClosed) void this.now();
    });
  }

  /** Resolves when the requested frame has been drawn, whether or not the page is visible. */
  async settle() {
    while (this.isBusy) await this.current;
    if (this.isWanted && !this.isClosed) await this.now();
  }

  /**
   * Do other work between two frames.
   *
   * @template T
   * @param {() => Promise<T>} work
   * @returns {Promise<T>}
   */
  async between(work) {
    while (this.isBusy) await this.current;
    this.isBusy = true;
    const done = work().finally(() => {
      this.isBusy = false;
      if (this.isWanted && !this.isClosed) this.schedule();
    });
    this.current = done.then(
      () => {},
      () => {},
    );
    return done;
  }

  async now() {
    this.isWanted = false;
    this.isBusy = true;
    const start = performance.now();
    this.current = this.draw().finally(() => (this.isBusy = false));
    await this.current;
    const end = performance.now();
    this.done.push(end);
    this.done = this.done.filter((time) => time > end - SECOND_MS);
    if (this.isClosed) return;
    this.drawn(end - start, this.done.length);
    if (this.isWanted) this.schedule();
  }

  close() {
    this.isClosed = true;
    if (this.handle !== undefined) cancelAnimationFrame(this.handle);
  }
}
