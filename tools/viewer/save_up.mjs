// Offers to save the up direction that the user chose: a rewritten file, or the command that writes one.

import { element } from './overlay.mjs';

/**
 * @typedef {import('./vectors.mjs').Vec3} Vec3
 * @typedef {object} Hooks
 * @property {(up: Vec3) => Promise<Uint8Array<ArrayBuffer>>} file gives the scene's file, saying what is up
 * @property {(text: string) => void} say something for a moment
 */

const DIGITS = 1e6; // a millionth of a radian
const AXES = ['x', 'y', 'z'];
const LINK_MS = 60000; // that the browser may take to begin to save

/**
 * A direction as files hold it.
 *
 * @param {Vec3} up of length 1
 * @returns {Vec3}
 */
export function rounded(up) {
  return /** @type {Vec3} */ (up.map((value) => Math.round(value * DIGITS) / DIGITS + 0)); // no −0
}

/**
 * A direction as `--up` takes it: `z`, `-y` or three numbers.
 *
 * @param {Vec3} up
 */
export function upWord(up) {
  const values = rounded(up);
  const k = values.findIndex((value) => Math.abs(value) === 1);
  return k < 0 ? values.join(',') : `${values[k] < 0 ? '-' : ''}${AXES[k]}`;
}

/**
 * The command that makes the file anew, saying what is up.
 *
 * @param {string} name of the file
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
   * @param {string} name of the file
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
      getSelection()?.selectAllChildren(code); // a page without HTTPS: the older way
      if (!document.execCommand('copy')) return this.hooks.say('Selected: the browser copies it by its own menu');
    }
    this.hooks.say('Copied');
  }

  async #download() {
    const button = element('keep-download', HTMLButtonElement);
    const { name, up } = this;
    button.disabled = true;
    try {
      const bytes = await this.hooks.file(up);
      const href = URL.createObjectURL(new Blob([bytes], { type: 'model/vnd.csplat' }));
      const link = Object.assign(document.createElement('a'), { href, download: name || 'scene.csplat' });
      link.click();
      setTimeout(() => URL.revokeObjectURL(href), LINK_MS);
    } catch (error) {
      this.hooks.say(`The file could not be written: ${error instanceof Error ? error.message : error}`);
    } finally {
      button.disabled = false;
    }
  }
}
