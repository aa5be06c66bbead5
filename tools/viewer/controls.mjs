// SPDX-License-Identifier: Apache-2.0
// Mouse, touch and keyboard input on the canvas, converted to camera movements.

import { between } from './orbit_camera.mjs';

/**
 * @typedef {import('./orbit_camera.mjs').Pose} Pose
 * @typedef {import('./orbit_camera.mjs').OrbitCamera} OrbitCamera
 *
 * @typedef {object} Hooks
 * @property {() => void} moved called when the rig's pose has changed
 * @property {(x: number, y: number) => Pose | null} pivotAt returns a pose that orbits the point of the scene at a point of
 *   the canvas, in CSS pixels; null if there is none
 * @property {() => boolean} calm whether the user prefers no animations
 *
 * @typedef {object} Reach
 * @property {EventTarget} keys target of key events: the whole page, or only the canvas
 * @property {() => boolean} wheel whether the wheel zooms the scene instead of scrolling the page
 */

const ORBIT = Math.PI; // radians per shorter side of the canvas
const WHEEL = 0.0015; // natural logarithm of the distance, per scrolled pixel
const PINCH_WHEEL = 0.01; // same, for a pinch on a trackpad
const LINE = 16; // pixels per scrolled line
const KEY_TURN = 1.2; // radians per second
const KEY_ZOOM = 1.4; // natural logarithm of the distance per second
const FASTER = 4; // speed factor with Shift
const GLIDE_MS = 450;
const FOLLOW_MS = 45; // time to follow a drag to two thirds
const TAP_MS = 320; // maximum time between two taps
const TAP_PIXELS = 24; // maximum distance between two taps
const STILL_PIXELS = 6; // maximum movement during a tap

/** Keys that fly: right, down, forward. */
const FLY = /** @type {Record<string, [number, number, number]>} */ ({
  KeyW: [0, 0, 1],
  ArrowUp: [0, 0, 1],
  KeyS: [0, 0, -1],
  ArrowDown: [0, 0, -1],
  KeyA: [-1, 0, 0],
  ArrowLeft: [-1, 0, 0],
  KeyD: [1, 0, 0],
  ArrowRight: [1, 0, 0],
  KeyQ: [0, 1, 0],
  KeyE: [0, -1, 0],
});

/** Keys that orbit the pivot (arrows with Shift): right, down. */
const TURN = /** @type {Record<string, [number, number]>} */ ({
  ArrowLeft: [-1, 0],
  ArrowRight: [1, 0],
  ArrowUp: [0, -1],
  ArrowDown: [0, 1],
});

const ZOOM = /** @type {Record<string, number>} */ ({ Equal: -1, NumpadAdd: -1, Minus: 1, NumpadSubtract: 1 });

export class Controls {
  /**
   * @param {HTMLElement} canvas
   * @param {OrbitCamera} rig
   * @param {Hooks} hooks
   * @param {Reach} [reach] default: the whole page
   */
  constructor(canvas, rig, hooks, reach = { keys: window, wheel: () => true }) {
    this.canvas = canvas;
    this.rig = rig;
    this.hooks = hooks;
    this.reach = reach;
    this.listeners = new AbortController();
    /** Whether the user has moved the camera since it was placed. */
    this.touched = false;
    /** @type {Map<number, {x: number, y: number}>} */
    this.pointers = new Map();
    /** @type {Set<string>} */
    this.keys = new Set();
    this.shift = false;
    this.pending = { right: 0, down: 0 };
    /** @type {{from: Pose, to: Pose, start: number} | null} */
    this.gliding = null;
    this.tap = { time: -Infinity, x: 0, y: 0 };
    this.press = { x: 0, y: 0, still: false, pans: false };
    this.before = { pose: rig.pose, touched: false }; // state before the current touch
    this.frame = 0;
    this.last = 0;
    this.#listen();
  }

  /**
   * Move the camera to a pose; immediately if animations are off.
   *
   * @param {Pose} pose
   * @param {boolean} [atOnce]
   */
  glide(pose, atOnce = false) {
    this.pending = { right: 0, down: 0 };
    if (atOnce || this.hooks.calm()) {
      this.gliding = null;
      this.rig.pose = pose;
      this.hooks.moved();
      return;
    }
    this.gliding = { from: this.rig.pose, to: pose, start: performance.now() };
    this.#wake();
  }

