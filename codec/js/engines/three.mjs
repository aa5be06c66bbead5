// SPDX-License-Identifier: Apache-2.0
// A loader for three.js: loads a .csplat as the geometry that three.js's own SPZLoader returns. See three.d.ts.
//
//   const geometry = await new CSPLATLoader().loadAsync('scene.csplat');
//   const splats = new GaussianSplat(geometry); // from three/addons/objects/GaussianSplat.js
//   splats.applyMatrix4(geometry.userData.csplat.upright);
//   geometry.userData.csplat.refine(splats);

import { Box3, BufferAttribute, BufferGeometry, Loader, Matrix4, Sphere, Vector2, Vector3 } from 'three';

import { FADE_STEPS } from '../levels/shown_tiles.mjs';
import { SplatPool } from '../levels/splat_pool.mjs';
import { openScene } from './scene.mjs';
import { displayColour, onceSaid, places, putAlphas, putBand, putColumns, putCovariances } from './packed_values.mjs';

/**
 * @typedef {import('../decoder.d.ts').ByteSource} ByteSource
 * @typedef {import('./options.d.ts').LoadOptions} LoadOptions
 * @typedef {import('./options.d.ts').SceneSource} SceneSource
 * @typedef {import('./scene.mjs').SplatScene} SplatScene
 * @typedef {import('three/addons/objects/GaussianSplat.js').GaussianSplat} GaussianSplat
 * @typedef {import('three/addons/objects/GaussianSplat.js').StorageAttribute} StorageAttribute
 */

const NAME = 'CSPLATLoader';
const TARGET = { name: NAME, engine: /** @type {const} */ ('RUB'), mirrors: true, aligns: true, shDegree: 3 };
const SH_WORDS = [0, 3, 4, 6]; // words per splat in a band, of four coefficients each
const SH_ZERO = 0x80808080;
const SORTED = 4; // radius of the sphere in whose 4,096 steps splats are sorted, by that of the ball around most of them
const FINER = 16; // times more finely than in the usual range are depths sorted if
const MOST = 0.99; // of what the camera sees is in such a range
const RESORTED = 0.25; // change of the sorted depths, as a fraction of them, after which splats are sorted anew
const TILES_MAX = 500; // of a scene whose depths are sorted where the camera looks; the effort grows with the square

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
  /** @type {import('../levels/splat_pool.mjs').SplatArrays['fade']} */
  const fade = (tile, first, shares) => putAlphas(tile, header, alphaAt, first, (alpha) => 255 * alpha, shares);
  /** @type {import('../levels/splat_pool.mjs').SplatArrays['put']} */
  const put = (tile, first) => {
    putColumns(tile.means, centreAt, first, (value) => value);
    putCovariances(tile, header, covariances, first);
    putBand(tile.sh0, [red, green, blue], first, (value) => 255 * displayColour(value));
    fade(tile, first, FADE_STEPS);
  };
  const geometry = new BufferGeometry();
  geometry.setAttribute('position', new BufferAttribute(centres, 3));
  geometry.setAttribute('covariance', new BufferAttribute(covariances, 6));
  geometry.setAttribute('color', new BufferAttribute(colours, 4, true));
  let drawing = null;
  if (scene.levels) {
    drawing = new Drawing(scene, geometry);
    const clear = (/** @type {number} */ first, /** @type {number} */ n) => {
      covariances.fill(0, 6 * first, 6 * (first + n));
      colours.fill(0, 4 * first, 4 * (first + n));
      bands.clear(first, n);
    };
    const putOne = bands.put.bind(bands);
    const flush = drawing.flush.bind(drawing);
    await scene.drawLevels(new SplatPool(count, { put, fade, putBand: putOne, clear, flush }));
  }
  for await (const tile of scene.tiles()) {
    put(tile, tile.first);
    for (const [i, band] of tile.sh.entries()) if (band) bands.put(i + 1, band, tile.first);
  }
  if (!antialiased)
    onceSaid(NAME, 'three.js draws all scenes as antialiased; small splats of this scene appear too faint');
  bands.addTo(geometry);
  const box = new Box3(...scene.corners(Vector3, undefined, 3));
  const whole = box.getBoundingSphere(new Sphere());
  if (scene.levels) [geometry.boundingBox, geometry.boundingSphere] = [box, whole];
  else {
    geometry.computeBoundingBox(); // as three.js's loaders do, which leave out how large splats are
    geometry.computeBoundingSphere();
  }
  const upright = new Matrix4().set(a[0], a[1], a[2], 0, b[0], b[1], b[2], 0, c[0], c[1], c[2], 0, 0, 0, 0, 1);
  const facts = scene.facts(() => wholeOf(scene, geometry), geometry);
  const { centre, radius } = facts.bounds;
  const middle = new Vector3(...centre).applyMatrix4(upright.clone().invert());
  const reach = middle.distanceTo(whole.center) + whole.radius; // from the middle to all splats
  const sphere = new Sphere(middle, Math.min(SORTED * radius, reach));
  const sorting = reach > SORTED * radius ? new Sorting(scene, sphere) : null;
  const refine = (/** @type {GaussianSplat} */ splats) => {
    const { onBeforeRender: own } = splats;
    splats.boundingSphere = whole; // by which three.js culls, and chooses the depths that it sorts
    splats.onBeforeRender = (renderer, shown, camera) => {
      splats.boundingSphere = sorting?.sphereFor(splats, camera) ?? sphere;
      own(renderer, shown, camera);
      splats.boundingSphere = whole;
    };
    drawing?.start(splats);
  };
  const [x, y, z] = scene.signs;
  geometry.userData = { csplat: { ...facts, fromFile: new Matrix4().makeScale(x, y, z), upright, refine } };
  geometry.addEventListener('dispose', () => scene.abort());
  return geometry;
}

