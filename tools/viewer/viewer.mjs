// SPDX-License-Identifier: Apache-2.0
// The viewer: an engine, a camera with its controls, and a canvas that follows the page's size. The page (main.mjs) and the
// element (element.mjs) are built on it.

import { readCamera } from '../../codec/js/first_view.mjs';
import { Controls } from './controls.mjs';
import { completeSize, fitCamera } from './camera_maths.mjs';
import { createEngine } from './engine.mjs';
import { E_INPUT, E_SUPERSEDED, EngineError } from './engine_error.mjs';
import { readCameras } from './page.mjs';
import { OrbitCamera, pivotOf } from './orbit_camera.mjs';
import { CameraList, emptyPose } from './camera_list.mjs';
import { CanvasSize } from './canvas_size.mjs';

/**
 * @typedef {import('./types.d.ts').Engine} Engine
 * @typedef {import('./types.d.ts').ErrorReport} ErrorReport
 * @typedef {import('./types.d.ts').FileCamera} FileCamera
 * @typedef {import('./types.d.ts').Progress} Progress
 * @typedef {import('./types.d.ts').Stats} Stats
 *
 * @typedef {object} Hooks
 * @property {() => boolean} calm whether the user prefers no animations
 * @property {() => void} [header] called when `view.facts` holds the file's metadata
 * @property {() => void} [placed] called when the camera may have been placed
 * @property {() => void} [moved] called when the camera has moved, other than by `useCameras`
 * @property {(point: readonly number[]) => void} [chosen] called with a point that users have chosen to orbit
 * @property {(progress: Progress) => void} progress
 * @property {(stats: Stats) => void} frame called when a frame has been drawn
 * @property {(stats: Stats) => void} shown called when the scene has been drawn completely
 * @property {(report: ErrorReport) => void} failed called once for each error
 */

const BLACK = /** @type {[number, number, number]} */ ([0, 0, 0]);

export class SceneViewer {
  /**
   * @param {HTMLCanvasElement} canvas
   * @param {import('./page.mjs').Wishes} wishes
   * @param {Hooks} hooks
   * @param {import('./controls.mjs').Reach} [reach] scope of the controls
   * @param {import('./types.d.ts').FetchOptions} [fetching]
   */
  constructor(canvas, wishes, hooks, reach, fetching = {}) {
    this.canvas = canvas;
    this.wishes = wishes;
    this.hooks = hooks;
    this.fetching = fetching;
    /** @type {Engine | null} */
    this.engine = null;
    this.turn = 0; // number of scenes so far; discards late results of earlier scenes
    this.isOpening = false;
    this.isClosed = false;
    this.isSetting = false;
    this.hasAlpha = wishes.background === 'transparent';
    this.rig = new OrbitCamera(emptyPose(), 1, wishes.limits);
    this.known = this.rig.pose;
    this.stage = new CanvasSize(canvas, wishes.size, () => this.draw());
    /** @type {Controls} */
    this.controls = new Controls(
      canvas,
      this.rig,
      {
        moved: () => {
          this.stage.moved();
          this.draw();
          const hasMoved = this.rig.pose !== this.known;
          this.known = this.rig.pose;
          if (hasMoved && !this.isSetting) hooks.moved?.();
        },
        pivotAt: (x, y) => {
          const pose = this.view.pivotAt(x, y, canvas.clientWidth, canvas.clientHeight);
          if (pose) hooks.chosen?.(pivotOf(pose));
          return pose;
        },
        calm: hooks.calm,
      },
      reach,
    );
    /** @type {CameraList} */
    this.view = new CameraList(this.rig, this.controls, wishes);
  }

  /** The background: the requested one, else that of the training, else black. */
  get background() {
    return this.wishes.background ?? this.view.facts.background ?? BLACK;
  }

  /**
   * @param {import('./types.d.ts').Background | null} wanted null for the scene's own
   * @returns {boolean} false if the canvas cannot be transparent
   */
  setBackground(wanted) {
    if (wanted === 'transparent' && !this.hasAlpha) return false;
    this.wishes = { ...this.wishes, background: wanted };
    this.engine?.setBackground(this.background);
    return true;
  }

  /**
   * Create the engine.
   *
   * @returns {Promise<Engine | null>} null if it failed; `failed` has then been called
   */
  async start() {
    const { hooks } = this;
    try {
      const engine = await createEngine(this.canvas, {
        ...this.fetching,
        background: this.background,
        backend: this.wishes.backend,
        onHeader: (header, description) => {
          this.view.read(header, description);
          engine.setBackground(this.background);
          hooks.header?.();
          this.#place();
        },
        onProgress: (progress) => {
          hooks.progress(progress);
          this.#place();
        },
        onFrame: (stats) => {
          this.stage.drawn(stats.frameMs);
          hooks.frame(stats);
        },
        // `show` reports the rejections of `open`
        onError: (report) => {
          if (report.fatal && this.isOpening) return;
          if (report.reason === 'replaced' && !report.fatal) this.view.placeAgain();
          hooks.failed(report);
        },
      });
      if (this.isClosed) {
        engine.close();
        return null;
      }
      this.engine = engine;
      this.stage.attach(engine);
    } catch (error) {
      if (!this.isClosed) hooks.failed(asReport(error));
    }
    return this.engine;
  }

