// SPDX-License-Identifier: Apache-2.0
// The viewer's engine: a canvas, a scene and a camera. Decoding, culling and sorting run in a worker.
//
//   import { createEngine } from './engine.mjs';
//   const engine = await createEngine(canvas, { onError: ({ message }) => show(message) });
//   engine.setSize(800, 600);
//   engine.setCamera({ viewmat, fx: 700, fy: 700, cx: 400, cy: 300 });
//   await engine.open('scene.csplat');

import { NO_CAMERA, completeSize, fitCamera, viewOf } from './camera_maths.mjs';
import { EngineError, E_CONTEXT, E_INPUT, E_LIMIT, E_SUPERSEDED, E_WEBGL2, E_WORKER } from './engine_error.mjs';
import { answer, sendable } from './fetch_port.mjs';
import { FrameScheduler } from './frame_scheduler.mjs';
import { SceneLoad } from './scene_load.mjs';
import { createRenderer } from './renderer.mjs';
import { emptyStats } from './statistics.mjs';

export { EngineError };

/**
 * @typedef {import('./types.d.ts').Camera} Camera
 * @typedef {import('./types.d.ts').Engine} Engine
 * @typedef {import('./types.d.ts').EngineOptions} EngineOptions
 * @typedef {import('./types.d.ts').Background} Background
 * @typedef {import('./types.d.ts').View} View
 * @typedef {import('./worker.mjs').Reply} Reply
 * @typedef {import('./worker.mjs').Request} Request
 */

/**
 * Create an engine that draws on a canvas.
 *
 * @param {HTMLCanvasElement} canvas
 * @param {EngineOptions} [options]
 * @returns {Promise<Engine>} rejects with an EngineError: E_WEBGL2 if the browser has no WebGL 2, E_WORKER if the page cannot
 *   start a worker
 */
export async function createEngine(canvas, options = {}) {
  /** @type {SplatEngine | null} */
  let engine = null;
  const losses = {
    lost: (/** @type {boolean} */ hasDrawn) => engine?.gpuLost(hasDrawn, losses),
    failed: (/** @type {string} */ code, /** @type {string} */ message) => engine?.gpuFailed(code, message),
  };
  const renderer = await createRenderer(canvas, options, losses);
  if (renderer === null) {
    throw new EngineError({ code: E_WEBGL2, message: 'this browser does not support WebGL 2, or it is disabled' });
  }
  try {
    engine = new SplatEngine(canvas, renderer, options);
    return engine;
  } catch (error) {
    renderer.dispose();
    throw error;
  }
}

const NO_WORKER =
  'it did not start; the Content-Security-Policy of the page may forbid it (worker-src, or trusted-types without csplat)';

/**
 * @param {EngineOptions} options
 * @throws {EngineError} E_WORKER if the page cannot start a worker
 */
function startWorker({ workerFactory }) {
  try {
    return workerFactory?.() ?? new Worker(new URL('./worker.mjs', import.meta.url), { type: 'module' });
  } catch (error) {
    throw new EngineError({ code: E_WORKER, message: `the viewer's worker failed: ${NO_WORKER}: ${error}` });
  }
}

/** Maximum number of splats that are drawn of a file with levels of detail, if the CPU sorts them, and if the GPU does. */
const [SORTED_SPLATS, UNSORTED_SPLATS] = [3e6, 6e6];

/** Gigabytes of memory below which a device gets half of that, as do users who save data. */
const SMALL_GB = 4;

/**
 * Error in pixels until which splats are refined, and for users who save data. Renders of lego60k, at a quarter of their size, have
 * 36.8 dB or more in either case, with 81 and 53 % of the splats.
 */
const [USUAL_PIXELS, SAVING_PIXELS] = [1, 2];

/**
 * @param {EngineOptions} options
 * @param {boolean} sort whether the CPU sorts
 * @returns {import('../../codec/js/levels/tile_stream.mjs').Aims}
 */
function aimsOf({ maxSplats, pixelError }, sort) {
  const device = /** @type {{deviceMemory?: number, connection?: {saveData?: boolean}}} */ (navigator);
  const { deviceMemory = SMALL_GB, connection } = device;
  const saves = connection?.saveData === true;
  const usual = (sort ? SORTED_SPLATS : UNSORTED_SPLATS) / (saves || deviceMemory < SMALL_GB ? 2 : 1);
  return { budget: maxSplats ?? usual, pixels: pixelError ?? (saves ? SAVING_PIXELS : USUAL_PIXELS), around: !saves };
}