/** Chooses the depths in which splats are sorted, of a scene with far parts: where most of what the camera sees is. */
class Sorting {
  /**
   * @param {SplatScene} scene
   * @param {Sphere} usual the sphere around most splats
   */
  constructor({ header: { tiles }, signs }, usual) {
    this.usual = usual;
    this.tiles = tiles.map(({ min, max, splatCount: count }) => ({
      centre: signs.map((sign, k) => (sign * (min[k] + max[k])) / 2),
      half: signs.map((_, k) => (max[k] - min[k]) / 2),
      count,
    }));
    this.modelView = new Matrix4();
    this.sphere = new Sphere();
    this.last = [0, 0];
  }

  /**
   * @param {GaussianSplat} splats
   * @param {import('three').PerspectiveCamera} camera
   * @returns {Sphere} in the coordinates of the splats
   */
  sphereFor(splats, camera) {
    if (this.tiles.length > TILES_MAX) return this.usual;
    const { elements: e } = this.modelView.multiplyMatrices(camera.matrixWorldInverse, splats.matrixWorld);
    const scale = splats.matrixWorld.getMaxScaleOnAxis();
    const least = camera.near;
    const seen = [];
    for (const { centre, half, count } of this.tiles) {
      const depth = -(e[2] * centre[0] + e[6] * centre[1] + e[10] * centre[2] + e[14]);
      const reach = Math.abs(e[2]) * half[0] + Math.abs(e[6]) * half[1] + Math.abs(e[10]) * half[2];
      const near = Math.max(least, depth - reach);
      const far = depth + reach;
      if (far > least) seen.push({ near, far, middle: (near + far) / 2, weight: count / (near + far) ** 2 });
    }
    const total = seen.reduce((sum, { weight }) => sum + weight, 0);
    const { center, radius } = this.usual;
    const depth = -(e[2] * center.x + e[6] * center.y + e[10] * center.z + e[14]);
    const usual = seen.filter(({ middle }) => Math.abs(middle - depth) <= scale * radius);
    const length = 2 * scale * radius;
    let best = heaviest(seen, length / FINER);
    if (best.weight < MOST * total) {
      const isUsual = usual.reduce((sum, { weight }) => sum + weight, 0) >= total / 2;
      best = isUsual ? { near: depth - length / 2, far: depth + length / 2, weight: 0 } : heaviest(seen, length);
    }
    const [near, far] = this.last;
    const change = Math.abs(best.near - near) + Math.abs(best.far - far);
    if (change > RESORTED * (best.far - best.near)) {
      splats._sortInitialized = false;
      this.last = [best.near, best.far];
    }
    this.sphere.center.set(0, 0, -(best.near + best.far) / 2).applyMatrix4(this.modelView.invert());
    this.sphere.radius = (best.far - best.near) / 2 / scale;
    return this.sphere;
  }
}

/**
 * Return the depths, at most `length`, between which most of the weight of tiles is.
 *
 * @param {{near: number, far: number, middle: number, weight: number}[]} seen
 * @param {number} length
 */
