// SPDX-License-Identifier: Apache-2.0
// Levels of detail in engines: what is drawn for a camera, and the pool of splats that it is drawn from. Also: tile_stream,
// splat_pool.
import assert from 'node:assert/strict';
import { test } from 'node:test';

import { CsplatReader } from '../decoder.mjs';
import { openScene } from '../engines/scene.mjs';
import { FADE_STEPS } from '../levels/shown_tiles.mjs';
import { SplatPool, poolSize } from '../levels/splat_pool.mjs';
import { BATCHES, BATCH_BYTES, TileStream } from '../levels/tile_stream.mjs';
import { allTiles } from '../tile_records.mjs';
import { serve, vector } from './helpers.mjs';

const NAMES = [
  'valid/levels_of_the_rich_scene',
  'valid/levels_of_a_tree',
  'valid/levels_of_many_tiles',
  'valid/levels',
];
const TARGET = { name: 'test', engine: 'RUB', mirrors: true, shDegree: 3 };
const PICTURE = { width: 100, height: 100, near: 0.01 };
// prettier-ignore
const PROJECTION = [2, 0, 0, 0, 0, 2, 0, 0, 0, 0, -1, -1, 0, 0, -0.02, 0];

/** Return the matrix, by columns, of a camera at z that looks along −z, in a world of some scale. */
const from = (z, scale = 1) => [scale, 0, 0, 0, 0, scale, 0, 0, 0, 0, scale, 0, 0, 0, -z * scale, 1];

/** Splats as numbers: `owner`: the tile's object by splat; `bands`: those of each splat. */
function recordingArrays(size) {
  const arrays = {
    owner: new Array(size).fill(null),
    shares: new Array(size).fill(0),
    bands: Array.from({ length: size }, () => []),
    flushes: 0,
    end: 0,
  };
  const each = (first, count, act) => {
    for (let i = first; i < first + count; i++) act(i);
  };
  return Object.assign(arrays, {
    put: (tile, first) =>
      each(first, tile.count, (i) => {
        assert.equal(arrays.owner[i], null);
        arrays.owner[i] = tile;
        arrays.shares[i] = FADE_STEPS;
      }),
    fade: (tile, first, shares) =>
      each(first, tile.count, (i) => {
        assert.equal(arrays.owner[i], tile);
        arrays.shares[i] = shares;
      }),
    putBand: (layer, band, first, count) => each(first, count, (i) => arrays.bands[i].push(layer)),
    clear: (first, count) =>
      each(first, count, (i) => {
        arrays.owner[i] = null;
        arrays.bands[i] = [];
      }),
    flush: (changed, faded, end) => {
      arrays.flushes++;
      arrays.end = end;
      assert.ok(changed.length + faded.length > 0);
      for (const [first, count] of [...changed, ...faded]) assert.ok(first >= 0 && first + count <= size);
    },
  });
}

async function drawn(t, source, options = {}) {
  const scene = await openScene(source, { levels: true, workers: 0, pixelError: 0, ...options }, TARGET);
  t.after(() => scene.abort());
  const arrays = recordingArrays(scene.header.splatCount);
  const pool = new SplatPool(scene.header.splatCount, arrays);
  await scene.drawLevels(pool);
  return { scene, arrays, pool, facts: scene.facts(async () => {}) };
}

/** Resolve when all that a camera requires is drawn. */
async function settled(scene, modelView) {
  scene.look(modelView, PROJECTION, PICTURE);
  const { levels } = scene;
  while (!levels.isComplete) {
    await Promise.race([new Promise((resolve) => setTimeout(resolve, 5)), levels.stream.failed]);
  }
}

test('near cameras are drawn from level 0, far ones from the coarsest version, with all bands and nothing twice', async (t) => {
  for (const name of NAMES) {
    const reader = await CsplatReader.open(new Blob([vector(name)]));
    const { header } = reader;
    const all = allTiles(header);
    const splatsOf = (tiles) => tiles.reduce((sum, index) => sum + all[index].splatCount, 0);
    const coarsest = await reader.cut({ level: 255 });
    const { scene, arrays } = await drawn(t, new Blob([vector(name)]), { pixelError: 1e-3 });
    const count = () => arrays.owner.filter(Boolean).length;
    assert.equal(count(), splatsOf(coarsest), name);
    await settled(scene, from(1e9));
    assert.equal(count(), splatsOf(coarsest), name);
    for (const scale of [1, 1e3]) {
      await settled(scene, from(300, scale));
      assert.equal(count(), name === NAMES[0] ? header.splatCount : scene.levels.splatCount, name);
    }
    for (const [i, tile] of arrays.owner.entries()) {
      if (tile) assert.deepEqual(arrays.bands[i].length, tile.sh.filter(Boolean).length);
    }
  }
});

