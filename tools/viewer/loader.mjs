// Reads a file for the viewer: layer 0 of all tiles first, those of coarser levels before, then the SH bands of level 0.
// Packs each part for the GPU as it arrives.

import { CsplatReader } from '../../codec/js/decoder.mjs';
import { allTiles } from '../../codec/js/tile_records.mjs';
import { SAMPLE_COUNT, showing } from './bounds.mjs';
import { toCamera } from './camera_maths.mjs';
import { reachClass } from './cull.mjs';
import { layoutSlots, packBand, packGeometry, packRows } from './texels.mjs';

/**
 * @typedef {import('../../codec/js/decoder.d.ts').Header} Header
 * @typedef {import('../../codec/js/decoder.d.ts').PackedGeometry} PackedGeometry
 * @typedef {import('../../codec/js/decoder.d.ts').TileRecord} TileRecord
 * @typedef {import('./cull.mjs').CullTile} CullTile
 * @typedef {import('./texels.mjs').BandTexels} BandTexels
 * @typedef {import('./texels.mjs').GeometryTexels} GeometryTexels
 * @typedef {import('./texels.mjs').Rows} Rows
 * @typedef {import('./types.d.ts').View} View
 *
 * Receives the parts of a file.
 *
 * @typedef {object} Sink
 * @property {(header: Header, description: any, nodes: import('./types.d.ts').TreeNode[], roots: number) => void} header
 *   nodes of the levels of detail, none if the file has no levels; number of tiles of the coarsest version
 * @property {(tile: number, texels: GeometryTexels, cull: CullTile, samples: Samples) => void} geometry samples of level 0,
 *   and of the coarsest version, which comes first
 * @property {(codebook: number, layer: number, rows: Rows) => void} table
 * @property {(tile: number, layer: number, band: BandTexels) => void} band
 * @property {(progress: {phase: 'open' | 'layers', received: number, fileSize: number, splatsDone: number,
 *   splatCount: number, layer: number, decodeMs: number}) => void} progress
 * @property {() => View | null} view returns the current camera
 *
 * @typedef {{points: Float32Array<ArrayBuffer>, weights: Float32Array<ArrayBuffer>}} Samples
 */

/** Bytes of a group of layers; one group is fetched ahead of the one being decoded. */
const GROUP_BYTES = 1 << 19;

/**
 * Read a whole file.
 *
 * @param {string | Blob | ArrayBuffer} source
 * @param {Sink} sink
 * @param {AbortSignal} signal
 */
export async function load(source, sink, signal) {
  const state = { received: 0, fileSize: 0, splatsDone: 0, splatCount: 0, decodeMs: 0 };
  const tell = (/** @type {number} */ layer) =>
    sink.progress({ phase: state.fileSize ? 'layers' : 'open', layer, ...state });
  const reader = await CsplatReader.open(source, {
    signal,
    onProgress: (received) => {
      state.received = received;
      tell(0);
    },
  });
  const { header } = reader;
  const description = await reader.describe({ signal });
  const nodes = header.coarseTiles.length > 0 ? await reader.nodes() : [];
  Object.assign(state, { fileSize: header.fileSize, splatCount: header.splatCount });
  const isLocal = typeof source !== 'string'; // the decoder then reports no received bytes
  if (isLocal) state.received = header.indexSize;
  const roots = new Set(coarsestTiles(header, nodes));
  sink.header(header, description, nodes, roots.size);
  tell(0);
  const order = tileOrder(header.tiles, sink.view());
  const coarse = tileOrder(header.coarseTiles, sink.view()).sort((a, b) => b.level - a.level);
  const tables = new Set();
  const { starts } = layoutSlots(allTiles(header));
  for (let layer = 0; layer <= header.shDegree; layer++) {
    const wanted = layer === 0 ? [...coarse, ...order] : order;
    for await (const tile of fetched(reader, wanted, layer, signal)) {
      const begun = performance.now() - reader.waitedMs;
      if (layer === 0) await readGeometry(reader, tile, starts[tile.index], roots.has(tile), sink, signal);
      else await readBand(reader, tile, layer, tables, sink, signal);
      state.decodeMs += performance.now() - reader.waitedMs - begun;
      if (layer === 0 && tile.level === 0) state.splatsDone += tile.splatCount;
      if (isLocal) state.received += tile.layers.find((one) => one.layer === layer)?.size ?? 0;
      tell(layer);
    }
  }
  if (isLocal) {
    state.received = header.fileSize;
    tell(header.shDegree);
  }
}

/**
 * Sort tiles by distance from the camera, nearest first; keep the order of the file without a camera.
 *
 * @param {TileRecord[]} tiles
 * @param {View | null} view
 */
export function tileOrder(tiles, view) {
  if (view === null) return [...tiles];
  const distance = (/** @type {TileRecord} */ { min, max }) => {
    const centre = [0, 1, 2].map((axis) => (min[axis] + max[axis]) / 2);
    const half = Math.hypot(max[0] - min[0], max[1] - min[1], max[2] - min[2]) / 2;
    const [x, y, z] = toCamera(view.viewmat, centre);
    return Math.hypot(x, y, z) + (z < -half ? 1e30 : 0) - half; // tiles behind the camera come last
  };
  const far = new Map(tiles.map((tile) => [tile, distance(tile)]));
  return [...tiles].sort((a, b) => Number(far.get(a)) - Number(far.get(b)));
}

/**
 * Yield the tiles that have a layer, each once its bytes have been requested.
 *
 * @param {CsplatReader} reader
 * @param {TileRecord[]} order
 * @param {number} layer
 * @param {AbortSignal} signal
 */
