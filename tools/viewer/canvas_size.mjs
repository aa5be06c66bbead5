// SPDX-License-Identifier: Apache-2.0
// The size of the drawing buffer: CSS size times pixel ratio, at most what the GPU can draw, and reduced while the camera moves on
// a slow machine.

/** @typedef {{setSize: (width: number, height: number) => void, sideMax: number}} Sized */

const PIXEL_RATIO = 2; // maximum pixels of the drawing buffer per CSS pixel; more makes no visible difference for splats
const SLOW_MS = 45; // frame time while moving above which resolution is reduced
const FAST_MS = 20; // frame time below which resolution is raised again
const WANTED_MS = 30;
const COARSEST = 0.4; // minimum share of the pixels per side
const STEPS = [0.6, 1.15]; // limits of the change per frame
const REST_MS = 220; // time without movement before the picture is drawn at full size

export class CanvasSize {
  /**
   * @param {HTMLCanvasElement} canvas
   * @param {{width: number, height: number} | null} fixed fixed size of the drawing buffer
   * @param {() => void} resized called when the size of the drawing buffer has changed
   */
  constructor(canvas, fixed, resized) {
    this.canvas = canvas;
    this.fixed = fixed;
    this.resized = resized;
    /** @type {Sized | null} */
    this.engine = null;
    this.width = 1;
    this.height = 1;
    this.moving = false;
    this.quality = 1; // while moving
    this.rest = 0;
    this.observer = new ResizeObserver(() => this.fit());
    if (fixed) {
      canvas.style.width = `${fixed.width}px`;
      canvas.style.height = `${fixed.height}px`;
    } else this.observer.observe(canvas);
  }

  /** @param {Sized} engine */
  attach(engine) {
    this.engine = engine;
    this.width = 0;
    this.fit();
  }

  /** Size of the drawing buffer at full resolution, pixels. */
  get full() {
    return this.#sizeAt(1);
  }

  /** @param {number} quality share of the full resolution */
  #sizeAt(quality) {
    const { canvas, fixed, engine } = this;
    const [wide, high] = fixed ? [fixed.width, fixed.height] : [canvas.clientWidth, canvas.clientHeight];
    const wanted = fixed ? 1 : Math.min(devicePixelRatio || 1, PIXEL_RATIO) * quality;
    const ratio = Math.min(wanted, (engine?.sideMax ?? Infinity) / Math.max(1, wide, high));
    return { width: Math.max(1, Math.round(wide * ratio)), height: Math.max(1, Math.round(high * ratio)) };
  }

  /** Set the drawing buffer to its current target size. */
  fit() {
    const { width, height } = this.#sizeAt(this.moving ? this.quality : 1);
    if (width === this.width && height === this.height) return;
    this.width = width;
    this.height = height;
    this.engine?.setSize(width, height);
    this.resized();
  }

  /** Note that the camera moves. */
  moved() {
    if (this.fixed) return;
    if (!this.moving) {
      this.moving = true;
      this.fit();
    }
    clearTimeout(this.rest);
    this.rest = window.setTimeout(() => {
      this.moving = false;
      this.fit();
    }, REST_MS);
  }

  /**
   * Adapt the resolution to the time of a frame.
   *
   * @param {number} frameMs time of the frame
   */
  drawn(frameMs) {
    if (!this.moving || (frameMs >= FAST_MS && frameMs <= SLOW_MS)) return;
    const step = Math.min(STEPS[1], Math.max(STEPS[0], Math.sqrt(WANTED_MS / Math.max(1, frameMs))));
    const quality = Math.min(1, Math.max(COARSEST, this.quality * step));
    if (quality === this.quality) return;
    this.quality = quality;
    this.fit();
  }

  close() {
    this.engine = null;
    this.observer.disconnect();
    clearTimeout(this.rest);
  }
}