  /** The current camera; null before the scene is placed. @returns {FileCamera | null} */
  get camera() {
    if (!this.view.bounds) return null;
    const { width: W, height: H } = this.stage.full;
    const { viewmat: m, fx, fy, cx, cy, near } = this.rig.camera(W, H);
    const K = [
      [fx, 0, cx],
      [0, fy, cy],
      [0, 0, 1],
    ];
    return { K, viewmat: [0, 4, 8, 12].map((row) => m.slice(row, row + 4)), W, H, near };
  }

  /**
   * Show other cameras, the first one at once: before this returns, unless they have to be fetched.
   *
   * @param {Pick<import('./page.mjs').Wishes, 'camera' | 'view'>} wanted
   * @returns {Promise<string>} an error message, or ''
   */
  async useCameras({ camera, view }) {
    this.wishes = { ...this.wishes, camera, view };
    return this.readCameras(true);
  }

  /**
   * Make an image of the scene, see `Engine.toBlob`.
   *
   * @param {import('./types.d.ts').PictureOptions<FileCamera>} [options]
   * @returns {Promise<Blob>}
   */
  async toBlob({ camera, width, height, ...others } = {}) {
    const refuse = (/** @type {string} */ message) => new EngineError({ code: E_INPUT, message });
    if (!this.engine || !this.view.bounds) throw refuse('no picture can be made: no scene is shown');
    if (!camera) {
      const size = completeSize({ width, height }, this.stage.full);
      return this.engine.toBlob({ ...others, ...size, camera: this.rig.camera(size.width, size.height) });
    }
    /** @type {ReturnType<typeof readCamera>} */
    let read;
    try {
      read = readCamera(camera);
    } catch (error) {
      throw refuse(error instanceof Error ? error.message : String(error));
    }
    const { W, H, ...pinhole } = read.lens;
    const from = { width: W, height: H };
    const size = completeSize({ width, height }, from);
    return this.engine.toBlob({ ...others, ...size, camera: { ...read, ...fitCamera(pinhole, from, size) } });
  }

  /**
   * Read the requested cameras; an invalid one does not prevent the scene from loading.
   *
   * @param {boolean} [isShown] whether to show the first one
   * @returns {Promise<string>} an error message, or ''
   */
  async readCameras(isShown = false) {
    const { camera } = this.wishes;
    try {
      const read = camera === null ? null : readCameras(camera, this.fetching);
      const entries = read instanceof Promise ? await read : read;
      if (this.wishes.camera !== camera) return '';
      this.view.useCameras(entries, this.wishes.view);
      this.isSetting = true;
      if (isShown) this.view.showFirst();
      this.isSetting = false;
      return '';
    } catch (error) {
      return `The camera cannot be used: ${error instanceof Error ? error.message : error}`;
    }
  }

  /**
   * Replace the current scene.
   *
   * @param {string | Blob | ArrayBuffer} source
   */
  async show(source) {
    const { engine, hooks } = this;
    if (!engine) return;
    const mine = ++this.turn;
    this.view.begin();
    this.isOpening = true;
    try {
      await engine.open(source);
      if (mine !== this.turn) return;
      this.#place();
      await engine.settled();
      if (mine === this.turn) hooks.shown(engine.stats);
    } catch (error) {
      const report = asReport(error);
      if (mine === this.turn && report.code !== E_SUPERSEDED) hooks.failed(report);
    } finally {
      if (mine === this.turn) this.isOpening = false;
    }
  }

  draw() {
    const { engine, stage } = this;
    if (!engine) return;
    engine.setCamera(this.rig.camera(stage.width, stage.height));
    engine.requestFrame();
  }

  /** Place the camera, or its pivot once samples of the splats are here. */
  #place() {
    const { engine } = this;
    if (!engine?.bounds || !engine.header) return;
    if (this.view.place(engine.bounds)) this.draw();
    this.hooks.placed?.();
  }

  /** Free everything, including the canvas's context; no method may be called afterwards. */
  close() {
    this.isClosed = true;
    this.turn++;
    this.controls.close();
    this.stage.close();
    if (!this.engine) return;
    this.engine.close();
    this.engine = null;
    // browsers limit the number of contexts and may take any of them away
    this.canvas.getContext('webgl2')?.getExtension('WEBGL_lose_context')?.loseContext();
  }
}

/**
 * @param {unknown} error
 * @returns {ErrorReport}
 */
function asReport(error) {
  const { code = 'E_UNKNOWN', message = String(error), offset, clause, reason, status } = /** @type {any} */ (error);
  return new EngineError({ code, message, offset, clause, reason, status }).report();
}
