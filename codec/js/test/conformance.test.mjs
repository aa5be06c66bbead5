// SPDX-License-Identifier: Apache-2.0
// Every vector of the conformance suite: decoded whole, as floats and as integers, and tile by tile.
import assert from 'node:assert/strict';
import { test } from 'node:test';

import { CsplatReader, decode, readHeader } from '../decoder.mjs';
import { streamInflate } from '../inflate.mjs';
import { HEADER_SIZE } from '../spec.mjs';
import { allTiles } from '../tile_records.mjs';
import { cutOptions } from './cuts.mjs';
import { failures, hash, manifest, noStream, refusal, vector } from './helpers.mjs';

const valid = manifest.filter(({ error }) => !error.code);
const invalid = manifest.filter(({ error }) => error.code);

/** Vectors with errors in the payload of a coarser tile, which a decode of level 0 does not read (CHK-8). */
const UNREAD = ['invalid/coarse_tile_box', 'invalid/coarse_tile_stream'];

const hashes = (scene, expected) =>
  Object.fromEntries(Object.keys(expected).map((name) => [name, scene[name] && hash(scene[name])]));
const wanted = (expected) => Object.fromEntries(Object.entries(expected).map(([name, [, , sha]]) => [name, sha]));
const facts = (header) => ({
  profile: header.profile,
  resource_level: header.resourceLevel,
  splat_count: header.splatCount,
  tile_count: allTiles(header).length,
  sh_degree: header.shDegree,
  scene_flags: header.flat ? ['flat'] : [],
  kernel: header.kernel,
  projection: header.projection,
  antialiasing: header.antialiasing,
  colour_space: header.colourSpace,
  extra_columns: header.extras.filter(({ dtype }) => dtype).map(({ name, semantic }) => [name, semantic]),
  axes: header.axes,
  unit_metres: header.unitMetres,
  origin: header.origin,
});

test('vectors of all kinds are present', () => {
  assert.ok(valid.length > 100 && invalid.length > 200);
});

test('decodes every valid vector', async () => {
  const failed = await failures(valid, async ({ name, expect }) => {
    const file = vector(name);
    const scene = await decode(file);
    assert.deepEqual(facts(scene.header), expect.header);
    assert.deepEqual(hashes(scene, expect.floats), wanted(expect.floats));
    assert.deepEqual(hashes(scene.extra, expect.extra), wanted(expect.extra));
    assert.deepEqual(Object.keys(scene.extra).sort(), Object.keys(expect.extra).sort());
    const { header } = scene;
    const chunks = header.directory.length + allTiles(header).reduce((sum, tile) => sum + tile.layers.length, 0);
    assert.deepEqual(scene.checks, { header: true, index: true, chunks });
    const integers = await decode(file, { form: 'integers' });
    assert.deepEqual(hashes(integers, expect.integers), wanted(expect.integers));
  });
  assert.deepEqual(failed, {});
});

test('refuses every invalid vector', async () => {
  const failed = await failures(invalid, async ({ name, error: { code, clause, offset } }) => {
    const file = vector(name);
    for (const form of ['floats', 'integers']) {
      const isUnread = form === 'floats' && UNREAD.includes(name);
      if (isUnread) await decode(file);
      const tiles = isUnread ? allTiles(readHeader(file)).map(({ index }) => index) : undefined;
      const found = await refusal(() => decode(file, { form, tiles }));
      assert.deepEqual([found.code, found.clause, found.offset], [code, clause, offset]);
    }
  });
  assert.deepEqual(failed, {});
});

test('selects the tiles of every cut', async () => {
  const withLevels = valid.filter(({ expect }) => expect.cuts);
  assert.ok(withLevels.length > 10);
  const failed = await failures(withLevels, async ({ name, expect }) => {
    const reader = await CsplatReader.open(new Blob([vector(name)]));
    for (const [line, wanted] of expect.cuts) {
      const found = await reader.cut(cutOptions(line)).catch(({ code }) => code);
      assert.deepEqual(found, wanted, line);
    }
  });
  assert.deepEqual(failed, {});
});

test('decodes files of every coder with DecompressionStream', { skip: noStream }, async () => {
  const inflate = await streamInflate();
  const some = valid.filter(({ name }) => /coder|deflate|combined|rich|seeded/.test(name));
  assert.ok(some.length > 20);
  const failed = await failures(some, async ({ name, expect }) => {
    const scene = await decode(vector(name), { inflate });
    assert.deepEqual(hashes(scene, expect.floats), wanted(expect.floats));
  });
  assert.deepEqual(failed, {});
});

test(
  'refuses with DecompressionStream every invalid stream, with the same code and clause',
  { skip: noStream },
  async () => {
    const inflate = await streamInflate();
    const some = invalid.filter(({ error }) => error.clause.startsWith('COD-'));
    assert.ok(some.length > 20);
    const failed = await failures(some, async ({ name, error }) => {
      const { code, clause } = await refusal(() => decode(vector(name), { inflate }));
      assert.deepEqual([code, clause], [error.code, error.clause]);
    });
    assert.deepEqual(failed, {});
  },
);

test('the header of every valid vector is read from the beginning of the file', () => {
  for (const { name, expect } of valid) {
    const file = vector(name);
    const { indexSize } = readHeader(file);
    assert.deepEqual(facts(readHeader(file.subarray(0, HEADER_SIZE + indexSize))), expect.header, name);
  }
});

test('a reader returns the same tiles as a whole decode', async () => {
  for (const { name } of valid) {
    const file = vector(name);
    const whole = await decode(file);
    const reader = await CsplatReader.open(new Blob([file]));
    assert.deepEqual(reader.header, whole.header, name);
    for (const { index, first, splatCount } of whole.header.tiles.slice(0, 20)) {
      const tile = await reader.readTile(index, { extra: true });
      for (const array of ['means', 'quats', 'scales', 'opacities', 'sh0', 'shN']) {
        const width = whole[array].length / whole.count;
        const part = whole[array].slice(first * width, (first + splatCount) * width);
        assert.equal(hash(tile[array]), hash(part), `${name} ${array}`);
      }
      for (const [column, values] of Object.entries(whole.extra)) {
        const width = values.length / whole.count;
        const part = values.slice(first * width, (first + splatCount) * width);
        assert.equal(hash(tile.extra[column]), hash(part), `${name} ${column}`);
      }
    }
    const { metadata, cameras, options, declaredErrors } = whole;
    assert.deepEqual(await reader.describe(), { metadata, cameras, options, declaredErrors });
  }
});
