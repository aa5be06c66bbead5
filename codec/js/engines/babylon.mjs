// SPDX-License-Identifier: Apache-2.0
// A plugin of Babylon.js's scene loader for .csplat. Importing this module registers it. See babylon.d.ts.
//
//   import 'csplat-decoder/babylon';
//   const { meshes: [splats] } = await ImportMeshAsync('scene.csplat', scene);

import { AssetContainer } from '@babylonjs/core/assetContainer.js';
import { RegisterSceneLoaderPlugin } from '@babylonjs/core/Loading/sceneLoader.js';
import { Matrix, Quaternion, Vector3 } from '@babylonjs/core/Maths/math.vector.js';
import { GaussianSplattingMesh } from '@babylonjs/core/Meshes/GaussianSplatting/gaussianSplattingMesh.js';
import { Observable } from '@babylonjs/core/Misc/observable.js';

import { FADE_STEPS } from '../levels/shown_tiles.mjs';
import { SplatPool } from '../levels/splat_pool.mjs';
import { openScene } from './scene.mjs';
import { displayColour, eachThinnest, places, putAlphas, putBand, putColumns, putQuats } from './packed_values.mjs';

const NAME = 'csplat';
const ROW_BYTES = 32; // per splat: centre and scales as float32; colour, alpha and rotation as bytes
const SH_BYTES = 16; // per splat in one texture
const SH_ZERO = 128;

/**
 * @typedef {import('@babylonjs/core/scene.js').Scene} Scene
 * @typedef {import('./babylon.d.ts').CSPLATLoadingOptions} CSPLATLoadingOptions
 * @typedef {import('./scene.mjs').SplatScene} SplatScene
 * @typedef {import('../levels/splat_pool.mjs').SplatArrays} SplatArrays
 */

/** The plugin. */
export class CSPLATFileLoader {
  /** @param {CSPLATLoadingOptions} [options] */
  constructor(options = {}) {
    this.name = NAME;
    this.extensions = { '.csplat': { isBinary: true, mimeType: 'model/vnd.csplat' } };
    this.options = options;
  }

  /** @param {Record<string, any>} options options of all plugins, by their names */
  createPlugin(options) {
    return new CSPLATFileLoader(options[NAME]);
  }

  /**
   * Open a file; importMeshAsync then reads it tile by tile.
   *
   * @param {Scene} scene
   * @param {string | Blob | ArrayBufferView} from
   * @param {string} _rootUrl
   * @param {(opened: SplatScene) => void} onSuccess
   * @param {(event: {lengthComputable: boolean, loaded: number, total: number}) => void} [onProgress]
   * @param {boolean} [_asArrayBuffer]
   * @param {(request?: undefined, error?: unknown) => void} [onError]
   */
  loadFile(scene, from, _rootUrl, onSuccess, onProgress, _asArrayBuffer, onError) {
    const { keepInRam, ...options } = this.options;
    const controller = new AbortController();
    const abort = () => controller.abort();
    const request = { onCompleteObservable: new Observable(), abort };
    const observer = scene.onDisposeObservable.addOnce(abort);
    const progress = (/** @type {number} */ loaded, /** @type {number} */ total) => {
      options.onProgress?.(loaded, total);
      onProgress?.({ lengthComputable: total > 0, loaded, total });
    };
    const engine = /** @type {'RUB' | 'RUF'} */ (scene.useRightHandedSystem ? 'RUB' : 'RUF');
    const source =
      typeof from === 'string' || from instanceof Blob
        ? from
        : new Blob([/** @type {ArrayBufferView<ArrayBuffer>} */ (from)]);
    const target = { name: 'csplat for Babylon.js', engine, mirrors: true, shDegree: 4 };
    openScene(source, { ...options, onProgress: progress }, target, [controller.signal])
      .then(onSuccess, (error) => onError?.(undefined, error))
      .finally(() => {
        observer.remove();
        request.onCompleteObservable.notifyObservers(request);
      });
    return request;
  }

  /**
   * @param {unknown} _names
   * @param {Scene} scene
   * @param {SplatScene} opened
   */
  async importMeshAsync(_names, scene, opened) {
    const observer = scene.onDisposeObservable.addOnce(() => opened.abort());
    const meshes = [await meshOf(scene, opened, this.options.keepInRam).finally(() => observer.remove())];
    const none = { particleSystems: [], skeletons: [], animationGroups: [], transformNodes: [] };
    return { meshes, ...none, geometries: [], lights: [], spriteManagers: [] };
  }

  /**
   * @param {Scene} scene
   * @param {SplatScene} opened
   */
  async loadAsync(scene, opened) {
    await this.importMeshAsync(null, scene, opened);
  }

  /**
   * @param {Scene} scene
   * @param {SplatScene} opened
   */
  async loadAssetContainerAsync(scene, opened) {
    const { meshes } = await this.importMeshAsync(null, scene, opened);
    const container = new AssetContainer(scene);
    container.meshes.push(...meshes);
    container.removeAllFromScene();
    return container;
  }
}