async function* fetched(reader, order, layer, signal) {
  /** @type {TileRecord[][]} */
  const groups = [];
  let bytes = Infinity;
  for (const tile of order) {
    const place = tile.layers.find((one) => one.layer === layer);
    if (place === undefined) continue;
    if (bytes >= GROUP_BYTES) {
      groups.push([]);
      bytes = 0;
    }
    groups[groups.length - 1].push(tile);
    bytes += place.size;
  }
  const ask = (/** @type {TileRecord[] | undefined} */ group) => {
    if (group)
      reader.prefetch(
        group.map(({ index }) => ({ tile: index, layer })),
        { signal },
      );
  };
  ask(groups[0]);
  for (const [i, group] of groups.entries()) {
    ask(groups[i + 1]);
    yield* group;
  }
}

/**
 * @param {CsplatReader} reader
 * @param {TileRecord} tile
 * @param {number} slot slot of its first splat
 * @param {boolean} isRoot whether it is of the coarsest version
 * @param {Sink} sink
 * @param {AbortSignal} signal
 */
async function readGeometry(reader, tile, slot, isRoot, sink, signal) {
  const { index } = tile;
  /** @type {PackedGeometry} */
  const packed = await reader.readLayer(index, 0, { form: 'packed', signal });
  const [opacities, , quats] = reader.header.attributes;
  const texels = packGeometry(packed, opacities, quats);
  const stride = isRoot ? 1 : Math.max(1, Math.floor(reader.header.splatCount / SAMPLE_COUNT));
  const alphas = alphasOf(packed, opacities);
  const samples = isRoot || tile.level === 0 ? samplesOf(packed, alphas, stride) : noSamples();
  sink.geometry(index, texels, cullTile(packed, alphas, tile, slot), samples);
}

/**
 * @param {PackedGeometry} packed
 * @param {{levels: number, mapping: string}} record
 */
function alphasOf({ opacities: { columns, offsets }, count }, { levels, mapping }) {
  const alphas = new Float32Array(count);
  for (let i = 0; i < count; i++) alphas[i] = (offsets[0] + columns[i]) / levels;
  if (mapping === 'square') for (let i = 0; i < count; i++) alphas[i] *= alphas[i];
  return alphas;
}

/**
 * Return the log-scale of a splat in a column.
 *
 * @param {PackedGeometry} packed
 * @param {number} column
 * @param {number} i
 */
const logScale = ({ scales: { columns, offsets, step }, count }, column, i) =>
  (offsets[column] + columns[column * count + i]) * step;

/**
 * @param {PackedGeometry} packed
 * @param {Float32Array} alphas
 * @param {TileRecord} tile
 * @param {number} slot
 * @returns {CullTile}
 */
function cullTile(packed, alphas, { index, extent, maxScale }, slot) {
  const { count, means } = packed;
  const reaches = new Uint8Array(count);
  for (let i = 0; i < count; i++) {
    const largest = Math.max(logScale(packed, 0, i), logScale(packed, 1, i), logScale(packed, 2, i));
    reaches[i] = reachClass(alphas[i], largest);
  }
  const reach = 4 * Math.exp(maxScale); // 4 exceeds REACH_MAX plus the rounding of the classes
  return { index, count, slot, means: means.columns, corner: means.offsets, step: means.step, extent, reach, reaches };
}

/**
 * Return the tiles of the coarsest version of a scene with levels of detail.
 *
 * @param {Header} header
 * @param {import('./types.d.ts').TreeNode[]} nodes
 */
function coarsestTiles(header, nodes) {
  const tiles = allTiles(header);
  const roots = nodes.filter(({ parent }) => parent === null);
  return roots.flatMap(({ firstTile, tileCount }) => tiles.slice(firstTile, firstTile + tileCount));
}

/** @returns {Samples} */
const noSamples = () => ({ points: new Float32Array(0), weights: new Float32Array(0) });

/**
 * Sample every `stride`-th splat.
 *
 * @param {PackedGeometry} packed
 * @param {Float32Array} alphas
 * @param {number} stride
 * @returns {Samples}
 */
function samplesOf(packed, alphas, stride) {
  const { count, means } = packed;
  const n = Math.ceil(count / stride);
  const points = new Float32Array(3 * n);
  const weights = new Float32Array(n);
  for (let k = 0, i = 0; k < n; k++, i += stride) {
    for (let axis = 0; axis < 3; axis++) {
      points[3 * k + axis] = (means.offsets[axis] + means.columns[axis * count + i]) * means.step;
    }
    const [, b, c] = [0, 1, 2].map((column) => logScale(packed, column, i)).sort((x, y) => x - y);
    weights[k] = showing(alphas[i], b, c);
  }
  return { points, weights };
}

/**
 * @param {CsplatReader} reader
 * @param {TileRecord} tile
 * @param {number} layer
 * @param {Set<string>} tables tables that the sink has received
 * @param {Sink} sink
 * @param {AbortSignal} signal
 */
async function readBand(reader, tile, layer, tables, sink, signal) {
  /** @type {import('../../codec/js/decoder.d.ts').PackedBand} */
  const { sh, count } = await reader.readLayer(tile.index, layer, { form: 'packed', signal });
  if (sh.lookup) {
    const key = `${sh.lookup.codebook}.${layer}`;
    if (!tables.has(key)) sink.table(sh.lookup.codebook, layer, packRows(sh.lookup.table));
    tables.add(key);
  }
  sink.band(tile.index, layer, packBand(sh, count));
}