  /** Remove all listeners from the canvas and the page. */
  close() {
    this.listeners.abort();
    cancelAnimationFrame(this.frame);
  }

  #listen() {
    const { canvas, reach } = this;
    const { signal } = this.listeners;
    canvas.addEventListener('pointerdown', (event) => this.#down(event), { signal });
    canvas.addEventListener('pointermove', (event) => this.#move(event), { signal });
    for (const end of ['pointerup', 'pointercancel', 'lostpointercapture']) {
      canvas.addEventListener(end, (event) => this.#up(/** @type {PointerEvent} */ (event)), { signal });
    }
    canvas.addEventListener('wheel', (event) => this.#wheel(event), { signal, passive: false });
    canvas.addEventListener('dblclick', ({ offsetX, offsetY }) => this.#choosePivot(offsetX, offsetY), { signal });
    canvas.addEventListener('contextmenu', (event) => this.#isOff || event.preventDefault(), { signal });
    reach.keys.addEventListener('keydown', (event) => this.#key(/** @type {KeyboardEvent} */ (event)), { signal });
    reach.keys.addEventListener('blur', () => this.keys.clear(), { signal });
    const released = (/** @type {KeyboardEvent} */ { code, shiftKey }) => {
      this.shift = shiftKey;
      this.keys.delete(code);
    };
    addEventListener('keyup', released, { signal });
  }

  /** Whether users may only orbit the pivot. */
  get #isBound() {
    return this.rig.limits.kind === 'orbit';
  }

  get #isOff() {
    return this.rig.limits.kind === 'none';
  }

  /** @param {PointerEvent} event */
  #down(event) {
    if (this.#isOff) return;
    const { offsetX: x, offsetY: y, button, shiftKey, ctrlKey, metaKey } = event;
    this.canvas.focus({ preventScroll: true });
    this.canvas.setPointerCapture(event.pointerId);
    if (this.pointers.size === 0) this.before = { pose: this.rig.pose, touched: this.touched };
    this.pointers.set(event.pointerId, { x, y });
    const pans = !this.#isBound && (button !== 0 || shiftKey || ctrlKey || metaKey);
    this.press = { x, y, still: this.pointers.size === 1, pans };
    this.gliding = null;
  }

  /** @param {PointerEvent} event */
  #move(event) {
    const before = this.pointers.get(event.pointerId);
    if (!before) return;
    const now = { x: event.offsetX, y: event.offsetY };
    if (Math.hypot(now.x - this.press.x, now.y - this.press.y) > STILL_PIXELS) this.press.still = false;
    const { clientWidth: width, clientHeight: height } = this.canvas;
    const other = [...this.pointers].find(([id]) => id !== event.pointerId)?.[1];
    this.pointers.set(event.pointerId, now);
    if (other) {
      const centre = { x: (now.x + other.x) / 2, y: (now.y + other.y) / 2 };
      const apart = Math.hypot(now.x - other.x, now.y - other.y);
      const wasApart = Math.hypot(before.x - other.x, before.y - other.y);
      if (!this.#isBound) this.rig.pan((now.x - before.x) / 2, (now.y - before.y) / 2, width, height);
      if (apart > 1 && wasApart > 1) this.#zoom(wasApart / apart, centre);
      this.#changed();
    } else if (this.press.pans) {
      this.rig.pan(now.x - before.x, now.y - before.y, width, height);
      this.#changed();
    } else {
      const perPixel = ORBIT / Math.max(1, Math.min(width, height));
      this.#turn((now.x - before.x) * perPixel, (now.y - before.y) * perPixel);
    }
  }

  /** @param {PointerEvent} event */
  #up(event) {
    if (!this.pointers.delete(event.pointerId)) return;
    if (event.type === 'pointercancel') this.#takeBack();
    if (event.type !== 'pointerup' || event.pointerType === 'mouse' || !this.press.still) return;
    const { offsetX: x, offsetY: y, timeStamp } = event; // browsers differ on whether two taps make a double click
    const near = Math.hypot(x - this.tap.x, y - this.tap.y) < TAP_PIXELS;
    if (near && timeStamp - this.tap.time < TAP_MS) this.#choosePivot(x, y);
    this.tap = { time: timeStamp, x, y };
  }

  /** Undo a drag that the browser took over to scroll the page. */
  #takeBack() {
    this.pending = { right: 0, down: 0 };
    this.rig.pose = this.before.pose;
    this.touched = this.before.touched;
    this.hooks.moved();
  }

  /** @param {WheelEvent} event */
  #wheel(event) {
    if (this.#isOff || !this.reach.wheel()) return;
    event.preventDefault();
    const pixels = event.deltaY * (event.deltaMode === 1 ? LINE : event.deltaMode === 2 ? this.canvas.clientHeight : 1);
    const step = Math.min(0.7, Math.max(-0.7, pixels * (event.ctrlKey ? PINCH_WHEEL : WHEEL)));
    this.gliding = null;
    this.#zoom(Math.exp(step), { x: event.offsetX, y: event.offsetY });
    this.#changed();
  }

  /**
   * @param {number} factor
   * @param {{x: number, y: number}} at pointer on the canvas
   */
  #zoom(factor, at) {
    const { clientWidth: width, clientHeight: height } = this.canvas;
    this.rig.zoom(factor, this.#isBound ? undefined : { ...at, width, height });
  }

  /**
   * @param {number} x
   * @param {number} y
   */
  #choosePivot(x, y) {
    const pose = this.rig.limits.kind === 'free' && this.hooks.pivotAt(x, y);
    if (!pose) return;
    this.touched = true;
    this.glide(pose);
  }

  /** @param {KeyboardEvent} event */
  #key(event) {
    const { code, target, ctrlKey, metaKey, altKey, shiftKey } = event;
    this.shift = shiftKey;
    const elsewhere = target instanceof Element && target.closest('input, select, textarea, dialog');
    const isKnown = code in ZOOM || code in (this.#isBound ? TURN : FLY);
    if (ctrlKey || metaKey || altKey || elsewhere || this.#isOff || !isKnown) return;
    event.preventDefault();
    this.keys.add(code);
    this.gliding = null;
    this.#wake();
  }

  /**
   * @param {number} right radians
   * @param {number} down radians
   */
  #turn(right, down) {
    this.touched = true;
    this.pending = { right: this.pending.right + right, down: this.pending.down + down };
    this.#wake();
  }

  #changed() {
    this.touched = true;
    this.hooks.moved();
  }

