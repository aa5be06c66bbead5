// SPDX-License-Identifier: Apache-2.0
// CsplatReader over HTTP, with and without ranges, and its errors.
import assert from 'node:assert/strict';
import { test } from 'node:test';

import { CsplatReader, decode } from '../decoder.mjs';
import { forged, hash, refusal, serve, vector } from './helpers.mjs';

const rich = vector('valid/rich');
const seeded = vector('extreme/seeded');

/** Read every part of a file. */
async function readAll(reader) {
  await reader.describe();
  for (const { index } of reader.header.tiles) await reader.readTile(index, { extra: true });
}

test('a small file takes one request for header and index, and none for the parts that came with it', async (t) => {
  const { url, requests } = await serve(t, seeded);
  const reader = await CsplatReader.open(url);
  const tile = await reader.readTile(0);
  assert.deepEqual(requests, ['bytes=0-65535']);
  assert.equal(hash(tile.shN), hash((await decode(seeded)).shN));
  assert.deepEqual({ ...reader.checks, chunks: reader.checks.chunks > 0 }, { header: true, index: true, chunks: true });
});

test('with a small first request each part is fetched separately', async (t) => {
  const { url, requests } = await serve(t, rich);
  const whole = await decode(rich);
  const reader = await CsplatReader.open(url, { firstBytes: 64 });
  assert.equal(requests.length, 2);
  const { count, sh0 } = await reader.readLayer(1, 0);
  assert.equal(hash(sh0), hash(whole.sh0.slice(-3 * count)));
  assert.deepEqual(await reader.describe(), {
    metadata: whole.metadata,
    cameras: whole.cameras,
    options: whole.options,
    declaredErrors: whole.declaredErrors,
  });
});

test('layers can be read in any order, also if they need the indices of a lower band', async (t) => {
  const file = vector('valid/codebook_sh_1_3');
  const { url } = await serve(t, file);
  const whole = await decode(file);
  const rows = whole.shN.length / 3 / whole.count;
  for (const order of [
    [3, 2, 1, 0],
    [2, 3, 0, 1],
    [1, 2, 3],
    [3, 3, 1, 3],
  ]) {
    const reader = await CsplatReader.open(url, { firstBytes: 64 });
    for (const layer of order) {
      const part = await reader.readLayer(0, layer);
      if (layer === 0) {
        assert.equal(hash(part.means), hash(whole.means));
        continue;
      }
      const wanted = [];
      for (let i = 0; i < whole.count; i++) {
        for (let row = layer * layer - 1; row < (layer + 1) ** 2 - 1; row++) {
          wanted.push(...whole.shN.subarray(3 * (i * rows + row), 3 * (i * rows + row) + 3));
        }
      }
      assert.deepEqual([...part.sh], wanted, `layer ${layer} of ${order}`);
      const integers = await reader.readLayer(0, layer, { form: 'integers' });
      assert.equal(integers.sh.length, wanted.length);
    }
  }
});

test('layers can be read concurrently', async () => {
  const file = vector('valid/codebook_sh_1_3');
  const reader = await CsplatReader.open(new Blob([file]));
  const alone = await Promise.all(
    [1, 2, 3].map((layer) => CsplatReader.open(new Blob([file])).then((one) => one.readLayer(0, layer))),
  );
  const together = await Promise.all([3, 1, 2].map((layer) => reader.readLayer(0, layer)));
  assert.deepEqual(
    together.map(({ sh }) => hash(sh)),
    [alone[2], alone[0], alone[1]].map(({ sh }) => hash(sh)),
  );
});

test('a band that the tile leaves out is null', async () => {
  const reader = await CsplatReader.open(new Blob([vector('valid/absent_band')]));
  assert.equal(await reader.readLayer(0, 1), null);
  assert.ok((await reader.readLayer(0, 2)).sh.length > 0);
});

test('prefetch joins neighbours into one request and reads nothing twice', async (t) => {
  const file = vector('extreme/tiles_of_one');
  const { url, requests } = await serve(t, file);
  const reader = await CsplatReader.open(url, { firstBytes: 64 });
  const before = requests.length;
  const indices = reader.header.tiles.map(({ index }) => index);
  reader.prefetch(indices.map((tile) => ({ tile, layer: 0 })));
  const tiles = await Promise.all(indices.map((index) => reader.readLayer(index, 0)));
  assert.equal(requests.length - before, 1);
  assert.deepEqual(
    tiles.flatMap(({ means }) => [...means]),
    [...(await decode(file)).means],
  );
  assert.equal(reader.source.fetched.length, 0);
});

