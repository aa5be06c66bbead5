// The order in which a file is read, and the events on the way.
import assert from 'node:assert/strict';
import { readFileSync } from 'node:fs';
import { test } from 'node:test';

import { readHeader } from '../../../codec/js/decoder.mjs';
import { coarseBounds, fineBounds, weightedQuantile } from '../bounds.mjs';
import { viewOf } from '../camera_maths.mjs';
import { load, tileOrder } from '../loader.mjs';

const VECTORS = new URL('../../../conformance/csplat_conformance/vectors/', import.meta.url);
const bytes = (name) => readFileSync(new URL(`${name}.csplat`, VECTORS));

/** Return all events of a sink. */
async function loaded(source, signal = new AbortController().signal) {
  const events = [];
  const sink = {
    header: (header) => events.push({ type: 'header', header }),
    geometry: (tile, texels, cull, samples) => events.push({ type: 'geometry', tile, layer: 0, texels, cull, samples }),
    table: (codebook, layer) => events.push({ type: 'table', codebook, layer }),
    band: (tile, layer, band) => events.push({ type: 'band', tile, layer, band }),
    progress: (progress) => events.push({ type: 'progress', ...progress }),
    view: () => null,
  };
  await load(source, sink, signal);
  return events;
}

test('layer 0 of all tiles comes first, then band after band', async () => {
  const events = await loaded(new Blob([bytes('valid/rich')]));
  const { header } = events.find(({ type }) => type === 'header');
  const layers = events.filter(({ type }) => type === 'geometry' || type === 'band').map(({ layer }) => layer);
  assert.deepEqual(layers, [...layers].sort());
  assert.equal(layers.filter((layer) => layer === 0).length, header.tiles.length);
  assert.equal(layers.length, header.tiles.flatMap((tile) => tile.layers.filter(({ layer }) => layer < 8)).length);
});

test('a table is passed on once, before the first band that needs it', async () => {
  const events = await loaded(new Blob([bytes('valid/codebook_sh_1_3')]));
  const tables = events.filter(({ type }) => type === 'table').map(({ layer }) => layer);
  assert.deepEqual(tables, [1, 2, 3]);
  for (const layer of tables) {
    const table = events.findIndex((event) => event.type === 'table' && event.layer === layer);
    assert.ok(table < events.findIndex((event) => event.type === 'band' && event.layer === layer));
  }
});

test('progress ends at the totals', async () => {
  for (const source of [new Blob([bytes('valid/rich')]), new Uint8Array(bytes('valid/rich')).buffer]) {
    const events = await loaded(source);
    const { received, fileSize, splatsDone, splatCount } = events.at(-1);
    assert.equal(received, fileSize);
    assert.equal(splatsDone, splatCount);
    const amounts = events.filter(({ type }) => type === 'progress').map((one) => one.received);
    assert.deepEqual(
      amounts,
      [...amounts].sort((a, b) => a - b),
    );
  }
});

test('an abort ends the reading', async () => {
  await assert.rejects(loaded(new Blob([bytes('valid/rich')]), AbortSignal.abort(new Error('enough'))), /enough/);
});

test('a damaged file is refused with its code', async () => {
  const damaged = Uint8Array.from(bytes('valid/rich'));
  damaged[readHeader(damaged).tiles[0].layers[1].offset + 20] ^= 1;
  await assert.rejects(loaded(damaged.buffer), { code: 'E_CRC' });
});

test('slots of tiles and of their cull data match', async () => {
  const events = await loaded(new Blob([bytes('valid/rich')]));
  const tiles = events.filter(({ type }) => type === 'geometry');
  let end = 0;
  for (const { cull, texels } of tiles) {
    assert.equal(cull.slot % 64, 0);
    assert.ok(cull.slot >= end);
    end = cull.slot + cull.count;
    assert.equal(cull.reaches.length, texels.count);
    assert.equal(cull.means.length, 3 * texels.count);
  }
});

test('tiles nearest to the camera come first, tiles behind it last', () => {
  const tile = (z) => ({ min: [-1, -1, z - 1], max: [1, 1, z + 1] });
  const tiles = [tile(90), tile(-20), tile(3), tile(10)];
  const view = viewOf(
    { viewmat: [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1], fx: 9, fy: 9, cx: 5, cy: 5 },
    10,
    10,
  );
  assert.deepEqual(tileOrder(tiles, view), [tiles[2], tiles[3], tiles[0], tiles[1]]);
  assert.deepEqual(tileOrder(tiles, null), tiles);
});

test('bounds come from boxes first, then from samples', async () => {
  const events = await loaded(new Blob([bytes('valid/rich')]));
  const { header } = events[events.findIndex(({ type }) => type === 'header')];
  const coarse = coarseBounds(header);
  assert.equal(coarse.coarse, true);
  assert.ok(coarse.radius > 0);
  const samples = events.filter(({ type }) => type === 'geometry').flatMap((one) => [...one.samples.points]);
  const fine = fineBounds(header, Float32Array.from(samples), new Float32Array(samples.length / 3).fill(1));
  assert.equal(samples.length, 3 * header.splatCount);
  for (let axis = 0; axis < 3; axis++) {
    const values = samples.filter((_, i) => i % 3 === axis);
    assert.equal(fine.boxMin[axis], Math.min(...values));
    assert.equal(fine.boxMax[axis], Math.max(...values));
    assert.ok(fine.centre[axis] >= fine.boxMin[axis] && fine.centre[axis] <= fine.boxMax[axis]);
  }
  assert.deepEqual(fineBounds({ tiles: [] }, new Float32Array(0), new Float32Array(0)).centre, [0, 0, 0]);
});

test('weighted quantiles', () => {
  const at = (share) => weightedQuantile(Float64Array.of(3, 1, 2), Float32Array.of(1, 1, 2), share);
  assert.deepEqual([0, 0.25, 0.5, 0.75, 1].map(at), [1, 1, 2, 2, 3]);
});

test('of a file with levels, coarser ones come first, and bands of level 0 alone', async () => {
  const source = bytes('valid/levels_of_the_rich_scene');
  const levels = new Map(
    [...readHeader(source).tiles, ...readHeader(source).coarseTiles].map((one) => [one.index, one.level]),
  );
  const events = await loaded(new Blob([source]));
  const geometry = events.filter(({ type }) => type === 'geometry');
  const order = geometry.map(({ tile }) => levels.get(tile));
  assert.ok(new Set(order).size > 1);
  assert.deepEqual(
    order,
    [...order].sort((a, b) => b - a),
  );
  assert.equal(geometry.length, levels.size);
  for (const { tile, texels, cull, samples } of geometry) {
    assert.equal(cull.index, tile);
    assert.equal(cull.count, texels.count);
    const isSampled = [0, Math.max(...levels.values())].includes(levels.get(tile));
    assert.equal(samples.weights.length > 0, isSampled);
  }
  for (const { tile } of events.filter(({ type }) => type === 'band')) assert.equal(levels.get(tile), 0);
});
