// A loader for three.js: what its own loaders of splats give, from a .csplat.
//
//   const geometry = await new CSPLATLoader().loadAsync('scene.csplat');
//   const splats = new GaussianSplat(geometry); // of three/addons/objects/GaussianSplat.js
//   splats.applyMatrix4(geometry.userData.upright);

import { BufferAttribute, BufferGeometry, Loader, Matrix4 } from 'three';

import { CsplatReader } from '../decoder.mjs';
import { alphaOf, displayColour, onceSaid, places, putBand, putColumns, putCovariances, upOf, uprightIn } from './unpack.mjs';

const SH_WORDS = [0, 3, 4, 6]; // of a splat in a band, four coefficients each
const SH_ZERO = 0x80808080;

const say = onceSaid('CSPLATLoader');

/** Loads splats as the geometry that GaussianSplat takes. */
export class CSPLATLoader extends Loader {
  /** @param {import('three').LoadingManager} [manager] */
  constructor(manager) {
    super(manager);
    this.controller = new AbortController();
  }

  /**
   * @param {string} url
   * @param {(geometry: BufferGeometry) => void} onLoad
   * @param {(event: ProgressEvent) => void} [onProgress]
   * @param {(error: unknown) => void} [onError]
   */
  load(url, onLoad, onProgress, onError) {
    const { manager } = this;
    const address = manager.resolveURL((this.path ?? '') + url);
    const signals = [this.controller.signal, manager.abortController?.signal].filter((one) => one !== undefined);
    const signal = typeof AbortSignal.any === 'function' ? AbortSignal.any(signals) : signals[0];
    const { requestHeader: headers, priority, cache } = /** @type {any} */ (this);
    const progress = (/** @type {number} */ loaded, /** @type {number} */ total) =>
      onProgress?.(new ProgressEvent('progress', { lengthComputable: total > 0, loaded, total }));
    const credentials = this.withCredentials ? 'include' : 'same-origin';
    const request = { headers, credentials, priority, cache };
    manager.itemStart(address);
    CsplatReader.open(address, { request: /** @type {RequestInit} */ (request), signal, onProgress: progress })
      .then((reader) => geometryOf(reader, signal))
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
   * @returns {Promise<BufferGeometry | undefined>} undefined where an error went to onError
   */
  async parse(buffer, onLoad, onError) {
    try {
      const { signal } = this.controller;
      const geometry = await geometryOf(await CsplatReader.open(buffer, { signal }), signal);
      onLoad?.(geometry);
      return geometry;
    } catch (error) {
      if (onError === undefined) throw error;
      onError(error);
    }
  }

  /** End all that this loader has begun. */
  abort() {
    this.controller.abort();
    this.controller = new AbortController();
    return this;
  }
}

/**
 * @param {CsplatReader} reader
 * @param {AbortSignal} signal
 * @returns {Promise<BufferGeometry>}
 */
async function geometryOf(reader, signal) {
  const { header } = reader;
  const { splatCount: count, shDegree } = header;
  const { metadata } = await reader.describe({ signal });
  const centres = new Float32Array(3 * count);
  const covariances = new Float32Array(6 * count);
  const colours = new Uint8ClampedArray(4 * count);
  const bands = SH_WORDS.slice(1, shDegree + 1).map((words) => new Uint32Array(words * count).fill(SH_ZERO));
  const centreAt = places(centres, 3, 0);
  const [red, green, blue, alphaAt] = places(colours, 4, 0, 4);
  const bandAt = bands.map(({ buffer }, i) => places(new Uint8ClampedArray(buffer), 4 * SH_WORDS[i + 1], 0, 3 * (2 * i + 3)));
  const alpha = alphaOf(header);
  for (const { index, first } of header.tiles) {
    const tile = await reader.readTile(index, { form: 'packed', signal });
    putColumns(tile.means, centreAt, first, (value) => value);
    putCovariances(tile, header, covariances, first);
    putBand(tile.sh0, [red, green, blue], first, (value) => 255 * displayColour(value));
    putColumns(tile.opacities, [alphaAt], first, (q) => 255 * alpha(q));
    for (const [i, band] of tile.sh.entries()) if (band) putBand(band, bandAt[i], first, (value) => 128 * value + 128);
  }
  signal.throwIfAborted();
  const geometry = new BufferGeometry();
  geometry.setAttribute('position', new BufferAttribute(centres, 3));
  geometry.setAttribute('covariance', new BufferAttribute(covariances, 6));
  geometry.setAttribute('color', new BufferAttribute(colours, 4, true));
  for (const [i, words] of bands.entries()) {
    geometry.setAttribute(`sphericalHarmonics${i + 1}`, new BufferAttribute(words, SH_WORDS[i + 1]));
  }
  geometry.computeBoundingBox();
  geometry.computeBoundingSphere();
  const [a, b, c] = uprightIn(header, metadata, 'RUB');
  const upright = new Matrix4().set(a[0], a[1], a[2], 0, b[0], b[1], b[2], 0, c[0], c[1], c[2], 0, 0, 0, 0, 1);
  const { axes, antialiased, origin, unitMetres } = header;
  geometry.userData = { axes, antialiased, origin, unitMetres, up: upOf(metadata), metadata, upright };
  if (!antialiased) say('three.js draws all splats as antialiased ones; small ones of scenes that are not come out fainter');
  if (header.extras.length > 0) say('extra columns are left out');
  return geometry;
}
