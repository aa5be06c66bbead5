// SPDX-License-Identifier: Apache-2.0
// <csplat-view src="scene.csplat" alt="A garden">: a scene in a page, used like an image and sized by CSS.
//
// Attributes: src, alt, crossorigin, and these parameters of main.mjs: camera, view, up, axes, background, backend; all of them
// are properties, too. Properties alone: fetch, request, renew, retries, timeoutMs, as of the engine.
// Events: progress, load (detail: the engine's Stats), error (detail: ErrorReport). Property `engine`: null until it loads.

import { heldBlob } from './engine.mjs';
import { E_CONTEXT } from './engine_error.mjs';
import { explain } from './messages.mjs';
import { nameOf, readWishes } from './page.mjs';
import { loadedShare } from './statistics.mjs';
import { SceneViewer } from './viewer.mjs';

/**
 * @typedef {import('./types.d.ts').ErrorReport} ErrorReport
 * @typedef {import('./types.d.ts').Progress} Progress
 */

const WISHES = ['camera', 'view', 'up', 'axes', 'background', 'backend'];
const REFLECTED = ['src', 'alt', ...WISHES]; // properties of the same name
const FETCHING = /** @type {const} */ (['fetch', 'request', 'renew', 'retries', 'timeoutMs']);
const HOW =
  'Arrow keys fly, Shift and arrow keys turn around it, plus and minus zoom, R returns to the initial view, Escape leaves the scene.';
const AHEAD = '50% 0px'; // distance from the window at which an element starts to load
const SHEET = `
:host { display: block; position: relative; aspect-ratio: 3 / 2; overflow: hidden; background: #000; }
:host([hidden]) { display: none; }
[hidden] { display: none !important; }
canvas { position: absolute; inset: 0; width: 100%; height: 100%; cursor: grab; outline: none; user-select: none; -webkit-user-select: none; touch-action: pan-y; }
canvas:active { cursor: grabbing; }
canvas.active { touch-action: none; }
canvas.keys { outline: 2px solid #1f8fe0; outline-offset: -2px; }
#progress { position: absolute; inset: 0 0 auto; height: 3px; background: rgb(128 128 128 / 0.4); }
#bar { height: 100%; background: #7cc7ff; transform: scaleX(0); transform-origin: 0 0; }
#error { position: absolute; inset: 0; margin: auto; box-sizing: border-box; width: min(440px, calc(100% - 24px)); height: fit-content; max-height: calc(100% - 24px); overflow: auto; padding: 16px 18px; border-radius: 12px; background: Canvas; color: CanvasText; font: 14px/1.45 system-ui, sans-serif; text-align: start; }
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
  static observedAttributes = ['src', 'alt', 'aria-label', 'crossorigin', ...WISHES];

  /** @type {SceneViewer | null} */
  #showing = null;
  #isNear = false;
  #isStale = false;
  #hasFailed = false;
  #root = this.attachShadow({ mode: 'open' });
  #canvas = made('canvas');
  #bar = made('div', { id: 'bar' });
  #progress = made('div', { id: 'progress', role: 'progressbar', 'aria-label': 'Loading the scene' }, this.#bar);
  #error = made('section', { id: 'error', role: 'alert' });
  #observer = new IntersectionObserver((seen) => this.#seen(seen[seen.length - 1].isIntersecting), {
    rootMargin: AHEAD,
  });
  /** Content of a blob: URL, fetched at once like an image's. @type {{src: string, blob: Promise<Blob>} | null} */
  #held = null;
  /** @type {import('./types.d.ts').FetchOptions} */
  #fetching = {};

  constructor() {
    super();
    this.#progress.hidden = true;
    this.#error.hidden = true;
    this.#root.adoptedStyleSheets = [sharedSheet()];
    this.#root.append(this.#canvas, this.#progress, this.#error);
    this.#renewCanvas();
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
          return this.getAttribute(name) ?? '';
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
    else if (name === 'background' && this.#showing) this.#showing.setBackground(this.#wishes().background);
    else this.#renew();
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
      if (this.#isNear) void this.#start();
    });
  }

  /** @param {boolean} isNear whether the element is near the window */
  #seen(isNear) {
    this.#isNear = isNear;
    if (isNear && !this.#showing && !this.#isStale) void this.#start();
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
        progress: (progress) => this.#progressed(progress),
        frame: () => {
          if (!this.#hasFailed && !canvas.getContext('webgl2')?.isContextLost()) this.#error.hidden = true;
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
    const complaint = await showing.readCameras();
    if (complaint) console.warn(`csplat-view: ${complaint}`);
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
    this.#hasFailed = false;
    this.#progress.hidden = true;
    this.#error.hidden = true;
    this.#error.replaceChildren();
    this.#renewCanvas();
  }

  #renewCanvas() {
    const canvas = made('canvas', { tabindex: '0', role: 'application', 'aria-roledescription': '3D scene' });
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
    this.#label();
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
    this.#canvas.setAttribute('aria-label', `${what.replace(/\.?$/, '.')} ${HOW}`);
  }

  #wishes() {
    const given = WISHES.map((name) => [name, this.getAttribute(name) ?? '']).filter(([, value]) => value !== '');
    const { wishes, complaints } = readWishes(new URLSearchParams(given));
    for (const complaint of complaints) console.warn(`csplat-view: ${complaint}`);
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
