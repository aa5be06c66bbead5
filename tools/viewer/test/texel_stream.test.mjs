// SPDX-License-Identifier: Apache-2.0
// The order in which a file is read, and the events on the way.
import assert from 'node:assert/strict';
import { readFileSync, readdirSync } from 'node:fs';
import { test } from 'node:test';

import { readHeader } from '../../../codec/js/decoder.mjs';
import { HEADER_SIZE } from '../../../codec/js/spec.mjs';
import { coarseBounds, fineBounds, weightedQuantile } from '../bounds.mjs';
import { viewOf } from '../camera_maths.mjs';
import { loadedShare } from '../statistics.mjs';
import { TexelStream } from '../texel_stream.mjs';

const VECTORS = new URL('../../../conformance/csplat_conformance/vectors/', import.meta.url);
const bytes = (name) => readFileSync(new URL(`${name}.csplat`, VECTORS));
const AIMS = { budget: Infinity, pixels: 0, around: true };

/** A camera at z that looks along +z. */
const viewFrom = (z) => {
  const viewmat = [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, -z, 0, 0, 0, 1];
  return viewOf({ viewmat, fx: 90, fy: 90, cx: 50, cy: 50 }, 100, 100);
};

/** A sink that collects events, and resolves `done` when everything is here. */
function collector() {
  const events = [];
  const sink = {
    events,
    header: (opened) => events.push({ type: 'header', ...opened }),
    geometry: (tile, texels, cull, samples) => events.push({ type: 'geometry', tile, layer: 0, texels, cull, samples }),
    table: (codebook, layer) => events.push({ type: 'table', codebook, layer }),
    band: (tile, layer, band) => events.push({ type: 'band', tile, layer, band }),
    evict: (tile) => events.push({ type: 'evict', tile }),
    progress: (progress) => events.push({ type: 'progress', ...progress }),
    warn: (error) => events.push({ type: 'warn', error }),
    complete: () => sink.resolve?.(),
  };
  return sink;
}

/** Resolve when everything that a view requires is here. */
async function seen({ tiles }, sink, view) {
  const done = new Promise((resolve) => (sink.resolve = resolve));
  tiles.isComplete = false;
  tiles.setView(view);
  await Promise.race([done, tiles.failed]);
}

/** Return all events of reading a file for a camera. */
async function loaded(source, { signal = new AbortController().signal, aims = AIMS, view = viewFrom(-1e4) } = {}) {
  const sink = collector();
  const stream = await TexelStream.open(source, sink, aims, signal);
  await seen(stream, sink, view);
  return sink.events;
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
    assert.ok(received > 0.8 * fileSize && received <= fileSize); // extra columns are not read
    assert.equal(splatsDone, splatCount);
    const amounts = events.filter(({ type }) => type === 'progress').map((one) => one.received);
    assert.deepEqual(
      amounts,
      [...amounts].sort((a, b) => a - b),
    );
  }
});

test('the loaded share rises from 0 to 1', async () => {
  for (const name of ['valid/rich', 'valid/levels']) {
    const sink = collector();
    const stream = await TexelStream.open(new Blob([bytes(name)]), sink, AIMS, new AbortController().signal);
    for (const view of name === 'valid/levels' ? [null, viewFrom(-1e4)] : [viewFrom(-1e4)]) {
      await seen(stream, sink, view);
    }
    const shares = sink.events.filter(({ type }) => type === 'progress').map(loadedShare);
    assert.deepEqual([shares[0], shares.at(-1)], [0, 1]);
    assert.ok(shares.length > 4 && shares.filter((share) => share === 1).length <= 2, `${shares}`);
    assert.deepEqual(
      shares,
      [...shares].sort((a, b) => a - b),
    );
  }
});

