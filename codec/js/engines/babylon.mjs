// A plugin of Babylon.js's scene loader for .csplat; to import this module registers it.
//
//   import 'csplat-decoder/babylon';
//   const { meshes: [splats] } = await ImportMeshAsync('scene.csplat', scene);

import { AssetContainer } from '@babylonjs/core/assetContainer.js';
import { RegisterSceneLoaderPlugin } from '@babylonjs/core/Loading/sceneLoader.js';
import { Matrix, Quaternion } from '@babylonjs/core/Maths/math.vector.js';
import { GaussianSplattingMesh } from '@babylonjs/core/Meshes/GaussianSplatting/gaussianSplattingMesh.js';

import { CsplatReader } from '../decoder.mjs';
import { alphaOf, displayColour, onceSaid, places, putBand, putColumns, putQuats, upOf, uprightIn } from './unpack.mjs';

const NAME = 'csplat';
const ROW_BYTES = 32; // centre and scales as float32, colour, alpha and rotation as bytes
const SH_BYTES = 16; // of a splat in one texture
const SH_ZERO = 128;

const say = onceSaid('csplat for Babylon.js');

/**
 * @typedef {import('@babylonjs/core/scene.js').Scene} Scene
 * @typedef {import('../decoder.d.ts').Header} Header
 */

/** The plugin. `keepInRam` as GaussianSplattingMesh has it. */
export class CSPLATFileLoader {
  /** @param {{keepInRam?: boolean}} [options] */
  constructor({ keepInRam = false } = {}) {
    this.name = NAME;
    this.extensions = { '.csplat': { isBinary: true, mimeType: 'model/vnd.csplat' } };
    this.keepInRam = keepInRam;
  }

  /** @param {Record<string, any>} options of all plugins, by their names */
  createPlugin(options) {
    return new CSPLATFileLoader(options[NAME]);
  }

  /**
   * @param {unknown} _names
   * @param {Scene} scene
   * @param {ArrayBuffer | Uint8Array<ArrayBuffer>} data a file
   */
  async importMeshAsync(_names, scene, data) {
    const reader = await CsplatReader.open(data instanceof ArrayBuffer ? data : new Blob([data]));
    const { metadata } = await reader.describe();
    const { rows, sh } = await arraysOf(reader, scene.getEngine().getCaps().maxTextureSize);
    const meshes = [await meshOf(scene, reader.header, metadata, rows, sh, this.keepInRam)];
    const none = { particleSystems: [], skeletons: [], animationGroups: [], transformNodes: [] };
    return { meshes, ...none, geometries: [], lights: [], spriteManagers: [] };
  }

  /**
   * @param {Scene} scene
   * @param {ArrayBuffer | Uint8Array<ArrayBuffer>} data
   */
  async loadAsync(scene, data) {
    await this.importMeshAsync(null, scene, data);
  }

  /**
   * @param {Scene} scene
   * @param {ArrayBuffer | Uint8Array<ArrayBuffer>} data
   */
  async loadAssetContainerAsync(scene, data) {
    const { meshes } = await this.importMeshAsync(null, scene, data);
    const container = new AssetContainer(scene);
    container.meshes.push(...meshes);
    container.removeAllFromScene();
    return container;
  }
}

/**
 * What a mesh is filled with: a row for each splat, and the textures of SH.
 *
 * @param {CsplatReader} reader
 * @param {number} width of textures
 */
async function arraysOf(reader, width) {
  const { header } = reader;
  const { splatCount: count, shDegree } = header;
  const rows = new ArrayBuffer(ROW_BYTES * count);
  const numbers = places(new Float32Array(rows), ROW_BYTES / 4, 0, 6);
  const bytes = places(new Uint8ClampedArray(rows), ROW_BYTES, 24, 8);
  const [centreAt, scalesAt] = [numbers.slice(0, 3), numbers.slice(3)];
  const [colourAt, alphaAt, quatAt] = [bytes.slice(0, 3), bytes.slice(3, 4), bytes.slice(4)];
  const values = 3 * ((shDegree + 1) ** 2 - 1);
  const textureBytes = SH_BYTES * width * (Math.floor(count / width) + 1); // a splat more than there are, as the mesh has it
  const sh = Array.from({ length: Math.ceil(values / SH_BYTES) }, () => new Uint8Array(textureBytes).fill(SH_ZERO));
  const clamped = sh.map(({ buffer }) => new Uint8ClampedArray(buffer));
  const shAt = Array.from({ length: values }, (_, value) => ({
    ...{ array: clamped[Math.floor(value / SH_BYTES)], stride: SH_BYTES, start: value % SH_BYTES },
  }));
  const alpha = alphaOf(header);
  const signed = (/** @type {number} */ value) => 127.5 * value + 127.5;
  for (const { index, first } of header.tiles) {
    const tile = await reader.readTile(index, { form: 'packed' });
    putColumns(tile.means, centreAt, first, (value) => value);
    putColumns(tile.scales, scalesAt, first, Math.exp);
    putBand(tile.sh0, colourAt, first, (value) => 255 * displayColour(value));
    putColumns(tile.opacities, alphaAt, first, (q) => 255 * alpha(q));
    putQuats(tile.quats, header, quatAt, first, signed);
    for (const [i, band] of tile.sh.entries()) {
      if (band) putBand(band, shAt.slice(3 * ((i + 1) ** 2 - 1), 3 * ((i + 2) ** 2 - 1)), first, signed);
    }
  }
  return { rows, sh };
}

/**
 * @param {Scene} scene
 * @param {Header} header
 * @param {Record<string, unknown> | null} metadata
 * @param {ArrayBuffer} rows
 * @param {Uint8Array[]} sh
 * @param {boolean} keepInRam
 */
async function meshOf(scene, header, metadata, rows, sh, keepInRam) {
  const { axes, antialiased, origin, unitMetres, shDegree, extras } = header;
  if (scene.isDisposed) throw new Error('the scene was disposed of before its splats had come');
  const mesh = new GaussianSplattingMesh('GaussianSplatting', null, scene, keepInRam);
  try {
    if (antialiased) /** @type {any} */ (mesh.material).compensation = true;
    await mesh.updateDataAsync(rows, sh.length > 0 ? sh : undefined, undefined, shDegree);
    const [a, b, c] = uprightIn(header, metadata, scene.useRightHandedSystem ? 'RUB' : 'RUF');
    // Babylon's vectors are rows: column by column.
    const upright = Matrix.FromValues(a[0], b[0], c[0], 0, a[1], b[1], c[1], 0, a[2], b[2], c[2], 0, 0, 0, 0, 1);
    mesh.rotationQuaternion = new Quaternion();
    upright.decompose(mesh.scaling, mesh.rotationQuaternion);
    mesh.computeWorldMatrix(true);
    mesh.metadata = { csplat: { axes, antialiased, origin, unitMetres, up: upOf(metadata), metadata } };
  } catch (error) {
    mesh.dispose(false, true); // with its material
    throw error;
  }
  if (extras.length > 0) say('extra columns are left out');
  return mesh;
}

RegisterSceneLoaderPlugin(new CSPLATFileLoader());
