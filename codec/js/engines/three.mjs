// SPDX-License-Identifier: Apache-2.0
// A loader for three.js: loads a .csplat as the same geometry as three.js's own splat loaders. See three.d.ts.
//
//   const geometry = await new CSPLATLoader().loadAsync('scene.csplat');
//   const splats = new GaussianSplat(geometry); // from three/addons/objects/GaussianSplat.js
//   splats.applyMatrix4(geometry.userData.csplat.upright);

import { BufferAttribute, BufferGeometry, Loader, Matrix4 } from 'three';

import { openScene } from './scene.mjs';
import { alphaOf, displayColour, onceSaid, places, putBand, putColumns, putCovariances } from './packed_values.mjs';

/**
 * @typedef {import('../decoder.d.ts').ByteSource} ByteSource
 * @typedef {import('./options.d.ts').LoadOptions} LoadOptions
 * @typedef {import('./options.d.ts').SceneSource} SceneSource
 * @typedef {import('./scene.mjs').SplatScene} SplatScene
 */

const NAME = 'CSPLATLoader';
const TARGET = { name: NAME, engine: /** @type {const} */ ('RUB'), mirrors: true, shDegree: 3 };
const SH_WORDS = [0, 3, 4, 6]; // words per splat in a band, of four coefficients each
const SH_ZERO = 0x80808080;

/** Loads splats as a geometry for GaussianSplat. */
export class CSPLATLoader extends Loader {
  /** @param {import('three').LoadingManager} [manager] */
  constructor(manager) {
    super(manager);
    this.controller = new AbortController();
    /** @type {LoadOptions} */
    this.options = {};
  }

  /** @param {LoadOptions} options */
  setOptions(options) {
    this.options = options;
    return this;
  }

  /**
   * @param {string} url
   * @param {(geometry: BufferGeometry) => void} onLoad
   * @param {(event: ProgressEvent) => void} [onProgress]
   * @param {(error: unknown) => void} [onError]
   */
  load(url, onLoad, onProgress, onError) {
    const { manager, options } = this;
    const address = manager.resolveURL((this.path ?? '') + url);
    const { requestHeader: headers, priority, cache } = /** @type {any} */ (this);
    const progress = (/** @type {number} */ loaded, /** @type {number} */ total) => {
      options.onProgress?.(loaded, total);
      onProgress?.(new ProgressEvent('progress', { lengthComputable: total > 0, loaded, total }));
    };
    const credentials = this.withCredentials ? 'include' : 'same-origin';
    const request = /** @type {RequestInit} */ ({ headers, credentials, priority, cache, ...options.request });
    manager.itemStart(address);
    this.read(address, { ...options, request, onProgress: progress })
      .then(onLoad)
      .catch((error) => {
        if (onError) onError(error);
        else console.error(error);
        manager.itemError(address);
      })
      .finally(() => manager.itemEnd(address));
  }

  /**
   * @param {ArrayBuffer} buffer a file
   * @param {(geometry: BufferGeometry) => void} [onLoad]
   * @param {(error: unknown) => void} [onError]
   * @returns {Promise<BufferGeometry | undefined>} undefined if an error went to onError
   */
  async parse(buffer, onLoad, onError) {
    try {
      const geometry = await this.read(buffer, this.options);
      onLoad?.(geometry);
      return geometry;
    } catch (error) {
      if (onError === undefined) throw error;
      onError(error);
    }
  }

  /** Abort all loads of this loader. */
  abort() {
    this.controller.abort();
    this.controller = new AbortController();
    return this;
  }

  /**
   * @param {SceneSource} from
   * @param {LoadOptions} options
   */
  async read(from, options) {
    const signals = [this.controller.signal, this.manager.abortController?.signal];
    return geometryOf(await openScene(from, options, TARGET, signals));
  }
}

/** @param {SplatScene} scene */
async function geometryOf(scene) {
  const { header, upright: [a, b, c] } = scene; // prettier-ignore
  const { splatCount: count, antialiased } = header;
  const centres = new Float32Array(3 * count);
  const covariances = new Float32Array(6 * count);
  const colours = new Uint8ClampedArray(4 * count);
  const bands = new Bands(count, scene.progressive ? 0 : scene.degree);
  const centreAt = places(centres, 3, 0);
  const [red, green, blue, alphaAt] = places(colours, 4, 0, 4);
  const alpha = alphaOf(header);
  for await (const tile of scene.tiles()) {
    const { first } = tile;
    putColumns(tile.means, centreAt, first, (value) => value);
    putCovariances(tile, header, covariances, first);
    putBand(tile.sh0, [red, green, blue], first, (value) => 255 * displayColour(value));
    putColumns(tile.opacities, [alphaAt], first, (q) => 255 * alpha(q));
    for (const [i, band] of tile.sh.entries()) if (band) bands.put(i + 1, band, first);
  }
  if (!antialiased)
    onceSaid(NAME, 'three.js draws all scenes as antialiased; small splats of this scene appear too faint');
  const geometry = new BufferGeometry();
  geometry.setAttribute('position', new BufferAttribute(centres, 3));
  geometry.setAttribute('covariance', new BufferAttribute(covariances, 6));
  geometry.setAttribute('color', new BufferAttribute(colours, 4, true));
  bands.addTo(geometry);
  geometry.computeBoundingBox();
  geometry.computeBoundingSphere();
  const upright = new Matrix4().set(a[0], a[1], a[2], 0, b[0], b[1], b[2], 0, c[0], c[1], c[2], 0, 0, 0, 0, 1);
  const facts = scene.facts(() => wholeOf(scene, geometry), geometry);
  geometry.userData = { csplat: { ...facts, upright } };
  geometry.addEventListener('dispose', () => scene.abort());
  return geometry;
}

/**
 * Return a new geometry of the same splats with all bands: GaussianSplat reads its geometry only on construction.
 *
 * @param {SplatScene} scene
 * @param {BufferGeometry} base
 */
async function wholeOf(scene, base) {
  const bands = new Bands(scene.header.splatCount, scene.degree);
  for (let layer = 1; layer <= scene.degree; layer++) {
    for await (const { sh, first } of scene.bands(layer)) bands.put(layer, sh, first);
  }
  const geometry = new BufferGeometry();
  for (const [name, attribute] of Object.entries(base.attributes)) geometry.setAttribute(name, attribute);
  bands.addTo(geometry);
  geometry.boundingBox = base.boundingBox;
  geometry.boundingSphere = base.boundingSphere;
  geometry.userData = base.userData;
  return geometry;
}

/** SH coefficients as bytes, four per word. */
class Bands {
  /**
   * @param {number} count
   * @param {number} degree
   */
  constructor(count, degree) {
    this.words = SH_WORDS.slice(1, degree + 1).map((width) => new Uint32Array(width * count).fill(SH_ZERO));
    this.places = this.words.map(({ buffer }, i) =>
      places(new Uint8ClampedArray(buffer), 4 * SH_WORDS[i + 1], 0, 3 * (2 * i + 3)),
    );
  }

  /**
   * @param {number} layer
   * @param {import('../decoder.d.ts').Packed} band
   * @param {number} first splat
   */
  put(layer, band, first) {
    putBand(band, this.places[layer - 1], first, (value) => 128 * value + 128);
  }

  /** @param {BufferGeometry} geometry */
  addTo(geometry) {
    for (const [i, words] of this.words.entries()) {
      geometry.setAttribute(`sphericalHarmonics${i + 1}`, new BufferAttribute(words, SH_WORDS[i + 1]));
    }
  }
}