/** Pixels of the largest picture that `toBlob` makes: 8192 × 8192, of 1 GiB in binary32. */
const PIXELS_MAX = 2 ** 26;

/** How often a scene is opened anew because its file was replaced, before that is an error. */
const REPLACEMENTS = 3;

/**
 * @param {string} url
 * @param {typeof fetch} [own] the caller's
 */
export async function heldBlob(url, own = fetch) {
  try {
    return await (await own(url)).blob();
  } catch (error) {
    const why = "it may have been revoked too early, or connect-src of the page's policy forbids blob:";
    throw new Error(`${url}: ${error}; ${why}`);
  }
}

/**
 * @param {Background} background
 * @returns {number[]} red, green, blue, alpha, premultiplied
 */
const premultiplied = (background) => (background === 'transparent' ? [0, 0, 0, 0] : [...background, 1]);

/** @implements {Engine} */
class SplatEngine {
  /**
   * @param {HTMLCanvasElement} canvas
   * @param {import('./renderer.mjs').Renderer} renderer
   * @param {EngineOptions} options
   */
  constructor(canvas, renderer, options) {
    this.canvas = canvas;
    this.renderer = renderer;
    this.options = options;
    this.look = { background: premultiplied(options.background ?? [0, 0, 0]), shDegree: Infinity };
    this.size = { width: canvas.width, height: canvas.height };
    /** Whether the view is that of `toBlob`, not that of the canvas. */
    this.isPicturing = false;
    /** @type {Camera | null} */
    this.camera = null;
    /** @type {View | null} */
    this.view = null;
    this.viewId = 0;
    this.sceneCount = 0;
    /** @type {SceneLoad | null} */
    this.opening = null;
    /** @type {(() => void)[]} callbacks for the next message of the worker */
    this.waiting = [];
    this.stats = emptyStats(renderer.capabilities);
    this.frames = new FrameScheduler(
      () => this.drawFrame(),
      (frameMs, fps) => this.frameDrawn(frameMs, fps),
    );
    this.worker = startWorker(options);
    this.worker.onmessage = ({ data }) => this.take(data);
    this.worker.onerror = ({ message }) => {
      this.fail(new EngineError({ code: E_WORKER, message: `the viewer's worker failed: ${message ?? NO_WORKER}` }));
    };
    this.listeners = new AbortController();
    const { signal } = this.listeners;
    canvas.addEventListener('webglcontextlost', (event) => this.contextLost(event), { signal });
    canvas.addEventListener('webglcontextrestored', () => this.restore('webgl2'), { signal });
    const seen = () => this.tell({ type: 'pause', isPaused: document.visibilityState === 'hidden' });
    document.addEventListener('visibilitychange', seen, { signal });
    seen();
  }

  get header() {
    return this.opening?.header ?? null;
  }

  get bounds() {
    return this.opening?.bounds ?? null;
  }

  /** @param {string | URL | Blob | ArrayBuffer} source */
  open(source) {
    this.replaced('another scene was opened before everything was decoded');
    const isAddress = typeof source === 'string' || source instanceof URL;
    const from = isAddress ? this.held(new URL(source, document.baseURI).href) : source; // the worker has a different base URL
    return new Promise((/** @type {(value: void) => void} */ resolve, reject) => this.begin(from, { resolve, reject }));
  }

  /**
   * Fetch the content of a blob: URL at once, before the page revokes it, as images do.
   *
   * @param {string} url
   * @returns {import('./scene_load.mjs').Source}
   */
  held(url) {
    if (!url.startsWith('blob:')) return url;
    const blob = heldBlob(url, this.options.fetch);
    blob.catch(() => {}); // it is reported by `begin`
    return blob;
  }

