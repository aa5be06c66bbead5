// SPDX-License-Identifier: Apache-2.0
// The WebAssembly decoder alone: what it decodes and refuses without the JavaScript modules as a fallback.
import assert from 'node:assert/strict';
import { test } from 'node:test';

import { FloatArrays } from '../arrays.mjs';
import { WasmDecoder } from '../wasm_decoder.mjs';
import { CsplatReader, readHeader } from '../decoder.mjs';
import { zlibInflate } from '../inflate.mjs';
import { HEADER_SIZE } from '../spec.mjs';
import { allTiles } from '../tile_records.mjs';
import { hash, manifest, vector } from './helpers.mjs';

const valid = manifest.filter(({ error }) => !error.code);

/** Return everything that it decodes of a file with valid header and index, tiles of all levels included, or null. */
async function decodeAll(file, header) {
  const end = HEADER_SIZE + header.indexSize;
  const decoder = await WasmDecoder.open(file.length, file.subarray(0, HEADER_SIZE), file.subarray(HEADER_SIZE, end));
  if (decoder === null) return null;
  const tiles = allTiles(header);
  const places = [...header.directory, ...tiles.flatMap(({ layers }) => layers)];
  const parts = new Map(places.map(({ offset, size }) => [offset, file.subarray(offset, offset + size)]));
  const checked = new Set();
  const count = tiles.reduce((sum, { splatCount }) => sum + splatCount, 0);
  const arrays = new FloatArrays(count, header.shDegree);
  const right = decoder.reading(
    parts,
    checked,
    () => decoder.check() && tiles.every((tile) => decoder.readTile(tile, arrays, tile.first)),
  );
  decoder.close();
  return right ? { arrays, checked } : null;
}

test('reads every valid vector', async () => {
  for (const { name, expect } of valid) {
    const file = vector(name);
    const { arrays } = (await decodeAll(file, readHeader(file))) ?? assert.fail(name);
    for (const [part, [, shape, sha]] of Object.entries(expect.floats)) {
      const size = shape.reduce((product, length) => product * length);
      assert.equal(hash(arrays[part].subarray(0, size)), sha, `${name} ${part}`);
    }
  }
});

test('refuses every invalid vector, except for extra columns and budgets, which it does not check', async () => {
  const taken = [];
  for (const { name } of manifest.filter(({ name, error }) => error.code && !name.endsWith('_beyond_budget'))) {
    const file = vector(name);
    let header;
    try {
      header = readHeader(file);
    } catch {
      continue; // never reaches WebAssembly
    }
    const others = /extra|raw|component/.test(name);
    if ((await decodeAll(file, header)) !== null && !others) taken.push(name);
  }
  assert.deepEqual(taken, []);
});

test('decodes floats and packed arrays, but not with an inflate of the caller', async () => {
  const file = vector('valid/rich');
  assert.ok((await CsplatReader.open(new Blob([file]))).compiled);
  assert.equal((await CsplatReader.open(new Blob([file]), { inflate: await zlibInflate() })).compiled, null);
});

test('open returns null on a page that forbids WebAssembly', async () => {
  const file = vector('valid/rich');
  for (const forbidden of ['compile', 'Instance']) {
    // WebKit forbids only the second
    const allowed = WebAssembly[forbidden];
    WebAssembly[forbidden] = function () {
      throw new WebAssembly.CompileError('unsafe-eval');
    };
    try {
      const { WasmDecoder: another } = await import(`../wasm_decoder.mjs?${forbidden}`);
      assert.equal(await another.open(file.length, file.subarray(0, HEADER_SIZE), file.subarray(HEADER_SIZE)), null);
    } finally {
      WebAssembly[forbidden] = allowed;
    }
  }
});

test('a decoder is not used again after a trap', async () => {
  const file = vector('valid/rich');
  const reader = await CsplatReader.open(file.buffer);
  const { compiled } = reader;
  compiled.exports = {
    ...compiled.exports,
    read_tile: () => {
      throw new WebAssembly.RuntimeError('unreachable');
    },
  };
  const tile = await reader.readTile(0);
  assert.ok(compiled.isBroken);
  compiled.close();
  assert.notEqual((await CsplatReader.open(file.buffer)).compiled, compiled);
  assert.deepEqual(tile, await (await CsplatReader.open(file.buffer)).readTile(0));
});