test('an abort ends the reading', async () => {
  await assert.rejects(
    loaded(new Blob([bytes('valid/rich')]), { signal: AbortSignal.abort(new Error('enough')) }),
    /enough/,
  );
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
    assert.equal(cull.slot % 256, 0);
    assert.ok(cull.slot >= end);
    end = cull.slot + cull.count;
    assert.equal(cull.reaches.length, texels.count);
    assert.equal(cull.means.length, 3 * texels.count);
  }
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

/** A server that sends ranges of a file; `requests` lists them, `options` requests only header and index first. */
function served(data, { fails = () => false } = {}) {
  const { indexSize } = readHeader(data);
  const requests = [];
  const fetch = async (_, { headers, signal }) => {
    const range = /bytes=(\d+)-(\d+)/.exec(headers.get('Range') ?? '');
    const [start, last] = range ? range.slice(1).map(Number) : [0, data.length];
    const end = last + 1;
    requests.push({ start, end });
    await new Promise((resolve) => setTimeout(resolve, 1));
    signal?.throwIfAborted();
    if (fails(requests.length)) throw new TypeError('failed to fetch');
    const body = data.subarray(start, end);
    if (!range) return new Response(data);
    const sent = `bytes ${start}-${start + body.length - 1}/${data.length}`;
    return new Response(body, { status: 206, headers: { 'content-range': sent } });
  };
  return { requests, fetch, options: { fetch, firstBytes: HEADER_SIZE + indexSize, retryMs: 0 } };
}

async function until(holds) {
  while (!holds()) await new Promise((resolve) => setTimeout(resolve, 1));
}

const LEVELS = bytes('valid/levels_of_the_rich_scene');
const levelOf = new Map(
  [...readHeader(LEVELS).tiles, ...readHeader(LEVELS).coarseTiles].map((one) => [one.index, one.level]),
);
const tilesIn = (events) => events.filter(({ type }) => type === 'geometry').map(({ tile }) => tile);

test('of a file with levels, the coarsest version comes first, and no node before its parent', async () => {
  const events = await loaded(new Blob([LEVELS]), { view: viewFrom(-300) });
  const [{ roots }] = events.filter(({ type }) => type === 'header');
  const order = tilesIn(events);
  assert.equal(order.length, levelOf.size);
  const coarsest = Math.max(...levelOf.values());
  assert.equal(new Set(order.slice(0, roots)).size, [...levelOf.values()].filter((one) => one === coarsest).length);
  for (const { tile, texels, cull, samples } of events.filter(({ type }) => type === 'geometry')) {
    assert.equal(cull.index, tile);
    assert.equal(cull.count, texels.count);
    assert.equal(samples.weights.length > 0, levelOf.get(tile) === coarsest);
  }
  const drawn = events.filter(({ type }) => type === 'band').map(({ tile }) => levelOf.get(tile));
  assert.ok(drawn.length > 0);
  assert.ok(drawn.every((level) => level === 0)); // those that are exchanged for finer ones need no bands
});

test('a view from far away requires the coarsest version alone', async () => {
  const events = await loaded(new Blob([LEVELS]), { aims: { ...AIMS, pixels: 1 } });
  const coarsest = Math.max(...levelOf.values());
  assert.ok(tilesIn(events).length > 0);
  assert.ok(tilesIn(events).every((tile) => levelOf.get(tile) === coarsest));
});

test('no part is requested twice, and what is seen later is requested then', async () => {
  const { options } = served(LEVELS);
  const sink = collector();
  const aims = { ...AIMS, around: false };
  const { signal } = new AbortController();
  const stream = await TexelStream.open('http://example.test/a', sink, aims, signal, options);
  const parts = [];
  const { prefetch } = stream.reader;
  stream.reader.prefetch = (wanted, options) => {
    parts.push(...wanted.map(({ tile, layer }) => `${tile}.${layer}`));
    prefetch.call(stream.reader, wanted, options);
  };
  await seen(stream, sink, viewFrom(1e6)); // behind the camera
  const before = parts.length;
  await seen(stream, sink, viewFrom(-300));
  assert.ok(0 < before && before < parts.length);
  assert.equal(parts.length, new Set(parts).size);
});

test('what is not required any more is cancelled', async () => {
  const { requests, options } = served(LEVELS);
  const aims = { ...AIMS, around: false };
  const { signal } = new AbortController();
  const sink = collector();
  const stream = await TexelStream.open('http://example.test/a', sink, aims, signal, options);
  await seen(stream, sink, viewFrom(1e6));
  const before = requests.length;
  stream.tiles.setView(viewFrom(-300));
  const inFlight = [...stream.tiles.pending.values()];
  stream.tiles.setView(viewFrom(1e6));
  assert.ok(before < requests.length);
  assert.ok(inFlight.length > 0);
  assert.ok(inFlight.every(({ signal }) => signal.aborted));
});

test('of a file without levels, the first tile is requested alone', async () => {
  const { requests, options } = served(bytes('valid/rich'));
  const sink = collector();
  const { signal } = new AbortController();
  const stream = await TexelStream.open('http://example.test/a', sink, AIMS, signal, options);
  stream.tiles.batchBytes = 1; // less than a tile has
  const before = requests.length;
  const first = new Promise((resolve) => (sink.geometry = () => resolve(requests.slice(before))));
  stream.tiles.setView(viewFrom(-1e4));
  const [{ layers }] = stream.reader.header.tiles;
  assert.deepEqual(
    (await first).map(({ end }) => end),
    [layers[0].offset + layers[0].size],
  );
});

test('a damaged tile is reported, and the node above it stays', async () => {
  const damaged = Uint8Array.from(LEVELS);
  const [{ index, layers }] = readHeader(LEVELS).tiles;
  damaged[layers[0].offset + layers[0].size - 5] ^= 1;
  const events = await loaded(new Blob([damaged]), { view: viewFrom(-300) });
  assert.deepEqual(
    events.filter(({ type }) => type === 'warn').map(({ error }) => error.code),
    ['E_CRC'],
  );
  assert.deepEqual(new Set(tilesIn(events)), new Set([...levelOf.keys()].filter((tile) => tile !== index)));
});

test('a damaged root is an error', async () => {
  const damaged = Uint8Array.from(LEVELS);
  const { coarseTiles } = readHeader(LEVELS);
  const { layers } = coarseTiles[coarseTiles.length - 1];
  damaged[layers[0].offset + layers[0].size - 5] ^= 1;
  await assert.rejects(loaded(new Blob([damaged])), { code: 'E_CRC' });
});

test('a lost connection is reported once and tried again, without end once the scene is open', async () => {
  let isOnline = true;
  let failures = 0;
  const { options } = served(LEVELS, { fails: () => !isOnline && failures++ < 30 });
  const sink = collector();
  const { signal } = new AbortController();
  const stream = await TexelStream.open('http://example.test/a', sink, AIMS, signal, options);
  isOnline = false;
  await seen(stream, sink, viewFrom(-300));
  assert.ok(failures >= 30);
  assert.equal(tilesIn(sink.events).length, levelOf.size);
  const warnings = sink.events.filter(({ type }) => type === 'warn');
  assert.deepEqual(
    warnings.map(({ error }) => [error.code, error.reason]),
    [['E_INPUT', 'connection']],
  );
});

test('the first request is tried again, too, but not without end', async () => {
  const { options, requests } = served(LEVELS, { fails: (n) => n < 3 });
  const { signal } = new AbortController();
  const sink = collector();
  await TexelStream.open('http://example.test/a', sink, AIMS, signal, { ...options, retries: 2 });
  assert.ok(requests.length >= 3);
  assert.equal(sink.events.filter(({ type }) => type === 'warn').length, 1);
  const never = served(LEVELS, { fails: () => true });
  const opening = TexelStream.open('http://example.test/a', collector(), AIMS, signal, never.options);
  await assert.rejects(opening, { code: 'E_INPUT', reason: 'connection' });
});

test('a file that is replaced while it is read ends the reading with that', async () => {
  let isReplaced = false;
  const { fetch, options } = served(LEVELS);
  const later = async (...request) => {
    const response = await fetch(...request);
    const headers = { ...Object.fromEntries(response.headers), etag: isReplaced ? '"b"' : '"a"' };
    const bytes = new Uint8Array(await response.arrayBuffer());
    const sent = isReplaced ? bytes.map((byte) => byte ^ 1) : bytes;
    return new Response(sent, { status: 206, headers });
  };
  const { signal } = new AbortController();
  const sink = collector();
  const stream = await TexelStream.open('http://example.test/a', sink, AIMS, signal, {
    ...options,
    fetch: later,
  });
  isReplaced = true;
  await assert.rejects(seen(stream, sink, viewFrom(-300)), { code: 'E_INPUT', isReplaced: true });
});

test('a hidden page reads the coarsest version alone, and goes on when it is seen', async () => {
  const sink = collector();
  const stream = await TexelStream.open(new Blob([LEVELS]), sink, AIMS, new AbortController().signal);
  stream.tiles.pause(true);
  stream.tiles.setView(viewFrom(-300));
  await until(() => tilesIn(sink.events).length > 0);
  await new Promise((resolve) => setTimeout(resolve, 20));
  const coarsest = Math.max(...levelOf.values());
  assert.ok(tilesIn(sink.events).every((tile) => levelOf.get(tile) === coarsest));
  const done = new Promise((resolve) => (sink.resolve = resolve));
  stream.tiles.pause(false);
  await done;
  assert.equal(tilesIn(sink.events).length, levelOf.size);
});

test('of every file with levels, what a view requires arrives, whatever the view', { timeout: 60_000 }, async () => {
  const names = readdirSync(new URL('valid/', VECTORS)).filter((name) => name.startsWith('levels'));
  assert.ok(names.length > 10);
  for (const name of names) {
    const data = bytes(`valid/${name.replace('.csplat', '')}`);
    const aims = { ...AIMS, pixels: 1 };
    const sink = collector();
    const stream = await TexelStream.open(new Blob([data]), sink, aims, new AbortController().signal);
    for (const z of [-1e4, -300, -30, -3, 0, 50]) {
      await seen(stream, sink, viewFrom(z));
      assert.ok(stream.here.size > 0);
    }
  }
});
