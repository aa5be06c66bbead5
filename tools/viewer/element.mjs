// SPDX-License-Identifier: Apache-2.0
// <csplat-view src="scene.csplat" alt="A garden">: a scene in a page, used like an image and sized by CSS.
//
// Attributes: src, alt, poster, crossorigin, and these parameters of main.mjs: camera, view, up, axes, background, controls,
// backend; all of them are properties, too. Properties alone: fetch, request, renew, retries, timeoutMs, as of the engine.
// Events: progress, firstpicture and load (detail: the engine's Stats), camerachange (detail: FileCamera), error (detail:
// ErrorReport). Property `engine`: null until it loads. Method: toBlob.

import { heldBlob } from './engine.mjs';
import { E_CONTEXT, E_INPUT, EngineError } from './engine_error.mjs';
import { explain } from './messages.mjs';
import { nameOf, readWishes } from './page.mjs';
import { loadedShare } from './statistics.mjs';
import { SceneViewer } from './viewer.mjs';

/**
 * @typedef {import('./types.d.ts').ErrorReport} ErrorReport
 * @typedef {import('./types.d.ts').Progress} Progress
 */

const WISHES = ['camera', 'view', 'up', 'axes', 'background', 'controls', 'backend'];
const REFLECTED = ['src', 'alt', 'poster', ...WISHES]; // properties of the same name
const FETCHING = /** @type {const} */ (['fetch', 'request', 'renew', 'retries', 'timeoutMs']);
const HOW = {
  free: 'Arrow keys fly, Shift and arrow keys turn around it, plus and minus zoom, R returns to the initial view, Escape leaves the scene.',
  orbit: 'Arrow keys turn it, plus and minus zoom, R returns to the initial view, Escape leaves the scene.',
  none: '',
};
const AHEAD = '50% 0px'; // distance from the window at which an element starts to load
const CAMERA_MS = 100; // time between two events of a moving camera
// The box gives the element its usual size: a CSS height replaces the shape, not the width.
const SHEET = `
:host { display: block; position: relative; overflow: hidden; background: #000; }
:host([background='transparent' i]) { background: none; }
:host([hidden]) { display: none; }
[hidden] { display: none !important; }
#box { aspect-ratio: 3 / 2; contain: inline-size; contain-intrinsic-inline-size: 300px; }
canvas, #poster { position: absolute; inset: 0; width: 100%; height: 100%; user-select: none; -webkit-user-select: none; }
#poster { object-fit: contain; pointer-events: none; }
canvas { outline: none; }
canvas[tabindex] { cursor: grab; touch-action: pan-y; }
canvas[tabindex]:active { cursor: grabbing; }
canvas[tabindex].active { touch-action: none; }
canvas.keys { outline: 2px solid #1f8fe0; outline-offset: -2px; }
#progress { position: absolute; inset: 0 0 auto; height: 3px; background: rgb(128 128 128 / 0.4); }
#bar { height: 100%; background: #7cc7ff; transform: scaleX(0); transform-origin: 0 0; }
#error { position: absolute; inset: 0; margin: auto; box-sizing: border-box; width: min(440px, calc(100% - 24px)); height: fit-content; max-height: calc(100% - 24px); overflow: auto; padding: 16px 18px; border-radius: 12px; background: Canvas; color: CanvasText; font: 14px/1.45 system-ui, sans-serif; text-align: start; }
#poster:not([hidden]) ~ #error { inset: auto 12px 12px; }
#error * { margin: 0; }
#error p { margin-top: 6px; opacity: 0.8; }
#error .facts { font: 12px/1.5 ui-monospace, Menlo, Consolas, monospace; overflow-wrap: anywhere; }
`;

/** @type {CSSStyleSheet | null} */
let sheet = null; // the page's policy could forbid a style element

/**
 * @template {keyof HTMLElementTagNameMap} K
 * @param {K} tag
 * @param {Record<string, string>} attributes
 * @param {(Node | string)[]} children
 */
function made(tag, attributes = {}, ...children) {
  const one = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) one.setAttribute(name, value);
  one.append(...children);
  return one;
}

function sharedSheet() {
  if (sheet === null) {
    sheet = new CSSStyleSheet();
    sheet.replaceSync(SHEET);
  }
  return sheet;
}

/** A page that is rendered on a server may import this module there, where no elements are. */
const Base = globalThis.HTMLElement ?? /** @type {typeof HTMLElement} */ (class {});

export class CsplatView extends Base {
  static observedAttributes = ['src', 'alt', 'aria-label', 'poster', 'crossorigin', ...WISHES];

