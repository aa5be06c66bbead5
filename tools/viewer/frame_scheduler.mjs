// Draws at the next animation frame, but not before the GPU has finished the last one.

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
    /** @type {number[]} when the frames of the last second were done */
    this.done = [];
  }

  /** Draw soon. */
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

  /** Resolves when what is wanted has been drawn, whether the page is shown or not. */
  async settle() {
    await this.current;
    if (this.isWanted && !this.isClosed) await this.now();
  }

  /** What was wanted has been drawn by other means. */
  skip() {
    this.isWanted = false;
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
