// What the address of the page asks for, and what a page that carries its scene has inside.

import { ownCameras } from './camera_forms.mjs';
import { unitDirection } from './vectors.mjs';

/**
 * @typedef {object} Wishes
 * @property {string | null} scene address of a .csplat file
 * @property {string | null} camera a camera, a list of them, or the address of a file of one or the other
 * @property {number} view which camera of a list, from 0
 * @property {import('./vectors.mjs').Vec3 | null} up direction that is up, of length 1, instead of what the file says
 * @property {import('./vectors.mjs').Vec3 | null} seems which way seems to be up, if nothing says it
 * @property {string | null} axes directions of +x, +y, +z instead of the file's
 * @property {{width: number, height: number} | null} size of the drawing buffer, pixels
 * @property {[number, number, number] | null} background 0 to 1, instead of what the file says
 * @property {boolean} ui false for the scene alone
 *
 * What `csplat export-html` puts into the page.
 * @typedef {object} Embedded
 * @property {string} name
 * @property {() => ArrayBuffer} scene
 * @property {Record<string, string>} wishes parameters, as an address would have them
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
 * @returns {{wishes: Wishes, complaints: string[]}} complaints about values that have no meaning, one line each
 */
export function readWishes(query) {
  /** @type {string[]} */
  const complaints = [];
  /** @type {(name: string, pattern: RegExp, wanted: string) => RegExpExecArray | null} */
  const match = (name, pattern, wanted) => {
    const text = query.get(name);
    const found = text === null ? null : pattern.exec(text);
    if (text !== null && !found) complaints.push(`${name} is “${text}”, wanted ${wanted}`);
    return found;
  };
  const size = match('size', /^([1-9]\d{0,3})x([1-9]\d{0,3})$/, 'width and height as 800x600');
  const colour = match('background', /^#?([\da-f]{2})([\da-f]{2})([\da-f]{2})$/i, 'a colour as ff8800');
  /** @param {string} name */
  const direction = (name) => {
    const numbers = match(name, UP, THREE);
    const found = numbers && unitDirection(numbers[0].split(',').map(Number));
    if (numbers && !found) complaints.push(`${name} is “${numbers[0]}”, wanted ${THREE}`);
    return found;
  };
  const axes = match('axes', AXES, 'three letters as RDF');
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
    },
    complaints,
  };
}

/**
 * Get the cameras that the address names.
 *
 * @param {string} text JSON, or where it lies
 * @returns {Promise<unknown[]>} entries of a camera file
 */
export async function fetchCameras(text) {
  let json = text;
  if (!/^\s*[[{]/.test(text)) {
    const response = await fetch(text);
    if (!response.ok) throw new Error(`${text}: HTTP status ${response.status}`);
    json = await response.text();
  }
  return ownCameras(JSON.parse(json));
}

/**
 * The last part of an address, as people name a file.
 *
 * @param {string} address
 */
export function nameOf(address) {
  const { pathname } = new URL(address, document.baseURI);
  const last = pathname.slice(pathname.lastIndexOf('/') + 1);
  try {
    return decodeURIComponent(last) || address;
  } catch {
    return last; // a percent sign that encodes nothing
  }
}
