// SPDX-License-Identifier: Apache-2.0
// The overlay: progress, statistics, messages and drop target. Independent of scenes.

import { explain } from './messages.mjs';
import { loadedShare } from './statistics.mjs';

/**
 * @typedef {import('./types.d.ts').Progress} Progress
 * @typedef {import('./types.d.ts').Stats} Stats
 * @typedef {{open: (file: File) => void}} Hooks
 */

const TOAST_MS = 2600;
const STATISTICS_MS = 250; // interval between updates
const SAVING_MS = 60000; // time for the browser to start saving

/** @type {(value: number) => string} */
const count = (value) => Math.round(value).toLocaleString('en');

/** @type {(bytes: number) => string} MB = 10^6 bytes */
export const megabytes = (bytes) => (bytes < 1e7 ? (bytes / 1e6).toFixed(2) : (bytes / 1e6).toFixed(1));

/** @type {(ms: number) => string} */
export const milliseconds = (ms) => `${ms < 10 ? ms.toFixed(1) : count(ms)} ms`;

/**
 * @template {HTMLElement} T
 * @param {string} id
 * @param {new () => T} kind
 * @returns {T}
 */
export function element(id, kind) {
  const found = document.getElementById(id);
  if (!(found instanceof kind)) throw new Error(`the page has no ${id}`);
  return found;
}

/**
 * Let the browser save a file.
 *
 * @param {BlobPart} content
 * @param {string} name
 * @param {string} type media type
 */
export function saveFile(content, name, type) {
  const href = URL.createObjectURL(new Blob([content], { type }));
  Object.assign(document.createElement('a'), { href, download: name }).click();
  setTimeout(() => URL.revokeObjectURL(href), SAVING_MS);
}

/** @param {string} id */
const html = (id) => element(id, HTMLElement);

export class Overlay {
  /** @param {Hooks} hooks */
  constructor(hooks) {
    this.hooks = hooks;
    this.name = '';
    this.toastTimer = 0;
    this.updated = -Infinity;
    this.failed = false;
    this.isMoving = false;
    /** @type {Stats | null} */
    this.stats = null;
    this.licence = '';
    for (const id of ['choose', 'open', 'error-open']) html(id).addEventListener('click', () => this.chooseFile());
    html('error-close').addEventListener('click', () => this.hideError());
    html('details').addEventListener('click', () => this.toggleStatistics());
    html('help').addEventListener('click', () => this.toggleHelp());
    for (const id of ['help-close', 'help-upright', 'help-view', 'help-background', 'help-measure']) {
      html(id).addEventListener('click', () => this.toggleHelp());
    }
    const input = element('file', HTMLInputElement);
    input.addEventListener('change', () => {
      if (input.files?.[0]) hooks.open(input.files[0]);
      input.value = ''; // allows choosing the same file again
    });
    this.#acceptDrops();
  }

  chooseFile() {
    element('file', HTMLInputElement).click();
  }

  /** Ask for a file if the page was opened without a scene. */
  welcome() {
    html('welcome').hidden = false;
  }

  /**
   * Show that a scene is being opened.
   *
   * @param {string} name
   */
  begin(name) {
    this.name = name;
    this.licence = '';
    this.failed = false;
    html('point').hidden = true;
    this.hideError();
    html('welcome').hidden = true;
    this.describe(name);
    this.#bar(0);
    html('progress').hidden = false;
    html('summary').textContent = 'Opening …';
  }

  /**
   * @param {string} title
   * @param {string} [licence]
   */
  describe(title, licence = '') {
    this.licence = licence;
    html('info').hidden = !title;
    html('title').textContent = title;
    document.title = title ? `${title} – csplat viewer` : 'csplat viewer';
  }

  /**
   * Show a point of the scene, as `csplat extract --box` takes it.
   *
   * @param {readonly number[]} point
   */
  point(point) {
    html('point').textContent = `Point ${point.map((value) => Number(value.toPrecision(4))).join(',')}`;
    html('point').hidden = false;
  }

  /** @param {Progress} progress */
  progress(progress) {
    const { received, missing, splatsDone, splatCount, layer, phase } = progress;
    this.#bar(loadedShare(progress));
    const what = layer > 0 ? `colour detail ${layer} of 3` : `${count(splatsDone)} of ${count(splatCount)} splats`;
    html('summary').textContent =
      phase === 'open' ? 'Opening …' : `${what} · ${megabytes(received)} of ${megabytes(received + missing)} MB`;
  }

  /** Show that the scene is complete. */
  done() {
    html('progress').hidden = true;
    if (this.stats) this.#summary(this.stats);
    html('live').textContent = `${this.name} is loaded: ${html('summary').textContent}`;
  }

