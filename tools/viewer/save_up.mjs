// SPDX-License-Identifier: Apache-2.0
// Offers to save the up direction that the user chose: as a rewritten file, or with a command.

import { element, saveFile } from './overlay.mjs';

/**
 * @typedef {import('./vectors.mjs').Vec3} Vec3
 * @typedef {object} Hooks
 * @property {(up: Vec3) => Promise<Uint8Array<ArrayBuffer>>} file returns the scene's file with this up direction
 * @property {(text: string) => void} say shows a message briefly
 */

const DIGITS = 1e6; // a precision of a millionth of a radian
const AXES = ['x', 'y', 'z'];

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
 * Return the command that encodes the file again with an up direction.
 *
 * @param {string} name name of the file
 * @param {Vec3} up
 */
export function saveUpCommand(name, up) {
  const stem = name.replace(/\.csplat$/i, '') || 'scene';
  const words = [`${stem}.ply`, `${stem}.csplat`].map((word) =>
    /^[\w.+-]+$/.test(word) ? word : `'${word.replaceAll("'", "'\\''")}'`,
  );
  return `csplat encode ${words.join(' ')} --up ${upWord(up)}`;
}

export class SaveUpOffer {
  /** @param {Hooks} hooks */
  constructor(hooks) {
    this.hooks = hooks;
    this.name = '';
    /** @type {Vec3} */
    this.up = [0, 0, 1];
    element('keep-copy', HTMLElement).addEventListener('click', () => void this.#copy());
    element('keep-download', HTMLElement).addEventListener('click', () => void this.#download());
    element('keep-close', HTMLElement).addEventListener('click', () => this.hide());
  }

  /**
   * @param {string} name name of the file
   * @param {Vec3} up
   */
  show(name, up) {
    this.name = name;
    this.up = rounded(up);
    element('keep-title', HTMLElement).textContent = `${upWord(up).replace('-', '−')} is up.`;
    element('keep-command', HTMLElement).textContent = saveUpCommand(name, up);
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

  async #download() {
    const button = element('keep-download', HTMLButtonElement);
    const { name, up } = this;
    button.disabled = true;
    try {
      saveFile(await this.hooks.file(up), name || 'scene.csplat', 'model/vnd.csplat');
    } catch (error) {
      this.hooks.say(`The file could not be written: ${error instanceof Error ? error.message : error}`);
    } finally {
      button.disabled = false;
    }
  }
}
