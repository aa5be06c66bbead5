// .csplat in Spark (@sparkjsdev/spark 2.2, three.js): `scene.add(await loadCsplat('scene.csplat'))`. See spark.d.ts.

import { ExtSplats, PackedSplats, SplatMesh } from '@sparkjsdev/spark';

import { CsplatReader } from '../decoder.mjs';
import { ExtWords, PackedWords, halvesSuffice } from './spark-words.mjs';
import { onceSaid, uprightIn } from './unpack.mjs';

/**
 * @typedef {import('../decoder.d.ts').Header} Header
 * @typedef {import('../decoder.d.ts').PackedTile} PackedTile
 * @typedef {import('./spark.d.ts').LoadOptions} LoadOptions
 */

const say = onceSaid('csplat in Spark');

/**
 * @param {Parameters<typeof CsplatReader.open>[0]} from
 * @param {LoadOptions} [options]
 */
export async function loadCsplat(from, { layout, shDegree, ...options } = {}) {
  const reader = await CsplatReader.open(from, options);
  const { header } = reader;
  const degree = Math.min(shDegree ?? header.shDegree, header.shDegree);
  const { signal } = options;
  const read = (/** @type {number} */ index) => reader.readTile(index, { form: 'packed', shDegree: degree, signal });
  const { metadata } = await reader.describe({ signal });
  const make = (layout ?? (halvesSuffice(header) ? 'packed' : 'ext')) === 'packed' ? packed : ext;
  const mesh = await make(header, degree, read);
  place(mesh, header, metadata);
  tell(header);
  return mesh;
}

/**
 * @param {Header} header
 * @param {number} degree
 * @param {(index: number) => Promise<PackedTile>} read
 */
async function ext(header, degree, read) {
  const words = new ExtWords(header, degree);
  for (const { index, first } of header.tiles) words.put(await read(index), first);
  const { extArrays, extra } = words;
  return new SplatMesh({ extSplats: new ExtSplats({ extArrays, extra, numSplats: header.splatCount }) });
}

/**
 * @param {Header} header
 * @param {number} degree
 * @param {(index: number) => Promise<PackedTile>} read
 */
async function packed(header, degree, read) {
  const tiles = [];
  for (const { index } of header.tiles) tiles.push(await read(index));
  const words = new PackedWords(header, degree, tiles);
  for (const { index, first } of header.tiles) words.put(tiles[index], first);
  const { packedArray, extra, splatEncoding } = words;
  const packedSplats = new PackedSplats({ packedArray, extra, numSplats: header.splatCount, splatEncoding });
  return new SplatMesh({ packedSplats, splatEncoding }); // which it would replace by its own
}

/**
 * Stand a mesh upright.
 *
 * @param {SplatMesh} mesh
 * @param {Header} header
 * @param {Record<string, unknown> | null} metadata
 */
function place(mesh, header, metadata) {
  const [a, b, c] = uprightIn(header, metadata, 'RUB');
  const left = a[0] * (b[1] * c[2] - b[2] * c[1]) - a[1] * (b[0] * c[2] - b[2] * c[0]) + a[2] * (b[0] * c[1] - b[1] * c[0]) < 0;
  if (left) say(`axes ${header.axes} are left-handed, and Spark does not mirror splats: left and right are exchanged`);
  const x = left ? -1 : 1;
  mesh.matrix.set(x * a[0], a[1], a[2], 0, x * b[0], b[1], b[2], 0, x * c[0], c[1], c[2], 0, 0, 0, 0, 1);
  mesh.quaternion.setFromRotationMatrix(mesh.matrix);
  mesh.userData.csplat = { header, metadata };
}

/** @param {Header} header */
function tell({ antialiased, extras }) {
  if (!antialiased) {
    say('trained without opacity compensation: give SparkRenderer { preBlurAmount: 0.3, blurAmount: 0 }');
  }
  if (extras.length) say(`extra columns are not drawn: ${extras.map(({ name }) => name).join(', ')}`);
}