  /**
   * @param {Stats} stats
   * @param {boolean} isMoving whether frames are drawn continuously; otherwise there is no frame rate
   */
  statistics(stats, isMoving) {
    const now = performance.now();
    if (isMoving && this.isMoving && now - this.updated < STATISTICS_MS) return;
    this.stats = stats;
    this.isMoving = isMoving;
    this.updated = now;
    if (html('progress').hidden && !this.failed) this.#summary(stats);
    if (!html('statistics').hidden) this.#table(stats);
  }

  toggleStatistics() {
    const list = html('statistics');
    list.hidden = !list.hidden;
    html('details').setAttribute('aria-expanded', String(!list.hidden));
    if (this.stats && !list.hidden) this.#table(this.stats);
  }

  toggleHelp() {
    const dialog = element('help-dialog', HTMLDialogElement);
    if (dialog.open) return dialog.close();
    dialog.showModal();
    html('help-close').focus();
    dialog.scrollTop = 0; // on a small screen the focused button is at the end
  }

  /**
   * @param {import('./messages.mjs').Problem} problem
   * @param {boolean} scene whether the error belongs to a scene, not to the page
   */
  error(problem, scene = true) {
    this.failed = true;
    html('progress').hidden = true;
    html('welcome').hidden = true;
    html('summary').textContent = 'Not shown, or only in part';
    this.#explain(problem, false);
    html('error-open').hidden = !scene;
  }

  /**
   * Report an error that leaves the scene usable, beside the scene.
   *
   * @param {import('./messages.mjs').Problem} problem
   */
  warn(problem) {
    if (this.failed) return;
    this.#explain(problem, true);
    html('error-open').hidden = true;
  }

  /**
   * @param {import('./messages.mjs').Problem} problem
   * @param {boolean} isAside whether the card leaves the middle free
   */
  #explain(problem, isAside) {
    const { title, advice, facts } = explain(problem, this.name);
    html('error-title').textContent = title;
    html('error-advice').textContent = advice;
    html('error-facts').textContent = facts;
    const card = html('error');
    card.classList.toggle('aside', isAside);
    card.dataset.code = problem.code;
    card.hidden = false;
  }

  hideError() {
    html('error').hidden = true;
  }

  /**
   * Show a message briefly.
   *
   * @param {string} text
   */
  toast(text) {
    const toast = html('toast');
    toast.textContent = text;
    toast.hidden = false;
    clearTimeout(this.toastTimer);
    this.toastTimer = window.setTimeout(() => (toast.hidden = true), TOAST_MS);
  }

  /** @param {Stats} stats */
  #summary({ splatCount, fileSize, fps }) {
    const rate = this.isMoving ? ` · ${Math.round(fps)} fps` : '';
    html('summary').textContent = `${count(splatCount)} splats · ${megabytes(fileSize)} MB${rate}`;
  }

  /** @param {Stats} stats */
  #table(stats) {
    const perSplat = stats.splatCount ? stats.fileSize / stats.splatCount : 0;
    const rows = [
      ['Splats drawn', `${count(stats.splatsDrawn)} of ${count(stats.splatCount)}`],
      ['File', `${megabytes(stats.fileSize)} MB, ${perSplat.toFixed(1)} B per splat`],
      ['Colour degree', String(stats.shDegree)],
      ['First picture', `${milliseconds(stats.firstPictureMs)}, ${megabytes(stats.firstPictureBytes)} MB`],
      ['Decoding', milliseconds(stats.decodeMs)],
      ['Sorting', `${milliseconds(stats.sortMs)}, culling ${milliseconds(stats.cullMs)}`],
      ['Frame', milliseconds(stats.frameMs) + (this.isMoving ? `, ${Math.round(stats.fps)} fps` : '')],
      ['Graphics memory', `${megabytes(stats.gpuBytes)} MB, ${stats.gpuBytesPerSplat.toFixed(1)} B per splat`],
      ['Renderer', stats.glRenderer],
      ...(this.licence ? [['Licence', this.licence]] : []),
    ];
    html('statistics').replaceChildren(
      ...rows.flatMap((row) =>
        row.map((text, i) => Object.assign(document.createElement(i ? 'dd' : 'dt'), { textContent: text })),
      ),
    );
  }

  /** @param {number} share */
  #bar(share) {
    html('progress-bar').style.transform = `scaleX(${share})`;
    html('progress').setAttribute('aria-valuenow', String(Math.round(100 * share)));
  }

  #acceptDrops() {
    const target = html('drop');
    const files = (/** @type {DragEvent} */ event) => event.dataTransfer?.types.includes('Files');
    addEventListener('dragover', (event) => {
      if (!files(event)) return;
      event.preventDefault();
      target.hidden = false;
    });
    addEventListener('dragleave', (event) => {
      if (event.relatedTarget === null) target.hidden = true;
    });
    addEventListener('drop', (event) => {
      event.preventDefault();
      target.hidden = true;
      const file = event.dataTransfer?.files[0];
      if (file) this.hooks.open(file);
    });
  }
}
