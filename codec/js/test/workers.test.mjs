// SPDX-License-Identifier: Apache-2.0
// Tiles decoded by workers: the same scenes and refusals as without workers, also if no worker starts.
import assert from 'node:assert/strict';
import { spawnSync } from 'node:child_process';
import { once } from 'node:events';
import { test } from 'node:test';
import { fileURLToPath } from 'node:url';
import { Worker } from 'node:worker_threads';

import { CsplatReader, decode, readHeader } from '../decoder.mjs';
import { forged, hash, manifest, refusal, vector } from './helpers.mjs';

/** Vectors of several tiles, all of level 0: they have as many floats as integers. */
const several = manifest.filter(
  ({ error, expect: { header, floats, integers } }) =>
    !error.code && header.tile_count > 1 && floats.means[1][0] === integers.means[1][0],
);

test('workers decode every scene of several tiles to the same arrays', async () => {
  assert.ok(several.length > 10);
  for (const { name, expect } of several) {
    const progress = [];
    const scene = await decode(vector(name), { workers: 2, onProgress: (...now) => progress.push(now) });
    assert.equal(scene.workers, 2, name);
    for (const [part, [, , sha]] of Object.entries(expect.floats))
      assert.equal(hash(scene[part]), sha, `${name} ${part}`);
    for (const [part, [, , sha]] of Object.entries(expect.extra))
      assert.equal(hash(scene.extra[part]), sha, `${name} ${part}`);
    const { directory, tiles } = scene.header;
    assert.equal(scene.checks.chunks, directory.length + tiles.reduce((sum, { layers }) => sum + layers.length, 0));
    assert.equal(progress.length, tiles.length);
    assert.deepEqual(progress.at(-1), [scene.count, scene.count]);
  }
});

test('tiles in another order and lower degrees come from workers too', async () => {
  const file = vector(several.find(({ expect }) => expect.header.sh_degree > 1).name);
  const options = { tiles: [1, 0], shDegree: 1 };
  const [one, other] = [await decode(file, { ...options, workers: 2 }), await decode(file, options)];
  for (const part of ['means', 'shN']) assert.equal(hash(one[part]), hash(other[part]));
});

test('a damaged tile is refused with the same error as without workers', async () => {
  const file = vector(several[0].name);
  const { tiles } = readHeader(file);
  for (const options of [{ workers: 2 }, {}]) {
    const bad = forged(file, (bytes, view) => view.setUint8(tiles[1].layers[0].offset + 12, 99)); // the layer
    const error = await refusal(() => decode(bad, options));
    assert.deepEqual([error.code, error.clause], ['E_INDEX', 'TLE-1']);
  }
});

test('an abort ends the work of workers', async () => {
  const control = new AbortController();
  const reason = new Error('enough');
  const onProgress = () => control.abort(reason);
  const work = decode(vector(several[0].name), { workers: 1, signal: control.signal, onProgress });
  await assert.rejects(work, reason);
});

const noRequire = !process.features.require_module && 'this Node cannot require modules';
test(
  'the worker can be bundled as a classic script: no module has a top-level await',
  { skip: noRequire },
  async () => {
    const path = fileURLToPath(new URL('../csplat-worker.mjs', import.meta.url));
    const worker = new Worker(`require(${JSON.stringify(path)})`, { eval: true });
    worker.postMessage({ tile: 0, parts: new Map() });
    assert.deepEqual(await once(worker, 'message'), [{}]); // refused, since there is no file
    await worker.terminate();
  },
);

test('tiles come from workers in each form', async () => {
  const file = vector('valid/combined_codebooks').buffer;
  for (const form of ['floats', 'packed', 'integers']) {
    const reader = await CsplatReader.open(file);
    const seen = new Map();
    for await (const { index, ...tile } of reader.readTiles({ form, workers: 2 })) {
      seen.set(index, tile);
      assert.deepEqual(tile, await reader.readTile(index, { form }), form);
    }
    assert.equal(seen.size, reader.header.tiles.length);
    if (form !== 'packed') continue;
    const lookups = [...seen.values()].flatMap(({ sh }) =>
      sh.flatMap((one, band) => (one?.lookup ? [[`${one.lookup.codebook}.${band}`, one.lookup.table]] : [])),
    );
    const tables = new Map(lookups);
    assert.ok(lookups.length > tables.size);
    for (const [key, table] of lookups) assert.equal(table, tables.get(key)); // one object for all tiles
  }
});

test('a loop over tiles can end early', async () => {
  const reader = await CsplatReader.open(vector(several[0].name).buffer);
  for await (const { index } of reader.readTiles({ workers: 2 })) {
    assert.ok(index < reader.header.tiles.length);
    break;
  }
  let count = 0;
  for await (const { means } of reader.readTiles({ workers: 2, tiles: [1] })) count += means.length;
  assert.equal(count, 3 * reader.header.tiles[1].splatCount);
});

const WAYS = ['construction', 'script', 'silence', 'first request', 'first answer', 'second request', 'third request'];
test('workers that fail in any way, early or late, leave the work to the calling thread, which fetches nothing again', () => {
  const { file, expect } = several.find(({ expect: { header } }) => header.tile_count > 3);
  const path = fileURLToPath(new URL(`../../../conformance/csplat_conformance/vectors/${file}`, import.meta.url));
  const script = fileURLToPath(new URL('failing_workers.mjs', import.meta.url));
  const seen = {};
  const wanted = {};
  for (const way of WAYS) {
    for (const [moment, task] of [
      ['before the tiles', 'tiles'],
      ['with the tiles', 'layers'],
    ]) {
      const { stdout, stderr } = spawnSync(process.execPath, [script, path, way, moment, task], {
        encoding: 'utf8',
        timeout: 10_000,
      });
      seen[`${way}, ${moment}, ${task}`] = stdout.trim() || stderr || 'nothing';
      // Two workers start together for tiles; no other is tried once one has failed to start.
      const known = way === 'construction' || task === 'layers' ? 1 : 2;
      const starts = /^(?:second|third)/.test(way) ? stdout.match(/\d+$/m)?.[0] : known;
      wanted[`${way}, ${moment}, ${task}`] = `all splats 1 ${starts}`;
    }
  }
  assert.ok(expect.header.splat_count > 3);
  assert.deepEqual(seen, wanted);
});

test('decode works if no worker can start', () => {
  const script = `
    import { readFileSync } from 'node:fs';
    import { decode } from './decoder.mjs';
    const { workers, count } = await decode(readFileSync(process.argv[1]), { workers: 2 });
    console.log(workers, count);`;
  const path = fileURLToPath(
    new URL(`../../../conformance/csplat_conformance/vectors/${several[0].file}`, import.meta.url),
  );
  const words = ['--experimental-permission', '--allow-fs-read=*', '--input-type=module', '-e', script, path];
  const { stdout, stderr } = spawnSync(process.execPath, words, {
    cwd: new URL('..', import.meta.url),
    encoding: 'utf8',
  });
  assert.equal(stdout, `0 ${several[0].expect.header.splat_count}\n`, stderr);
});
