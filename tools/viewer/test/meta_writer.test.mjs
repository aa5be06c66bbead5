// SPDX-License-Identifier: Apache-2.0
// Files rewritten with another META: everything else is kept.
import assert from 'node:assert/strict';
import { readFileSync, readdirSync } from 'node:fs';
import { test } from 'node:test';

import { decode } from '../../../codec/js/decoder.mjs';
import { allTiles } from '../../../codec/js/tile_records.mjs';
import { withMetadata, withoutEstimates } from '../meta_writer.mjs';

const FOLDER = new URL('../../../conformance/csplat_conformance/vectors/valid/', import.meta.url);
const NAMES = readdirSync(FOLDER).filter((name) => name.endsWith('.csplat'));
const UP = [0, 0.6, -0.8];

const read = (name) => new Uint8Array(readFileSync(new URL(name, FOLDER))).buffer;

/** The content of a scene and its metadata, independent of offsets in the file. */
async function facts(bytes) {
  const { header, metadata, checks, ...rest } = await decode(bytes);
  const { axes, unitMetres, origin, attributes, splatCount } = header;
  const tiles = allTiles(header);
  assert.equal(checks.chunks, header.directory.length + tiles.flatMap(({ layers }) => layers).length);
  const contents = tiles.flatMap(({ layers }) => layers.map(({ crc }) => crc));
  return { metadata, axes, rest, other: { unitMetres, origin, attributes, splatCount, contents } };
}

test('everything but the metadata is kept', async () => {
  assert.ok(NAMES.length > 50);
  let without = 0;
  for (const name of NAMES) {
    const bytes = read(name);
    const before = await facts(bytes);
    const written = await withMetadata(bytes, { up: UP });
    const after = await facts(written.buffer);
    assert.deepEqual(after.rest, before.rest, name);
    assert.deepEqual(after.other, before.other, name);
    const { estimated: _, ...stated } = before.metadata ?? {}; // a chosen direction is no estimate
    assert.deepEqual(after.metadata, { ...stated, up: UP }, name);
    assert.deepEqual(await withMetadata(written.buffer, { up: UP }), written, name); // idempotent
    without += Number(before.metadata === null);
  }
  assert.ok(without > 0 && without < NAMES.length); // META is new in some files, replaced in others
});

test('axes are kept unless they contradict the up direction', async () => {
  let known = 0;
  for (const name of NAMES) {
    const { axes } = await facts(read(name));
    if (!axes) continue;
    known++;
    const own = [...axes].map((letter) => Number(letter === 'U') - Number(letter === 'D'));
    assert.equal((await facts((await withMetadata(read(name), { up: own })).buffer)).axes, axes);
    const opposite = own.map((value) => -value);
    assert.equal((await facts((await withMetadata(read(name), { up: opposite })).buffer)).axes, '');
  }
  assert.ok(known > 0);
});

test('a first view is written, and an estimated one is for one up direction', async () => {
  const view = /** @type {any} */ ({ K: [[1]], viewmat: [[1]], W: 4, H: 3, near: 1 });
  const metadataOf = async (/** @type {Uint8Array<ArrayBuffer>} */ file) => (await facts(file.buffer)).metadata;
  const seen = await withMetadata(read(NAMES[0]), { view });
  assert.deepEqual((await metadataOf(seen)).view, { ...view, from: 'author' });
  assert.deepEqual((await metadataOf(await withMetadata(seen.buffer, { up: UP }))).view, { ...view, from: 'author' });
  const estimate = { ...view, from: 'estimate' };
  assert.deepEqual(withoutEstimates({ view: estimate, estimated: ['up'], title: 'x' }), { title: 'x' });
});