/**
 * @param {Scene} scene
 * @param {SplatScene} opened
 * @param {boolean} [keepInRam]
 */
async function meshOf(scene, opened, keepInRam = false) {
  const { header, upright: [a, b, c] } = opened; // prettier-ignore
  const width = scene.getEngine().getCaps().maxTextureSize;
  const degree = opened.progressive ? 0 : opened.degree;
  const bands = new Bands(header.splatCount, degree, width);
  const { rows, put, fade } = rowsOf(opened, bands);
  const drawing = opened.levels ? new Drawing(scene, opened, rows, bands, width) : null;
  if (drawing) await opened.drawLevels(drawing.poolOf({ put, fade }));
  for await (const tile of opened.tiles()) put(tile, tile.first);
  if (scene.isDisposed) {
    opened.release();
    throw new Error('the scene was disposed before its splats had loaded');
  }
  const mesh = new GaussianSplattingMesh('GaussianSplatting', null, scene, keepInRam);
  mesh.onDisposeObservable.addOnce(() => opened.abort());
  try {
    if (header.antialiased) /** @type {any} */ (mesh.material).compensation = true;
    await mesh.updateDataAsync(rows, bands.textures, undefined, degree);
    // Babylon multiplies row vectors, so the matrix is given column by column.
    const upright = Matrix.FromValues(a[0], b[0], c[0], 0, a[1], b[1], c[1], 0, a[2], b[2], c[2], 0, 0, 0, 0, 1);
    mesh.rotationQuaternion = new Quaternion();
    upright.decompose(mesh.scaling, mesh.rotationQuaternion);
    mesh.computeWorldMatrix(true);
    drawing?.start(mesh);
    mesh.metadata = { csplat: opened.facts(() => addBands(mesh, rows, opened, width), undefined) };
  } catch (error) {
    mesh.dispose(false, true); // with its material
    opened.release();
    throw error;
  }
  return mesh;
}

/**
 * Return empty rows, one per splat, and what writes a tile to them.
 *
 * @param {SplatScene} opened
 * @param {Bands} bands
 */
function rowsOf({ header }, bands) {
  const rows = new ArrayBuffer(ROW_BYTES * header.splatCount);
  const floats = new Float32Array(rows);
  const numbers = places(floats, ROW_BYTES / 4, 0, 6);
  const bytes = places(new Uint8ClampedArray(rows), ROW_BYTES, 24, 8);
  const [centreAt, scalesAt] = [numbers.slice(0, 3), numbers.slice(3)];
  const [colourAt, alphaAt, quatAt] = [bytes.slice(0, 3), bytes[3], bytes.slice(4)];
  /** @type {SplatArrays['fade']} */
  const fade = (tile, first, shares) => putAlphas(tile, header, alphaAt, first, (alpha) => 255 * alpha, shares);
  /** @type {SplatArrays['put']} */
  const put = (tile, first) => {
    putColumns(tile.means, centreAt, first, (value) => value);
    putColumns(tile.scales, scalesAt, first, Math.exp);
    if (header.flat) eachThinnest(tile, (i, c) => (floats[(ROW_BYTES / 4) * (first + i) + 3 + c] = 0));
    putBand(tile.sh0, colourAt, first, (value) => 255 * displayColour(value));
    fade(tile, first, FADE_STEPS);
    putQuats(tile.quats, header, quatAt, first, signed);
    for (const [i, band] of tile.sh.entries()) if (band) bands.put(i + 1, band, first);
  };
  return { rows, put, fade };
}

/** Draws a pool of splats, by the functions with which the engine streams SOG. */
class Drawing {
  /**
   * @param {Scene} scene
   * @param {SplatScene} opened
   * @param {ArrayBuffer} rows
   * @param {Bands} bands
   * @param {number} width width of the textures
   */
  constructor(scene, opened, rows, bands, width) {
    this.scene = scene;
    this.opened = opened;
    this.rows = rows;
    this.bands = bands;
    this.width = width;
    /** @type {SplatPool | null} */
    this.pool = null;
    /** @type {GaussianSplattingMesh | null} */
    this.mesh = null;
    /** @type {[number, number][]} */
    this.changed = [];
    /** @type {[number, number][]} */
    this.faded = [];
  }

  /** @param {Pick<SplatArrays, 'put' | 'fade'>} rows */
  poolOf({ put, fade }) {
    this.pool = new SplatPool(this.opened.header.splatCount, {
      put,
      fade,
      putBand: (layer, band, first) => this.bands.put(layer, band, first),
      clear: (first, count) => this.bands.clear(first, count), // the rest is not in the ranges that are drawn
      flush: (changed, faded) => {
        this.changed.push(...changed);
        this.faded.push(...faded);
        this.upload();
      },
    });
    return this.pool;
  }

  /** @param {GaussianSplattingMesh} mesh with the data of the first picture */
  start(mesh) {
    const { opened, scene } = this;
    this.mesh = mesh;
    this.upload();
    const observer = scene.onBeforeRenderObservable.add(() => this.look(mesh));
    mesh.onDisposeObservable.addOnce(() => observer.remove());
    mesh.getBoundingInfo().reConstruct(...opened.corners(Vector3, undefined, 3), mesh.getWorldMatrix());
  }