test('a budget bounds the splats that are drawn, and the pool and memory with it', async (t) => {
  const name = 'valid/levels_of_a_tree';
  const { header } = await CsplatReader.open(new Blob([vector(name)]));
  const most = Math.ceil(header.splatCount / 2);
  const { scene, arrays } = await drawn(t, new Blob([vector(name)]), { maxSplats: most });
  const { levels } = scene;
  assert.ok(poolSize(levels.stream) <= Math.ceil(1.125 * levels.stream.budget) + header.splatCount);
  const counts = new Set();
  for (const z of [1e6, 30, 3, 0.3, 1e6, 0.1]) {
    await settled(scene, from(z));
    counts.add(levels.splatCount);
    assert.ok(levels.splatCount <= levels.stream.budget);
    assert.equal(arrays.owner.filter(Boolean).length, levels.splatCount);
    const kept = [...levels.loaded.values()].reduce((sum, { count }) => sum + count, 0);
    assert.ok(kept <= Math.ceil((2 * levels.stream.budget) / 0.9));
  }
});

test('requests and decoded parts wait for those before them, so that a bound in bytes holds', async () => {
  const count = 300;
  const size = 90_000; // bytes of a part
  const tile = (index) => ({
    ...{ index, level: 0, splatCount: 1000, min: [index, 0, 0], max: [index + 1, 1, 1] },
    layers: [0, 1].map((layer) => ({ layer, size, offset: size * (2 * index + layer) })),
  });
  const header = { tiles: Array.from({ length: count }, (_, index) => tile(index)), coarseTiles: [], shDegree: 1 };
  let [requested, taken, decoding, placed] = [0, 0, 0, 0];
  const prefetch = (layers) => {
    requested += size * layers.length;
    assert.ok(requested - taken <= BATCHES * (BATCH_BYTES[1] + size), `${requested - taken} bytes`);
  };
  const reader = { header, prefetch, forget: () => {}, waitedMs: 0, arrivesInOrder: false };
  const aims = { budget: Infinity, pixels: 0, around: true };
  const stream = await TileStream.open(reader, aims, new AbortController().signal, { lanes: 2 });
  const place = async () => {
    placed++;
    await new Promise((resolve) => setTimeout(resolve, placed % 7 ? 0 : 5));
    decoding--;
    taken += size;
  };
  await new Promise((complete, reject) => {
    stream.failed.catch(reject);
    const decode = async () => {
      assert.ok(++decoding <= 2);
      return {};
    };
    stream.sink = { decode, geometry: place, band: place, evict: reject, warn: reject, progress: () => {}, complete };
    stream.setView(null);
  });
  assert.deepEqual([placed, taken], [2 * count, requested]);
});

test('workers read the same layers, and no byte is requested twice', async (t) => {
  const name = 'valid/levels_of_the_rich_scene';
  const { url, requests } = await serve(t, vector(name));
  const alone = await drawn(t, new Blob([vector(name)]));
  const { scene, facts } = await drawn(t, url, { workers: 2, firstBytes: 64 });
  for (const one of [alone.scene, scene]) await settled(one, from(300));
  await facts.complete;
  assert.ok(scene.levels.loaded.size > 1);
  assert.deepEqual(new Map([...scene.levels.loaded].sort()), new Map([...alone.scene.levels.loaded].sort()));
  const ranges = requests.map((range) => range.slice(6).split('-').map(Number)).sort(([a], [b]) => a - b);
  for (const [i, [first]] of ranges.entries()) if (i > 0) assert.ok(first > ranges[i - 1][1], requests.join(' '));
  for (const one of [alone.scene, scene]) one.abort();
  assert.equal(scene.reader, null);
});

test('a pool without a free range that is large enough is put in order', () => {
  const arrays = recordingArrays(10);
  const pool = new SplatPool(10, arrays);
  const tile = (count) => ({ count, sh: [{}, undefined, {}] });
  for (const index of [0, 1, 2, 3]) pool.show(index, tile(2), FADE_STEPS);
  pool.hide(0);
  pool.hide(2);
  pool.show(4, tile(5), 1); // only 2, 2 and 2 are free in a row
  pool.flush();
  assert.equal(arrays.owner.filter(Boolean).length, 9);
  assert.deepEqual([...pool.places.keys()], [1, 3, 4]);
  assert.deepEqual(new Set(arrays.bands.map((bands) => bands.join(' '))), new Set(['1 3', '']));
  assert.deepEqual(arrays.shares.filter((_, i) => arrays.owner[i]).sort(), [1, 1, 1, 1, 1, 8, 8, 8, 8]);
  pool.show(5, tile(2), FADE_STEPS); // no room: it is left out
  pool.hide(5);
  pool.band(1, 2, {});
  pool.flush();
  assert.equal(arrays.flushes, 2);
  assert.equal(arrays.bands.filter((bands) => bands.includes(2)).length, 2);
});

test('files without levels are loaded whole, and a damaged root is an error', async (t) => {
  const scene = await openScene(new Blob([vector('valid/rich')]), { levels: true }, TARGET);
  assert.equal(scene.levels, null);
  scene.release();
  const damaged = vector(NAMES[0]);
  const { coarseTiles } = (await CsplatReader.open(new Blob([damaged]))).header;
  damaged[coarseTiles.at(-1).layers[0].offset + 30] ^= 1;
  await assert.rejects(drawn(t, new Blob([damaged])), { code: 'E_CRC' });
});