  /**
   * Start to read a scene.
   *
   * @param {import('./scene_load.mjs').Source} source
   * @param {import('./scene_load.mjs').Settle} settle
   * @param {number} [replacements] how often its file was replaced
   */
  begin(source, settle, replacements = 0) {
    this.stats = emptyStats(this.renderer.capabilities);
    const sort = !this.renderer.capabilities.sorts;
    const aims = aimsOf(this.options, sort);
    const opening = new SceneLoad(source, ++this.sceneCount, this.stats, aims.budget, this.options, settle);
    opening.replacements = replacements;
    this.opening = opening;
    const { fetch, renew, request, retries, retryMs, timeoutMs } = this.options;
    const fetching = {
      ...{ retries, retryMs, timeoutMs, hasFetch: fetch !== undefined, hasRenew: renew !== undefined },
      // A cache may hold parts of the file before.
      request: { ...sendable(request), ...(replacements > 0 && { cache: /** @type {const} */ ('reload') }) },
    };
    const tell = (/** @type {string | Blob | ArrayBuffer} */ readable) => {
      if (this.opening !== opening) return;
      this.tell({ type: 'open', scene: opening.scene, source: readable, sort, aims, fetching });
    };
    // In WebKit, the worker of a file: page cannot read a Blob, but the page can.
    const isOpaque = self.origin === 'null';
    if (!(source instanceof Promise) && !(isOpaque && source instanceof Blob)) return tell(source);
    /** @type {Promise<Blob | ArrayBuffer>} */
    const readable = Promise.resolve(/** @type {Blob | Promise<Blob>} */ (source)).then((blob) =>
      isOpaque ? blob.arrayBuffer() : /** @type {any} */ (blob),
    );
    readable.then(tell, (error) => {
      const report = {
        code: E_INPUT,
        message: String(error?.message ?? error),
        reason: /** @type {const} */ ('refused'),
      };
      if (this.opening === opening) this.fail(new EngineError(report));
    });
  }

  /** @param {Camera} camera */
  setCamera(camera) {
    this.camera = { ...camera };
    this.updateView();
  }

  /**
   * @param {number} width at most `sideMax`
   * @param {number} height at most `sideMax`
   */
  setSize(width, height) {
    this.size = { width, height };
    this.updateView();
  }

  /** Maximum width and height of a picture, pixels. */
  get sideMax() {
    return this.renderer.capabilities.sideMax;
  }

  updateView() {
    this.requestFrame();
    if (this.isPicturing) return;
    const { canvas, camera } = this;
    const { width, height } = this.size;
    if (canvas.width !== width) canvas.width = width;
    if (canvas.height !== height) canvas.height = height;
    if (camera === null) return;
    this.view = viewOf(camera, width, height);
    this.sortFor(this.view);
  }

  /** @param {View} view that the worker decodes and sorts for */
  sortFor(view) {
    this.tell({ type: 'view', id: ++this.viewId, view });
  }

  /** @param {Background} background */
  setBackground(background) {
    if (background === 'transparent' && this.options.background !== 'transparent') {
      const message = "the engine was made with an opaque background: pass background: 'transparent' to createEngine";
      throw new EngineError({ code: E_INPUT, message });
    }
    this.look.background = premultiplied(background);
    this.requestFrame();
  }

  /** @param {number} degree */
  setShDegree(degree) {
    this.look.shDegree = degree;
    this.requestFrame();
  }

  requestFrame() {
    this.frames.request();
  }

  async settled() {
    for (;;) {
      await this.sorted();
      const { viewId, opening } = this;
      await this.frames.settle();
      if (this.viewId === viewId && this.opening === opening && this.isSorted()) return;
    }
  }

  /**
   * Resolves when everything that the current view requires is decoded and sorted.
   *
   * @param {SceneLoad} [scene] rejects if another one is opened
   */
  async sorted(scene) {
    for (;;) {
      if (this.opening?.error) throw this.opening.error;
      if (scene && this.opening !== scene) {
        throw new EngineError({ code: E_SUPERSEDED, message: 'the scene was opened anew, or another one' });
      }
      if (this.isSorted()) return;
      await new Promise((/** @type {(value: void) => void} */ resolve) => this.waiting.push(resolve));
    }
  }

  isSorted() {
    return this.opening === null || this.opening.isSorted(this.viewId);
  }

  async readPixels() {
    await this.settled();
    return this.frames.between(async () => {
      const { width, height } = this.canvas;
      return this.renderer.pixelsOf(this.view ?? viewOf(NO_CAMERA, width, height), this.look);
    });
  }

  /** @param {import('./types.d.ts').PictureOptions} [options] */
  toBlob(options = {}) {
    return this.frames.between(async () => {
      this.isPicturing = true; // the canvas keeps its picture
      try {
        return await this.picture(options);
      } catch (error) {
        if (!(error instanceof RangeError)) throw error;
        throw new EngineError({ code: E_LIMIT, message: `no picture was made: ${error.message}` });
      } finally {
        this.isPicturing = false;
        if (this.opening) this.updateView();
      }
    });
  }