  /** @param {GaussianSplattingMesh} mesh */
  look(mesh) {
    const { opened, scene } = this;
    const { activeCamera: camera } = scene;
    if (!camera) return;
    const engine = scene.getEngine();
    const picture = { width: engine.getRenderWidth(), height: engine.getRenderHeight(), near: camera.minZ };
    // Matrices of row vectors have the memory layout of those of column vectors, and z may point forward.
    const modelView = Array.from(mesh.getWorldMatrix().multiply(camera.getViewMatrix()).asArray());
    const projection = Array.from(camera.getProjectionMatrix().asArray());
    for (let at = 2; at < 16 && !scene.useRightHandedSystem; at += 4) modelView[at] *= -1;
    for (let at = 8; at < 12 && !scene.useRightHandedSystem; at++) projection[at] *= -1;
    opened.look(modelView, projection, picture);
  }

  upload() {
    const { bands, changed, faded, mesh, pool, rows, width } = this;
    if (mesh === null || pool === null) return;
    for (const [first, count] of faded) this.#uploadColours(mesh, first, count);
    for (const [first, count] of changed) {
      mesh._writeStreamingSplats(first, count, new Uint8Array(rows, ROW_BYTES * first, ROW_BYTES * count));
      const line = Math.floor(first / width);
      const lines = Math.ceil((first + count) / width) - line;
      for (const [i, texels] of (bands.textures ?? []).entries()) {
        mesh._updateShTextureData(mesh._shTextures[i], texels, width, line, lines);
      }
    }
    this.changed = this.faded = [];
    const drawn = Array.from(pool.places.values(), ({ first: offset, tile: { count } }) => ({ offset, count }));
    mesh.setSplatIndexRanges(drawn);
  }

  /**
   * Upload the colours of splats whose opacities have changed.
   *
   * @param {GaussianSplattingMesh} mesh
   * @param {number} first
   * @param {number} count
   */
  #uploadColours(mesh, first, count) {
    const words = new Uint32Array(this.rows);
    const colours = new Uint32Array(count);
    for (let i = 0; i < count; i++) colours[i] = words[(ROW_BYTES / 4) * (first + i) + 6];
    const { x: width } = mesh._getTextureSize(mesh._vertexCount);
    for (let at = 0; at < count;) {
      const [column, row] = [(first + at) % width, Math.floor((first + at) / width)];
      const run = Math.min(count - at, width - column);
      const bytes = new Uint8Array(colours.buffer, 4 * at, 4 * run);
      mesh._updateTextureFromDataRect(mesh._colorsTexture, bytes, column, row, run, 1);
      at += run;
    }
  }
}

/**
 * @param {GaussianSplattingMesh} mesh
 * @param {ArrayBuffer} rows
 * @param {SplatScene} opened
 * @param {number} width width of the textures
 */
async function addBands(mesh, rows, opened, width) {
  const bands = new Bands(opened.header.splatCount, opened.degree, width);
  for (let layer = 1; layer <= opened.degree; layer++) {
    for await (const { sh, first } of opened.bands(layer)) bands.put(layer, sh, first);
  }
  await mesh.updateDataAsync(rows, bands.textures, undefined, opened.degree);
}

/** SH coefficients as bytes, in textures. */
class Bands {
  /**
   * @param {number} count
   * @param {number} degree
   * @param {number} width width of the textures
   */
  constructor(count, degree, width) {
    const values = 3 * ((degree + 1) ** 2 - 1);
    const size = SH_BYTES * width * (Math.floor(count / width) + 1); // room for one more splat, as in the mesh
    const textures = Array.from({ length: Math.ceil(values / SH_BYTES) }, () => new Uint8Array(size).fill(SH_ZERO));
    this.textures = textures.length > 0 ? textures : undefined;
    const clamped = textures.map(({ buffer }) => new Uint8ClampedArray(buffer));
    this.places = Array.from({ length: values }, (_, value) => ({
      ...{ array: clamped[Math.floor(value / SH_BYTES)], stride: SH_BYTES, start: value % SH_BYTES },
    }));
  }

  /**
   * @param {number} layer
   * @param {import('../decoder.d.ts').Packed} band
   * @param {number} first splat
   */
  put(layer, band, first) {
    putBand(band, this.places.slice(3 * (layer ** 2 - 1), 3 * ((layer + 1) ** 2 - 1)), first, signed);
  }

  /**
   * @param {number} first splat
   * @param {number} count
   */
  clear(first, count) {
    for (const texels of this.textures ?? []) texels.fill(SH_ZERO, SH_BYTES * first, SH_BYTES * (first + count));
  }
}

/** Map −1 to 1 to a byte. @param {number} value */
const signed = (value) => 127.5 * value + 127.5;

RegisterSceneLoaderPlugin(new CSPLATFileLoader());
