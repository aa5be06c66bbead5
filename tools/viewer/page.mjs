// SPDX-License-Identifier: Apache-2.0
// The parameters in the page's address, and the scene embedded in an exported page.

import { ownCameras } from './camera_forms.mjs';
import { unitDirection } from './vectors.mjs';

/**
 * @typedef {object} Wishes
 * @property {string | null} scene address of a .csplat file
 * @property {string | null} camera a camera, a list of cameras, or the address of a file with one or the other
 * @property {number} view index of the camera in the list
 * @property {import('./vectors.mjs').Vec3 | null} up up direction, a unit vector; overrides the file's
 * @property {import('./vectors.mjs').Vec3 | null} seems up direction if nothing else specifies it
 * @property {string | null} axes directions of +x, +y, +z; override the file's
 * @property {{width: number, height: number} | null} size size of the drawing buffer, pixels
 * @property {[number, number, number] | null} background 0 to 1; overrides the file's
 * @property {boolean} ui false to show only the scene
 * @property {import('./types.d.ts').Backend} backend what draws
 *
 * The data that `csplat export-html` embeds in the page.
 * @typedef {object} Embedded
 * @property {string} name
 * @property {() => ArrayBuffer} scene
 * @property {Record<string, string>} wishes parameters, as in an address
 */

const UP = /^[-+.\de]+(?:,[-+.\de]+){2}$/i;
const AXES = /^(?=.*[RL])(?=.*[UD])(?=.*[FB])[RLUDFB]{3}$/;
const THREE = 'three numbers as 0,-1,0';

/** @returns {Embedded | null} */
export function embedded() {
  return /** @type {any} */ (globalThis).csplatEmbedded ?? null;
}

/**
 * Read the parameters of an address.
 *
 * @param {URLSearchParams} query
 * @returns {{wishes: Wishes, complaints: string[]}} complaints about invalid values, one line each
 */
export function readWishes(query) {
  /** @type {string[]} */
  const complaints = [];
  /** @type {(name: string, pattern: RegExp, wanted: string) => RegExpExecArray | null} */
  const match = (name, pattern, wanted) => {
    const text = query.get(name);
    const found = text === null ? null : pattern.exec(text);
    if (text !== null && !found) complaints.push(`${name} is “${text}”, expected ${wanted}`);
    return found;
  };
  const size = match('size', /^([1-9]\d{0,3})x([1-9]\d{0,3})$/, 'width and height as 800x600');
  const colour = match('background', /^#?([\da-f]{2})([\da-f]{2})([\da-f]{2})$/i, 'a colour as ff8800');
  /** @param {string} name */
  const direction = (name) => {
    const numbers = match(name, UP, THREE);
    const found = numbers && unitDirection(numbers[0].split(',').map(Number));
    if (numbers && !found) complaints.push(`${name} is “${numbers[0]}”, expected ${THREE}`);
    return found;
  };
  const axes = match('axes', AXES, 'three letters as RDF');
  const backend = match('backend', /^(auto|webgl2|webgpu(-tiles|-quads)?)$/, 'auto, webgl2 or webgpu');
  const view = match('view', /^\d{1,6}$/, 'a number from 0');
  return {
    wishes: {
      scene: query.get('scene'),
      camera: query.get('camera'),
      view: Number(view?.[0] ?? 0),
      up: direction('up'),
      seems: direction('seems'),
      axes: axes?.[0] ?? null,
      size: size && { width: Number(size[1]), height: Number(size[2]) },
      background: colour ? /** @type {any} */ (colour.slice(1).map((two) => parseInt(two, 16) / 255)) : null,
      ui: query.get('ui') !== '0',
      backend: /** @type {import('./types.d.ts').Backend} */ (backend?.[0] ?? 'auto'),
    },
    complaints,
  };
}

/**
 * Fetch the cameras in the address.
 *
 * @param {string} text JSON, or its URL
 * @param {import('./types.d.ts').FetchOptions} [fetching]
 * @returns {Promise<unknown[]>} cameras of a camera file
 */
export async function fetchCameras(text, { fetch = globalThis.fetch, request } = {}) {
  let json = text;
  if (!/^\s*[[{]/.test(text)) {
    const response = await fetch(text, request);
    if (!response.ok) throw new Error(`${text}: HTTP status ${response.status}`);
    json = await response.text();
  }
  return ownCameras(JSON.parse(json));
}

/**
 * Return the last part of an address, the name of a file.
 *
 * @param {string} address
 */
export function nameOf(address) {
  const { pathname } = new URL(address, document.baseURI);
  const last = pathname.slice(pathname.lastIndexOf('/') + 1);
  try {
    return decodeURIComponent(last) || address;
  } catch {
    return last; // invalid percent-encoding
  }
}
