// SPDX-License-Identifier: Apache-2.0
// .csplat in Spark (@sparkjsdev/spark 2.2, three.js): `scene.add(await loadCsplat('scene.csplat'))`. See spark.d.ts.

import { ExtSplats, PackedSplats, SplatMesh } from '@sparkjsdev/spark';
import { DataTexture, Matrix4, Vector3 } from 'three';

import { SplatPool } from '../levels/splat_pool.mjs';
import { openScene } from './scene.mjs';
import { ExtWords, PackedWords, halvesSuffice } from './spark-words.mjs';
import { onceSaid } from './packed_values.mjs';

/**
 * @typedef {import('./options.d.ts').SceneSource} SceneSource
 * @typedef {import('./scene.mjs').Band} Band
 * @typedef {import('./scene.mjs').SplatScene} SplatScene
 * @typedef {import('./spark.d.ts').SparkOptions} SparkOptions
 */

const NAME = 'csplat in Spark';
const LAYERS = /** @type {const} */ ([1, 2, 3]);

/**
 * @param {SceneSource} from
 * @param {SparkOptions} [options]
 */
export async function loadCsplat(from, { layout, ...options } = {}) {
  const scene = await openScene(from, options, { name: NAME, engine: 'RUB', mirrors: false, shDegree: 3 });
  const { header } = scene;
  const isPacked = (layout ?? (halvesSuffice(header) ? 'packed' : 'ext')) === 'packed';
  const { splats, words, mesh } = await (scene.levels ? streamed : isPacked ? packed : ext)(scene);
  turn(mesh, scene.upright);
  mesh.userData.csplat = scene.facts(() => addBands(scene, splats, words, mesh), undefined);
  const dispose = mesh.dispose.bind(mesh);
  mesh.dispose = () => {
    scene.abort();
    dispose();
  };
  if (!header.antialiased) {
    onceSaid(NAME, 'trained without opacity compensation: give SparkRenderer { preBlurAmount: 0.3, blurAmount: 0 }');
  }
  return mesh;
}

/** Build ExtSplats, with float32 centres. @param {SplatScene} scene */
async function ext(scene) {
  const { header } = scene;
  const words = new ExtWords(header);
  /** @type {Band[][]} */
  const bands = [[], [], []];
  for await (const tile of scene.tiles()) {
    words.put(tile, tile.first);
    keepBands(bands, tile);
  }
  if (!scene.progressive) for (const layer of LAYERS.slice(0, scene.degree)) words.addBands(layer, bands[layer - 1]);
  const { extArrays, extra } = words;
  const splats = new ExtSplats({ extArrays, extra, numSplats: header.splatCount });
  return { splats, words, mesh: new SplatMesh({ extSplats: splats }) };
}

/** Build PackedSplats, with float16 centres. @param {SplatScene} scene */
async function packed(scene) {
  const { header } = scene;
  const tiles = [];
  /** @type {Band[][]} */
  const bands = [[], [], []];
  for await (const tile of scene.tiles()) {
    tiles.push(tile);
    keepBands(bands, tile);
  }
  const words = new PackedWords(header, tiles);
  for (const tile of tiles) words.put(tile, tile.first);
  if (!scene.progressive) for (const layer of LAYERS.slice(0, scene.degree)) words.addBands(layer, bands[layer - 1]);
  const { packedArray, extra, splatEncoding } = words;
  const splats = new PackedSplats({ packedArray, extra, numSplats: header.splatCount, splatEncoding });
  return { splats, words, mesh: new SplatMesh({ packedSplats: splats, splatEncoding }) }; // without this, SplatMesh uses an encoding of its own
}

/**
 * Build ExtSplats of the tiles that the camera requires: PackedSplats would need the ranges of all values.
 *
 * @param {SplatScene} scene
 */