function heaviest(seen, length) {
  let best = { near: 0, far: 0, weight: 0 };
  for (const { near } of seen) {
    const within = seen.filter(({ middle }) => middle >= near && middle <= near + length);
    const weight = within.reduce((sum, one) => sum + one.weight, 0);
    const far = Math.min(near + length, Math.max(...within.map((one) => one.far)));
    if (weight > best.weight) best = { near, far, weight };
  }
  return best;
}

/** What a GaussianSplat draws of a pool. It reads its geometry only on construction, so its buffers are changed. */
class Drawing {
  /**
   * @param {SplatScene} scene
   * @param {BufferGeometry} geometry
   */
  constructor(scene, geometry) {
    this.scene = scene;
    this.geometry = geometry;
    /** @type {[number, number][]} */
    this.changed = [];
    /** @type {[number, number][]} */
    this.faded = [];
    this.modelView = new Matrix4();
    this.size = new Vector2();
  }

  /**
   * @param {[number, number][]} ranges
   * @param {[number, number][]} faded
   */
  flush(ranges, faded) {
    this.changed.push(...ranges);
    this.faded.push(...faded);
  }

  /** @param {GaussianSplat} splats */
  start(splats) {
    const { onBeforeRender: own } = splats;
    splats.onBeforeRender = (renderer, scene, camera) => {
      this.modelView.multiplyMatrices(camera.matrixWorldInverse, splats.matrixWorld);
      const { x: width, y: height } = renderer.getDrawingBufferSize(this.size);
      this.scene.look(this.modelView.elements, camera.projectionMatrix.elements, { width, height, near: camera.near });
      if (this.changed.length + this.faded.length > 0) this.copy(splats);
      own(renderer, scene, camera);
    };
  }

  /** @param {GaussianSplat} splats */
  copy(splats) {
    const { attributes } = this.geometry;
    const { _buffers: buffers } = splats;
    const [centres, covariances] = [attributes.position.array, attributes.covariance.array];
    const colours = new Uint32Array(attributes.color.array.buffer);
    const [centre, a, b] = [buffers.centerRead, buffers.covarianceARead, buffers.covarianceBRead].map(
      ({ value }) => value.array,
    );
    this.upload(buffers.colorRead.value, 1, colours, this.faded);
    this.faded = [];
    if (this.changed.length === 0) return;
    for (const [first, count] of this.changed) {
      for (let i = first; i < first + count; i++) {
        for (let k = 0; k < 3; k++) centre[4 * i + k] = centres[3 * i + k];
        for (let k = 0; k < 4; k++) a[4 * i + k] = covariances[6 * i + k];
        b[4 * i] = covariances[6 * i + 4];
        b[4 * i + 1] = covariances[6 * i + 5];
      }
    }
    this.upload(buffers.centerRead.value, 4, null);
    this.upload(buffers.covarianceARead.value, 4, null);
    this.upload(buffers.covarianceBRead.value, 4, null);
    this.upload(buffers.colorRead.value, 1, colours);
    for (let degree = 1; degree <= buffers.sphericalHarmonicsDegree; degree++) {
      const words = attributes[`sphericalHarmonics${degree}`].array;
      this.upload(buffers[`sphericalHarmonics${degree}Attribute`], SH_WORDS[degree], words);
    }
    this.changed = [];
    splats._sortInitialized = splats._sphericalHarmonicsInitialized = false; // both are computed anew
  }

  /**
   * @param {StorageAttribute} attribute
   * @param {number} width words per splat
   * @param {ArrayLike<number> | null} words copied to it, unless it has them already
   * @param {[number, number][]} [ranges]
   */
  upload(attribute, width, words, ranges = this.changed) {
    for (const [first, count] of ranges) {
      const [start, size] = [width * first, width * count];
      if (words && words !== attribute.array) {
        for (let i = start; i < start + size; i++) attribute.array[i] = words[i];
      }
      attribute.addUpdateRange(start, size);
    }
    attribute.needsUpdate = true;
    if (attribute.pbo) attribute.pbo.needsUpdate = true; // the texture that WebGL reads
  }
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

  /**
   * @param {number} first splat
   * @param {number} count
   */
  clear(first, count) {
    for (const [i, words] of this.words.entries()) {
      words.fill(SH_ZERO, SH_WORDS[i + 1] * first, SH_WORDS[i + 1] * (first + count));
    }
  }

  /** @param {BufferGeometry} geometry */
  addTo(geometry) {
    for (const [i, words] of this.words.entries()) {
      geometry.setAttribute(`sphericalHarmonics${i + 1}`, new BufferAttribute(words, SH_WORDS[i + 1]));
    }
  }
}
