// SPDX-License-Identifier: Apache-2.0
// Offers to save the up direction or the first view that the user chose: as a rewritten file, or with a command.

import { element, saveFile } from './overlay.mjs';

/**
 * @typedef {import('./vectors.mjs').Vec3} Vec3
 * @typedef {import('./types.d.ts').FileCamera} FileCamera
 * @typedef {import('./types.d.ts').MetadataChanges} MetadataChanges
 * @typedef {object} Hooks
 * @property {(changes: MetadataChanges) => Promise<Uint8Array<ArrayBuffer>>} file returns the scene's file with these changes
 * @property {(text: string) => void} say shows a message briefly
 */

const DIGITS = 1e6; // a precision of a millionth of a radian
const AXES = ['x', 'y', 'z'];
const VIEW_DIGITS = 7; // significant ones of a camera's numbers
const VIEW_FILE = 'view.json'; // file of the camera in the command

/**
 * Round a direction as stored in files.
 *
 * @param {Vec3} up unit vector
 * @returns {Vec3}
 */
export function rounded(up) {
  return /** @type {Vec3} */ (up.map((value) => Math.round(value * DIGITS) / DIGITS + 0)); // no −0
}

/**
 * Format a direction for the option `--up`: `z`, `-y` or three numbers.
 *
 * @param {Vec3} up
 */
export function upWord(up) {
  const values = rounded(up);
  const k = values.findIndex((value) => Math.abs(value) === 1);
  return k < 0 ? values.join(',') : `${values[k] < 0 ? '-' : ''}${AXES[k]}`;
}

/**
 * Round the numbers of a camera as stored in files.
 *
 * @param {FileCamera} camera
 * @returns {FileCamera}
 */
export function roundedCamera(camera) {
  const round = (/** @type {number} */ value) => Number(value.toPrecision(VIEW_DIGITS)) + 0;
  const { K, viewmat, W, H, near } = camera;
  return {
    K: K.map((row) => row.map(round)),
    viewmat: viewmat.map((row) => row.map(round)),
    W,
    H,
    ...(near && { near: round(near) }),
  };
}

/**
 * Return the command that encodes the file again with an up direction, a first view, or both.
 *
 * @param {string} name name of the file
 * @param {MetadataChanges} changes
 */
export function saveCommand(name, { up, view }) {
  const stem = name.replace(/\.csplat$/i, '') || 'scene';
  const words = [`${stem}.ply`, `${stem}.csplat`].map((word) =>
    /^[\w.+-]+$/.test(word) ? word : `'${word.replaceAll("'", "'\\''")}'`,
  );
  return `csplat encode ${words.join(' ')}${view ? ` --cameras ${VIEW_FILE}` : ''}${up ? ` --up ${upWord(up)}` : ''}`;
}

export class SaveOffer {
  /** @param {Hooks} hooks */
  constructor(hooks) {
    this.hooks = hooks;
    this.name = '';
    /** @type {MetadataChanges} */
    this.changes = {};
    element('keep-copy', HTMLElement).addEventListener('click', () => void this.#copy());
    element('keep-camera', HTMLElement).addEventListener('click', () => this.#saveCamera());
    element('keep-download', HTMLElement).addEventListener('click', () => void this.#download());
    element('keep-close', HTMLElement).addEventListener('click', () => this.hide());
  }

  /**
   * @param {string} name name of the file
   * @param {MetadataChanges} changes
   */
  show(name, { up, view }) {
    this.name = name || 'scene.csplat';
    this.changes = { ...(up && { up: rounded(up) }), ...(view && { view: roundedCamera(view) }) };
    const isUp = up ? `${upWord(up).replace('-', '−')} is up.` : '';
    element('keep-title', HTMLElement).textContent = view ? `The first view is this one. ${isUp}`.trim() : isUp;
    element('keep-name', HTMLElement).textContent = this.name;
    element('keep-command', HTMLElement).textContent = saveCommand(this.name, this.changes);
    element('keep-camera', HTMLElement).hidden = !view;
    element('keep', HTMLElement).hidden = false;
  }

  hide() {
    element('keep', HTMLElement).hidden = true;
  }

  async #copy() {
    const code = element('keep-command', HTMLElement);
    try {
      await navigator.clipboard.writeText(code.textContent ?? '');
    } catch {
      getSelection()?.selectAllChildren(code); // without HTTPS, select the text instead
      if (!document.execCommand('copy')) return this.hooks.say('Selected: the browser copies it by its own menu');
    }
    this.hooks.say('Copied');
  }

  /** Save the camera for `--cameras`. */
  #saveCamera() {
    saveFile(JSON.stringify([this.changes.view]), VIEW_FILE, 'application/json');
  }

  async #download() {
    const button = element('keep-download', HTMLButtonElement);
    const { name, changes } = this;
    button.disabled = true;
    try {
      saveFile(await this.hooks.file(changes), name, 'model/vnd.csplat');
    } catch (error) {
      this.hooks.say(`The file could not be written: ${error instanceof Error ? error.message : error}`);
    } finally {
      button.disabled = false;
    }
  }
}