  #wake() {
    if (this.frame) return;
    this.last = performance.now();
    this.frame = requestAnimationFrame((now) => this.#tick(now));
  }

  /** @param {number} now */
  #tick(now) {
    this.frame = 0;
    const seconds = Math.min(0.1, Math.max(0, now - this.last) / 1000 || 1 / 60);
    let busy = this.#glideOn(now);
    busy = this.#follow(seconds) || busy;
    busy = this.#walk(seconds) || busy;
    this.hooks.moved();
    this.last = now;
    if (busy) this.frame = requestAnimationFrame((next) => this.#tick(next));
  }

  /** @param {number} now */
  #glideOn(now) {
    if (!this.gliding) return false;
    const { from, to, start } = this.gliding;
    const t = Math.min(1, Math.max(0, (now - start) / GLIDE_MS));
    this.rig.pose = between(from, to, t * t * (3 - 2 * t));
    if (t === 1) this.gliding = null;
    return t < 1;
  }

  /**
   * Follow a drag with slight smoothing.
   *
   * @param {number} seconds
   */
  #follow(seconds) {
    const { right, down } = this.pending;
    if (right === 0 && down === 0) return false;
    const left = this.hooks.calm() ? 0 : Math.exp((-1000 * seconds) / FOLLOW_MS);
    const done = Math.hypot(right, down) * left < 1e-4 ? 1 : 1 - left;
    this.rig.orbit(right * done, down * done);
    this.pending = done === 1 ? { right: 0, down: 0 } : { right: right * left, down: down * left };
    return done < 1;
  }

  /**
   * Fly, turn and zoom by the pressed keys.
   *
   * @param {number} seconds
   */
  #walk(seconds) {
    const { rig, shift } = this;
    for (const code of this.keys) {
      this.touched = true;
      if (code in ZOOM) rig.zoom(Math.exp(ZOOM[code] * KEY_ZOOM * seconds));
      else if ((shift || this.#isBound) && code in TURN) rig.orbit(...scaled(TURN[code], KEY_TURN * seconds));
      else rig.fly(scaled(FLY[code], rig.speed * seconds * (shift ? FASTER : 1)));
    }
    return this.keys.size > 0;
  }
}

/**
 * @template {number[]} T
 * @param {T} values
 * @param {number} factor
 * @returns {T}
 */
const scaled = (values, factor) => /** @type {T} */ (values.map((value) => value * factor));
