// <csplat-view src="scene.csplat" alt="A garden">: a scene in a page, used like an image and sized by CSS.
//
// Attributes: src, alt, and these parameters of main.mjs: camera, view, up, axes, background.
// Events: progress, load (detail: the engine's Stats), error (detail: ErrorReport). Property `engine`: null until it loads.

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

export class CsplatView extends HTMLElement {
  static observedAttributes = ['src', 'alt', 'aria-label', ...WISHES];

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

  constructor() {
    super();
    this.#progress.hidden = true;
    this.#error.hidden = true;
    this.#root.adoptedStyleSheets = [sharedSheet()];
    this.#root.append(this.#canvas, this.#progress, this.#error);
    this.#renewCanvas();
  }

  /** Address of the scene. */
  get src() {
    return this.getAttribute('src') ?? '';
  }

  set src(address) {
    this.setAttribute('src', address);
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
    if (before === after) return;
    if (name === 'alt' || name === 'aria-label') this.#label();
    else if (name === 'background' && this.#showing) this.#showing.setBackground(this.#wishes().background);
    else this.#renew();
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
    const { src } = this;
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
    );
    this.#showing = showing;
    this.#bar.style.transform = 'scaleX(0)';
    this.#progress.hidden = false;
    if (!(await showing.start())) return;
    const complaint = await showing.readCameras();
    if (complaint) console.warn(`csplat-view: ${complaint}`);
    await showing.show(src);
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
    const { title, advice, facts } = explain(report, nameOf(this.src));
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

if (!customElements.get('csplat-view')) customElements.define('csplat-view', CsplatView);