async function streamed(scene) {
  const words = new ExtWords(scene.header);
  for (const layer of LAYERS.slice(0, scene.degree)) words.addBands(layer, []);
  const { extArrays, extra } = words;
  const splats = new ExtSplats({ extArrays, extra: { ...extra }, numSplats: 0 }); // it adds its textures to `extra`
  const mesh = new SplatMesh({ extSplats: splats });
  /** @type {[number, number][]} */
  let changed = [];
  /** @type {[number, number][]} */
  let faded = [];
  const pool = new SplatPool(scene.header.splatCount, {
    put: (tile, first) => words.put(tile, first),
    fade: (tile, first, shares) => words.fade(tile, first, shares),
    putBand: (layer, sh, first, count) => words.putBand(layer, { sh, first, count }),
    clear: (first, count) => words.clear(first, count),
    flush: (ranges, opacities, end) => {
      changed.push(...ranges);
      faded.push(...ranges, ...opacities);
      splats.numSplats = end;
      mesh.needsUpdate = true;
    },
  });
  const { frameUpdate } = mesh;
  const modelView = new Matrix4();
  mesh.frameUpdate = (frame) => {
    const { camera, renderer, renderSize } = frame;
    const [first, second] = splats.textures;
    const sh = Object.values(splats.extra).flatMap((/** @type {any} */ one) => one.value ?? []);
    for (const texture of changed.length ? [second, ...sh] : []) upload(renderer, texture, changed);
    upload(renderer, first, faded);
    changed = [];
    faded = [];
    modelView.multiplyMatrices(camera.matrixWorldInverse, mesh.matrixWorld);
    const picture = { width: renderSize.x, height: renderSize.y, near: camera.near };
    scene.look(modelView.elements, camera.projectionMatrix.elements, picture);
    frameUpdate?.(frame);
  };
  await scene.drawLevels(pool);
  return { splats, words, mesh };
}

/**
 * Upload rows of an array texture. Spark itself uploads textures whole.
 *
 * @param {import('three').WebGLRenderer} renderer
 * @param {import('three').DataArrayTexture} texture
 * @param {[number, number][]} changed ranges of texels
 */
function upload(renderer, texture, changed) {
  const { width, height, data } = texture.image;
  const words = new Uint32Array(data.buffer);
  const rows = new Set(
    changed.flatMap(([first, count]) => {
      const start = Math.floor(first / width);
      return Array.from({ length: Math.ceil((first + count) / width) - start }, (_, i) => start + i);
    }),
  );
  const sorted = [...rows].sort((a, b) => a - b);
  while (sorted.length > 0) {
    const start = sorted[0];
    let count = 1;
    while (sorted[count] === start + count && (start + count) % height !== 0) count++;
    sorted.splice(0, count);
    const some = words.subarray(4 * width * start, 4 * width * (start + count));
    const source = new DataTexture(some, width, count, texture.format, texture.type);
    renderer.copyTextureToTexture(source, texture, null, new Vector3(0, start % height, Math.floor(start / height)));
  }
}

/**
 * @param {Band[][]} bands
 * @param {import('../decoder.d.ts').PackedTile & {first: number}} tile
 */
function keepBands(bands, { sh, first, count }) {
  for (const [i, band] of sh.entries()) if (band) bands[i].push({ first, count, sh: band });
}

/**
 * Add the SH bands of a progressive load.
 *
 * @param {SplatScene} scene
 * @param {ExtSplats | PackedSplats} splats
 * @param {ExtWords | PackedWords} words
 * @param {SplatMesh} mesh
 */
async function addBands(scene, splats, words, mesh) {
  for (const layer of LAYERS.slice(0, scene.degree)) {
    const bands = [];
    for await (const band of scene.bands(layer)) bands.push(band);
    words.addBands(layer, bands);
  }
  splats.extra = words.extra;
  mesh.updateGenerator();
}

/**
 * @param {SplatMesh} mesh
 * @param {number[][]} upright
 */
function turn(mesh, [a, b, c]) {
  mesh.matrix.set(a[0], a[1], a[2], 0, b[0], b[1], b[2], 0, c[0], c[1], c[2], 0, 0, 0, 0, 1);
  mesh.quaternion.setFromRotationMatrix(mesh.matrix);
}