test('only the rest of a part that begins in the first request is fetched', async (t) => {
  const whole = await decode(rich);
  const { offset, size } = whole.header.tiles[0].layers[0];
  for (const isPrefetched of [false, true]) {
    const { url, requests } = await serve(t, rich);
    const received = [];
    const firstBytes = offset + (size >> 1);
    const reader = await CsplatReader.open(url, { firstBytes, onProgress: (bytes) => received.push(bytes) });
    if (isPrefetched) reader.prefetch([{ tile: 0, layer: 0 }]);
    const { means } = await reader.readLayer(0, 0);
    assert.equal(hash(means), hash(whole.means.slice(0, means.length)));
    assert.equal(requests.at(-1), `bytes=${firstBytes}-${offset + size - 1}`);
    assert.equal(received.at(-1), offset + size);
  }
});

test('a server without ranges sends the whole file', async (t) => {
  const { url, requests } = await serve(t, seeded, { ranges: false });
  const received = [];
  const reader = await CsplatReader.open(url, { onProgress: (...progress) => received.push(progress) });
  assert.equal(hash((await reader.readTile(0)).shN), hash((await decode(seeded)).shN));
  assert.equal(requests.length, 1);
  await readAll(reader);
  assert.equal(received.at(-1)[0], seeded.length);
});

test('truncated files and files that are too long are refused, with and without ranges', async (t) => {
  const longer = new Uint8Array(rich.length + 5);
  longer.set(rich);
  for (const ranges of [true, false]) {
    for (const size of [0, 10, 64, 300, rich.length - 1]) {
      const { url } = await serve(t, rich.subarray(0, size), { ranges });
      const error = await refusal(async () => {
        await readAll(await CsplatReader.open(url, { retryMs: 0 })); // with ranges the server reports the size of the file
      });
      assert.equal(error.code, 'E_TRUNCATED', `${size} bytes, ranges ${ranges}`);
    }
    const { url } = await serve(t, longer, { ranges });
    const error = await refusal(async () => readAll(await CsplatReader.open(url)));
    assert.equal(error.code, 'E_TRAILING');
  }
});

test('a damaged part is refused, the others are not', async (t) => {
  const { header } = await decode(rich);
  const damaged = rich.slice();
  damaged[header.tiles[0].layers[0].offset + 20] ^= 1;
  const { url } = await serve(t, damaged);
  const reader = await CsplatReader.open(url);
  assert.equal((await refusal(() => reader.readTile(0))).clause, 'CHK-1');
  assert.ok((await reader.readTile(1)).count > 0);
});

test('a damaged codebook is refused on every read', async () => {
  const file = vector('valid/codebook_shape');
  const { header } = await decode(file);
  const damaged = forged(file, (bytes) => (bytes[header.directory[0].offset + 12] ^= 1));
  const reader = await CsplatReader.open(new Blob([damaged]));
  for (let i = 0; i < 2; i++) assert.equal((await refusal(() => reader.readTile(0))).clause, 'CDB-1');
});

test('memory and a Blob are sources', async () => {
  const whole = await decode(rich);
  const reader = await CsplatReader.open(rich.slice().buffer);
  const { means } = await reader.readTile(0);
  assert.deepEqual(means, whole.means.slice(0, means.length));
  for (const kept of [0, 10, 70, rich.length - 1]) {
    const cut = rich.slice(0, kept);
    const refused = await Promise.all(
      [cut.buffer, new Blob([cut])].map((from) => refusal(() => CsplatReader.open(from))),
    );
    assert.deepEqual(refused[0], refused[1]);
  }
});

test('budgets apply to readers', async (t) => {
  const { url } = await serve(t, rich, { ranges: false });
  assert.equal((await refusal(() => CsplatReader.open(url, { limits: { bytes: rich.length - 1 } }))).code, 'E_LIMIT');
  const reader = await CsplatReader.open(new Blob([rich]), { limits: { splats: 1 } });
  assert.equal((await refusal(() => reader.readTile(0))).code, 'E_LIMIT');
});

test('a missing file and an unreachable server are E_INPUT', async (t) => {
  const { url } = await serve(t, rich);
  assert.equal((await refusal(() => CsplatReader.open(`${url}x`))).code, 'E_INPUT');
  assert.equal((await refusal(() => CsplatReader.open('http://127.0.0.1:1/x'))).code, 'E_INPUT');
});

test('an abort ends a read with its reason', async (t) => {
  const { url } = await serve(t, rich);
  const reader = await CsplatReader.open(url, { firstBytes: 64 });
  const reason = new Error('enough');
  await assert.rejects(reader.readTile(0, { signal: AbortSignal.abort(reason) }), reason);
  assert.ok((await reader.readTile(0)).count > 0);
});