  /**
   * @param {import('./types.d.ts').PictureOptions} options
   * @throws {RangeError} a picture that is too large
   */
  async picture({ width, height, camera, type = 'image/png', quality }) {
    const refuse = (/** @type {string} */ message, code = E_INPUT) => new EngineError({ code, message });
    const { opening } = this;
    const own = camera ?? this.camera;
    if (this.frames.isClosed) throw refuse('the engine was closed before the picture was made', E_SUPERSEDED);
    if (opening === null || own === null) throw refuse('no picture can be made: no scene is open, or no camera is set');
    const size = completeSize({ width, height }, this.size);
    const shown = `${size.width} × ${size.height} pixels`;
    if (![size.width, size.height].every((side) => Number.isInteger(side) && side > 0)) {
      throw refuse(`the size of the picture is ${shown}, expected whole numbers above 0`);
    }
    const { sideMax } = this;
    if (Math.max(size.width, size.height) > sideMax || size.width * size.height > PIXELS_MAX) {
      throw new RangeError(`${shown}, at most ${sideMax} on each side and ${PIXELS_MAX} altogether are possible`);
    }
    /** @type {View} */
    let view;
    try {
      view = viewOf(camera ?? fitCamera(own, this.size, size), size.width, size.height);
    } catch (error) {
      throw refuse(`the camera of the picture: ${error}`);
    }
    this.sortFor(view);
    await this.sorted(opening);
    const pixels = await this.renderer.pixelsOf(view, this.look);
    if (pixels.length === 0) throw refuse('the GPU was lost before the picture was made', E_CONTEXT);
    return encodeImage(pixels, view, type, quality);
  }

  /** @param {import('./types.d.ts').MetadataChanges} changes */
  fileWith(changes) {
    const { port1, port2 } = new MessageChannel();
    this.worker.postMessage({ type: 'rewrite', changes, port: port2 }, [port2]);
    return new Promise((/** @type {(bytes: Uint8Array<ArrayBuffer>) => void} */ resolve, reject) => {
      port1.onmessage = (/** @type {{data: import('./worker.mjs').Rewritten}} */ { data: { bytes, error } }) => {
        port1.close();
        if (bytes) resolve(bytes);
        else reject(new EngineError(error ?? { code: E_WORKER, message: 'no file was written' }));
      };
    });
  }

  /**
   * @param {number} count
   * @param {number} [together]
   */
  async timeFrames(count, together = 1) {
    await this.settled();
    const times = [];
    for (let i = 0; i < count; i++) {
      const start = performance.now();
      for (let frame = 0; frame < together; frame++) this.drawNow();
      await this.renderer.wait();
      times.push((performance.now() - start) / together);
    }
    return times;
  }

  close() {
    this.replaced('the engine was closed before everything was decoded');
    this.opening = null;
    this.listeners.abort();
    this.frames.close();
    this.worker.terminate();
    this.renderer.dispose();
    this.wake();
  }

  /** @param {string} message */
  replaced(message) {
    this.opening?.fail(new EngineError({ code: E_SUPERSEDED, message }));
  }

  /** @param {Request} request */
  tell(request) {
    this.worker.postMessage(request);
  }

  wake() {
    const { waiting } = this;
    this.waiting = [];
    for (const resolve of waiting) resolve();
  }

  /** @param {Reply} reply */
  take(reply) {
    const { opening } = this;
    if (opening === null || reply.scene !== opening.scene || opening.error) return;
    if (reply.type === 'ask') return void answer(reply.question, reply.port, this.options);
    if (reply.type === 'error' && reply.error.reason === 'replaced' && opening.replacements < REPLACEMENTS) {
      this.options.onError?.({ ...reply.error, fatal: false });
      return this.begin(opening.source, opening.settle, opening.replacements + 1);
    }
    try {
      opening.take(reply, this.renderer);
    } catch (error) {
      if (!(error instanceof EngineError)) throw error;
      this.tell({ type: 'stop' });
      this.fail(error);
    }
    if (reply.type === 'geometry' || reply.type === 'band') this.tell({ type: 'placed', scene: reply.scene });
    if (reply.type === 'order') this.worker.postMessage({ type: 'recycle', order: reply.order }, [reply.order.buffer]);
    if (['header', 'band', 'order', 'done'].includes(reply.type)) this.requestFrame();
    this.wake();
  }

  /** @param {EngineError} error */
  fail(error) {
    this.opening?.fail(error);
    this.options.onError?.(error.report());
    this.wake();
  }

