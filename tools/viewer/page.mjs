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
 * @property {string | null} axes directions of +x, +y, +z; override the file's
 * @property {{width: number, height: number} | null} size size of the drawing buffer, pixels
 * @property {import('./types.d.ts').Background | null} background overrides the file's
 * @property {import('./orbit_camera.mjs').Limits} limits of the controls
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
const CONTROL = /^(?:orbit|(?:min|max)-(?:distance=|polar=|azimuth=-?)(?:\d+\.?|\d*\.\d+))$/;
const CONTROLS =
  'none alone, or orbit and limits as max-polar=90: min-distance, max-distance, min-polar, max-polar, min-azimuth, max-azimuth';
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
  const colour = match(
    'background',
    /^(?:transparent|#?([\da-f]{2})([\da-f]{2})([\da-f]{2}))$/i,
    'transparent or a colour as ff8800',
  );
  /** @param {string} name */
  const direction = (name) => {
    const numbers = match(name, UP, THREE);
    const found = numbers && unitDirection(numbers[0].split(',').map(Number));
    if (numbers && !found) complaints.push(`${name} is “${numbers[0]}”, expected ${THREE}`);
    return found;
  };
  const axes = match('axes', AXES, 'three letters as RDF');
  const backend = match('backend', /^(auto|webgl2|webgpu(-tiles|-quads)?)$/, 'auto, webgl2 or webgpu');
  const controls = query.get('controls')?.trim() ?? '';
  const unknown = controls !== 'none' && controls.split(/\s+/).find((word) => word && !CONTROL.test(word));
  if (unknown) complaints.push(`controls has the word “${unknown}”, expected ${CONTROLS}`);
  let limits = limitsOf(unknown ? '' : controls);
  const { distance, polar, azimuth } = limits;
  if ([distance, polar, azimuth].some(([least, most]) => least > most) || azimuth[0] > 0 || azimuth[1] < 0) {
    complaints.push(`controls is “${controls}”, expected minima below the maxima, azimuths around 0`);
    limits = limitsOf('');
  }
  const view = match('view', /^\d{1,6}$/, 'a number from 0');
  return {
    wishes: {
      scene: query.get('scene'),
      camera: query.get('camera'),
      view: Number(view?.[0] ?? 0),
      up: direction('up'),
      axes: axes?.[0] ?? null,
      size: size && { width: Number(size[1]), height: Number(size[2]) },
      background: colour && /** @type {any} */ (colour[1] ? colour.slice(1).map(share) : 'transparent'),
      limits,
      ui: query.get('ui') !== '0',
      backend: /** @type {import('./types.d.ts').Backend} */ (backend?.[0] ?? 'auto'),
    },
    complaints,
  };
}

/** @param {string} two hexadecimal digits */
const share = (two) => parseInt(two, 16) / 255;

/**
 * @param {string} text valid
 * @returns {import('./orbit_camera.mjs').Limits}
 */
function limitsOf(text) {
  /** @type {(name: string, usual: number) => number} */
  const value = (name, usual) => Number(new RegExp(`${name}=(\\S+)`).exec(text)?.[1] ?? usual);
  const kind = /** @type {'none' | 'orbit' | undefined} */ (/none|orbit/.exec(text)?.[0]) ?? 'free';
  const radians = (/** @type {number} */ degrees) => (degrees * Math.PI) / 180;
  return {
    kind,
    distance: [value('min-distance', 0), value('max-distance', Infinity)],
    polar: [radians(value('min-polar', 0)), radians(value('max-polar', 180))],
    azimuth: [radians(value('min-azimuth', -180)), radians(value('max-azimuth', 180))],
  };
}

/**
 * Read the cameras in the address.
 *
 * @param {string} text JSON, or its URL
 * @param {import('./types.d.ts').FetchOptions} [fetching]
 * @returns {unknown[] | Promise<unknown[]>} cameras of a camera file; a promise if they have to be fetched
 */
export function readCameras(text, fetching = {}) {
  return /^\s*[[{]/.test(text) ? ownCameras(JSON.parse(text)) : fetchCameras(text, fetching);
}

/**
 * @param {string} url
 * @param {import('./types.d.ts').FetchOptions} fetching
 */
async function fetchCameras(url, { fetch = globalThis.fetch, request }) {
  const response = await fetch(url, request);
  if (!response.ok) throw new Error(`${url}: HTTP status ${response.status}`);
  return ownCameras(await response.json());
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