  /** @type {SceneViewer | null} */
  #showing = null;
  #isNear = false;
  #isStale = false;
  #hasFailed = false;
  #root = this.attachShadow({ mode: 'open' });
  #canvas = made('canvas');
  #poster = made('img', { id: 'poster', part: 'poster', alt: '', loading: 'lazy' });
  #bar = made('div', { id: 'bar' });
  #progress = made('div', { id: 'progress', role: 'progressbar', 'aria-label': 'Loading the scene' }, this.#bar);
  #error = made('section', { id: 'error', role: 'alert' });
  #observer = new IntersectionObserver((seen) => this.#seen(seen[seen.length - 1].isIntersecting), {
    rootMargin: AHEAD,
  });
  #hasDrawn = false;
  #isPosterBroken = false;
  #cameraTimer = 0;
  /** Resolves when the scene is shown, or has failed. @type {Promise<unknown>} */
  #loading = Promise.resolve();
  /** Content of a blob: URL, fetched at once like an image's. @type {{src: string, blob: Promise<Blob>} | null} */
  #held = null;
  /** @type {import('./types.d.ts').FetchOptions} */
  #fetching = {};

  constructor() {
    super();
    this.#progress.hidden = true;
    this.#error.hidden = true;
    this.#root.adoptedStyleSheets = [sharedSheet()];
    this.#root.append(made('div', { id: 'box' }), this.#canvas, this.#poster, this.#progress, this.#error);
    this.#renewCanvas();
    this.#poster.addEventListener('error', () => {
      this.#isPosterBroken = true;
      this.#showPoster();
    });
    // Properties that were set before this script had run hide those of the class.
    for (const name of [...FETCHING, 'crossOrigin', ...REFLECTED]) {
      if (!Object.hasOwn(this, name)) continue;
      const own = /** @type {any} */ (this);
      const value = own[name];
      delete own[name];
      own[name] = value;
    }
    this.#label();
    this.#hold();
  }

  static {
    const define = (/** @type {string} */ name, /** @type {PropertyDescriptor & ThisType<CsplatView>} */ accessor) =>
      Object.defineProperty(this.prototype, name, { configurable: true, enumerable: true, ...accessor });
    for (const name of REFLECTED) {
      define(name, {
        get() {
          return name === 'camera' ? this.#camera : (this.getAttribute(name) ?? '');
        },
        set(value) {
          reflect(this, name, value);
        },
      });
    }
    // Options of requests; a scene uses those that are set when it is loaded.
    for (const name of FETCHING) {
      define(name, {
        get() {
          return this.#fetching[name];
        },
        set(value) {
          this.#fetching = { ...this.#fetching, [name]: value ?? undefined };
        },
      });
    }
  }

  /** @returns {'anonymous' | 'use-credentials' | null} */
  get crossOrigin() {
    const value = this.getAttribute('crossorigin');
    if (value === null) return null;
    return value.toLowerCase() === 'use-credentials' ? 'use-credentials' : 'anonymous';
  }

  set crossOrigin(value) {
    reflect(this, 'crossorigin', value);
  }

  /** The engine; null before the element loads and after it has left the page. */
  get engine() {
    return this.#showing?.engine ?? null;
  }

  get #camera() {
    return this.#showing?.camera ?? null;
  }

  /**
   * Make an image of the scene, see `CsplatViewElement`.
   *
   * @param {import('./types.d.ts').PictureOptions<import('./types.d.ts').FileCamera>} [options]
   * @returns {Promise<Blob>}
   */
  async toBlob(options) {
    await this.#loading;
    if (this.#showing) return this.#showing.toBlob(options);
    throw new EngineError({ code: E_INPUT, message: 'no picture can be made: the element has not loaded a scene' });
  }

  /** @param {FocusOptions} [options] */
  focus(options) {
    this.#canvas.focus(options);
  }

  connectedCallback() {
    this.#observer.observe(this);
  }

  disconnectedCallback() {
    queueMicrotask(() => {
      if (this.isConnected) return; // it was moved within the page
      this.#observer.disconnect();
      this.#isNear = false;
      this.#stop();
    });
  }

  /**
   * @param {string} name
   * @param {string | null} before
   * @param {string | null} after
   */
  attributeChangedCallback(name, before, after) {
    if (name === 'src') this.#hold();
    // The same address again is another try, as of an image.
    if (before === after && !(name === 'src' && this.#hasFailed)) return;
    if (name === 'alt' || name === 'aria-label') this.#label();
    else if (name === 'poster') this.#setPoster();
    else if (!this.#showing || this.#isStale || !this.#adapt(name, this.#showing)) this.#renew();
  }

  /**
   * Adapt the scene that is shown to an attribute.
   *
   * @param {string} name
   * @param {SceneViewer} showing
   * @returns {boolean} false if that is impossible: it has to be loaded again
   */
  #adapt(name, showing) {
    const wishes = this.#wishes(name === 'view' ? ['camera', 'view'] : [name, 'view']);
    if (name === 'background') return showing.setBackground(wishes.background);
    if (name === 'controls') {
      showing.rig.limits = wishes.limits;
      this.#label();
      return true;
    }
    if (name !== 'camera' && name !== 'view') return false;
    void showing.useCameras(wishes).then((complaint) => {
      complain(complaint);
      if (!complaint) this.#forgetMove();
    });
    return true;
  }

  /** Leave out the event of a movement that is over. */
  #forgetMove() {
    clearTimeout(this.#cameraTimer);
    this.#cameraTimer = 0;
  }

  #setPoster() {
    this.#isPosterBroken = false;
    const address = this.getAttribute('poster');
    if (address) this.#poster.src = address;
    this.#showPoster();
  }

  /** Show the poster until there is a picture of the scene. */
  #showPoster() {
    this.#poster.hidden = this.#hasDrawn || this.#isPosterBroken || !this.getAttribute('poster');
    this.#label();
  }

  /** Fetch the content of a blob: URL at once, before the page revokes it. */
  #hold() {
    const src = this.getAttribute('src') ?? '';
    if (!src.startsWith('blob:')) this.#held = null;
    else if (this.#held?.src !== src) {
      const blob = heldBlob(src, this.#fetching.fetch);
      blob.catch(() => {}); // the engine tries again, and reports it
      this.#held = { src, blob };
    }
  }

  /** Load again, once for attributes that change together. */
  #renew() {
    if (this.#isStale) return;
    this.#isStale = true;
    queueMicrotask(() => {
      this.#isStale = false;
      this.#stop();
      if (this.#isNear) this.#loading = this.#start();
    });
  }

  /** @param {boolean} isNear whether the element is near the window */
  #seen(isNear) {
    this.#isNear = isNear;
    if (isNear && !this.#showing && !this.#isStale) this.#loading = this.#start();
  }

  async #start() {
    const src = this.getAttribute('src') ?? '';
    if (!src) return;
    const canvas = this.#canvas;
    /** @type {SceneViewer} */
    const showing = new SceneViewer(
      canvas,
      this.#wishes(),
      {
        calm: () => matchMedia('(prefers-reduced-motion: reduce)').matches,
        moved: () => {
          this.#cameraTimer ||= window.setTimeout(() => {
            this.#cameraTimer = 0;
            if (this.#camera) this.#tell('camerachange', this.#camera);
          }, CAMERA_MS);
        },
        progress: (progress) => this.#progressed(progress),
        frame: (stats) => {
          if (!this.#hasFailed && !canvas.getContext('webgl2')?.isContextLost()) this.#error.hidden = true;
          if (this.#hasDrawn || stats.firstPictureMs === 0) return;
          this.#hasDrawn = true;
          this.#showPoster();
          this.#tell('firstpicture', { ...stats });
        },
        shown: (stats) => {
          this.#progress.hidden = true;
          this.#tell('load', { ...stats });
        },
        failed: (report) => this.#failed(report),
      },
      { keys: canvas, wheel: () => canvas.classList.contains('active') },
      this.#requests(),
    );
    this.#showing = showing;
    this.#bar.style.transform = 'scaleX(0)';
    this.#progress.hidden = false;
    if (!(await showing.start())) return;
    complain(await showing.readCameras());
    const held = this.#held;
    const source = held?.src === src ? await held.blob.catch(() => src) : src;
    if (this.#showing === showing) await showing.show(source);
  }

  /** The options of requests, with the credentials of `crossorigin`. */
  #requests() {
    const { request, ...others } = this.#fetching;
    const { crossOrigin } = this;
    /** @type {RequestCredentials} */
    const credentials = crossOrigin === 'use-credentials' ? 'include' : 'same-origin';
    return { ...others, request: { ...(crossOrigin !== null && { credentials }), ...request } };
  }

  /** Free everything. The next scene gets a new canvas, context and worker, so that nothing is left over. */
  #stop() {
    if (!this.#showing) return;
    this.#showing.close();
    this.#showing = null;
    this.#hasDrawn = false;
    this.#forgetMove();
    this.#hasFailed = false;
    this.#progress.hidden = true;
    this.#error.hidden = true;
    this.#error.replaceChildren();
    this.#renewCanvas();
  }

  #renewCanvas() {
    const canvas = made('canvas', { 'aria-roledescription': '3D scene' });
    const { classList } = canvas;
    canvas.addEventListener('click', () => canvas.matches(':hover') && classList.add('active'));
    canvas.addEventListener('pointerdown', () => classList.remove('keys'));
    canvas.addEventListener('pointerleave', ({ pointerType }) => pointerType === 'mouse' && classList.remove('active'));
    canvas.addEventListener('blur', () => classList.remove('active', 'keys'));
    canvas.addEventListener('keyup', () => classList.add('active', 'keys'));
    canvas.addEventListener('keydown', (event) => this.#key(event));
    const hadFocus = this.#root.activeElement === this.#canvas;
    this.#canvas.replaceWith(canvas);
    this.#canvas = canvas;
    this.#showPoster();
    if (hadFocus) canvas.focus({ preventScroll: true });
  }

  /** @param {KeyboardEvent} event */
  #key({ code, ctrlKey, metaKey, altKey }) {
    if (ctrlKey || metaKey || altKey) return;
    if (code === 'Escape') this.#canvas.blur();
    else if (code === 'KeyR') this.#showing?.view.goHome();
    else if (code === 'BracketLeft') this.#showing?.view.otherCamera(-1);
    else if (code === 'BracketRight') this.#showing?.view.otherCamera(1);
  }

  #label() {
    const what = this.getAttribute('alt') || this.getAttribute('aria-label') || '3D scene';
    const controls = this.getAttribute('controls') ?? '';
    const how = HOW[readWishes(new URLSearchParams({ controls })).wishes.limits.kind];
    const canvas = this.#canvas;
    canvas.setAttribute('aria-label', how ? `${what.replace(/\.?$/, '.')} ${how}` : what);
    canvas.setAttribute('role', how ? 'application' : 'img');
    if (how) canvas.tabIndex = 0;
    else canvas.removeAttribute('tabindex');
    canvas.hidden = this.#hasFailed && !this.#poster.hidden; // then the poster stands for the scene
    this.#poster.alt = canvas.hidden ? what : '';
  }

  /** @param {string[]} names of the attributes that are read */
  #wishes(names = WISHES) {
    const given = names.map((name) => [name, this.getAttribute(name) ?? '']).filter(([, value]) => value !== '');
    const { wishes, complaints } = readWishes(new URLSearchParams(given));
    complaints.forEach(complain);
    return wishes;
  }

  /** @param {Progress} progress */
  #progressed(progress) {
    const share = loadedShare(progress);
    this.#bar.style.transform = `scaleX(${share})`;
    this.#progress.setAttribute('aria-valuenow', String(Math.round(100 * share)));
    this.#tell('progress', progress);
  }

  /** @param {ErrorReport} report */
  #failed(report) {
    // Browsers take contexts away from pages with many. An element out of view loads again when it comes near.
    if (report.code === E_CONTEXT && !this.#isNear) return this.#stop();
    // The scene stays usable: the connection is tried again, and damaged parts are drawn coarsely.
    if (report.code !== E_CONTEXT && !report.fatal) return this.#tell('error', report);
    this.#hasFailed = report.fatal;
    this.#label();
    this.#progress.hidden = true;
    const { title, advice, facts } = explain(report, nameOf(this.getAttribute('src') ?? ''));
    const paragraphs = [made('strong', {}, title), made('p', {}, advice), made('p', { class: 'facts' }, facts)];
    this.#error.replaceChildren(...paragraphs);
    this.#error.dataset.code = report.code;
    this.#error.hidden = false;
    this.#tell('error', report);
  }

  /**
   * @param {string} type
   * @param {unknown} detail
   */
  #tell(type, detail) {
    this.dispatchEvent(new CustomEvent(type, { detail }));
  }
}

/** @param {string} text '' for nothing */
function complain(text) {
  if (text) console.warn(`csplat-view: ${text}`);
}

/**
 * Set an attribute to the value of a property.
 *
 * @param {Element} element
 * @param {string} name
 * @param {unknown} value null or undefined to remove it; a camera may be an object
 */
function reflect(element, name, value) {
  if (value === null || value === undefined) element.removeAttribute(name);
  else {
    const isJson = name === 'camera' && typeof value === 'object' && !(value instanceof URL);
    element.setAttribute(name, isJson ? JSON.stringify(value) : String(value));
  }
}

const registry = globalThis.customElements;
if (registry && !registry.get('csplat-view')) registry.define('csplat-view', CsplatView);