  drawNow() {
    const { width, height } = this.canvas;
    this.renderer.draw(this.view ?? viewOf(NO_CAMERA, width, height), this.look);
  }

  async drawFrame() {
    this.drawNow();
    try {
      await this.renderer.finished();
    } catch (error) {
      if (!(error instanceof RangeError)) throw error;
      this.gpuFailed(E_LIMIT, error.message);
    }
  }

  /**
   * @param {number} frameMs
   * @param {number} fps
   */
  frameDrawn(frameMs, fps) {
    const { stats, opening } = this;
    const { attributes, order, work } = this.renderer.bytes;
    const { name, pictureFormat } = this.renderer.capabilities; // may change after the scene is complete
    Object.assign(stats, {
      frameMs,
      fps,
      gpuBytes: attributes + order,
      workBytes: work,
      glRenderer: name,
      pictureFormat,
    });
    stats.gpuBytesPerSplat = stats.splatsResident ? attributes / stats.splatsResident : 0;
    stats.shDegree = Math.min(this.look.shDegree, opening?.header?.shDegree ?? 0);
    if (opening?.order.isWhole && stats.firstPictureMs === 0) stats.firstPictureMs = performance.now() - opening.begun;
    this.options.onFrame?.(stats);
  }

  /** @param {Event} event */
  contextLost(event) {
    event.preventDefault(); // otherwise the context would not be restored
    this.reportLoss();
  }

  reportLoss() {
    const message = 'the browser has lost the GPU; the picture returns when it is restored';
    this.options.onError?.({ code: E_CONTEXT, message, fatal: false });
  }

  /**
   * Report that the GPU cannot draw the scene, once.
   *
   * @param {string} code
   * @param {string} message
   */
  gpuFailed(code, message) {
    const { opening } = this;
    if (!opening || opening.hasFailedToDraw) return;
    opening.hasFailedToDraw = true;
    this.fail(new EngineError({ code, message: `the GPU cannot draw the scene: ${message}` }));
  }

  /**
   * @param {boolean} hasDrawn false if this GPU cannot draw at all
   * @param {import('./renderer.mjs').Losses} losses of the next GPU
   */
  gpuLost(hasDrawn, losses) {
    if (this.listeners.signal.aborted) return;
    if (!hasDrawn) {
      const message = 'WebGPU lost the GPU at once; the backend webgl2 may draw the scene';
      return this.fail(new EngineError({ code: E_CONTEXT, message }));
    }
    this.reportLoss();
    this.restore(this.options.backend, losses);
  }

  /**
   * Create another renderer, and read the scene again.
   *
   * @param {import('./types.d.ts').EngineOptions['backend']} backend
   * @param {import('./renderer.mjs').Losses} [losses] of a GPU of WebGPU
   */
  async restore(backend, losses = { lost() {}, failed() {} }) {
    const renderer = await createRenderer(this.canvas, { ...this.options, backend }, losses);
    if (renderer === null) return;
    if (this.listeners.signal.aborted) return renderer.dispose();
    this.renderer = renderer;
    const { opening } = this;
    if (opening && !opening.error) this.begin(opening.source, opening.settle);
    this.requestFrame();
  }
}

/**
 * Encode a picture.
 *
 * @param {Uint8Array<ArrayBuffer>} pixels RGBA, premultiplied, changed in place
 * @param {{width: number, height: number}} size
 * @param {string} type of the image
 * @param {number} [quality] of an image with losses
 * @returns {Promise<Blob>}
 */
async function encodeImage(pixels, { width, height }, type, quality) {
  for (let at = 0; at < pixels.length; at += 4) {
    const alpha = pixels[at + 3];
    if (alpha === 255 || alpha === 0) continue;
    for (let c = at; c < at + 3; c++) pixels[c] = Math.min(255, Math.round((pixels[c] * 255) / alpha));
  }
  const canvas = Object.assign(document.createElement('canvas'), { width, height });
  const context = canvas.getContext('2d');
  const data = new ImageData(new Uint8ClampedArray(pixels.buffer), width, height);
  context?.putImageData(data, 0, 0);
  const blob = await new Promise((/** @type {(blob: Blob | null) => void} */ resolve) =>
    context ? canvas.toBlob(resolve, type, quality) : resolve(null),
  );
  if (!blob) throw new RangeError(`${width} × ${height} pixels, more than this browser can encode`);
  if (blob.type === type) return blob;
  throw new EngineError({ code: E_INPUT, message: `this browser cannot encode ${type}; image/png is always possible` });
}
