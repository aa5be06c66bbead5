// The decoder in WebAssembly by itself: what it reads and refuses without the modules that step in for it.
import assert from 'node:assert/strict';
import { test } from 'node:test';

import { FloatArrays } from '../arrays.mjs';
import { WasmDecoder } from '../wasm_decoder.mjs';
import { CsplatReader, readHeader } from '../decoder.mjs';
import { zlibInflate } from '../inflate.mjs';
import { HEADER_SIZE } from '../spec.mjs';
import { hash, manifest, vector } from './helpers.mjs';

const valid = manifest.filter(({ error }) => !error.code);

/** All that it can decode of a file whose header and index are right, or null. */
async function decodeAll(file, header) {
  const end = HEADER_SIZE + header.indexSize;
  const decoder = await WasmDecoder.open(file.length, file.subarray(0, HEADER_SIZE), file.subarray(HEADER_SIZE, end));
  if (decoder === null) return null;
  const places = [...header.directory, ...header.tiles.flatMap(({ layers }) => layers)];
  const parts = new Map(places.map(({ offset, size }) => [offset, file.subarray(offset, offset + size)]));
  const checked = new Set();
  const arrays = new FloatArrays(header.splatCount, header.shDegree);
  const right = decoder.reading(
    parts,
    checked,
    () => decoder.check() && header.tiles.every((tile) => decoder.readTile(tile, arrays, tile.first)),
  );
  decoder.close();
  return right ? { arrays, checked } : null;
}

test('reads every valid vector', async () => {
  for (const { name, expect } of valid) {
    const file = vector(name);
    const { arrays } = (await decodeAll(file, readHeader(file))) ?? assert.fail(name);
    for (const [part, [, , sha]] of Object.entries(expect.floats))
      assert.equal(hash(arrays[part]), sha, `${name} ${part}`);
  }
});

test('refuses every invalid vector, but for what it leaves to the others: extra columns, the budget', async () => {
  const taken = [];
  for (const { name } of manifest.filter(({ name, error }) => error.code && !name.endsWith('_beyond_budget'))) {
    const file = vector(name);
    let header;
    try {
      header = readHeader(file);
    } catch {
      continue; // it never gets to see these
    }
    const others = /extra|raw/.test(name);
    if ((await decodeAll(file, header)) !== null && !others) taken.push(name);
  }
  assert.deepEqual(taken, []);
});

test('runs for floats and packed arrays, and steps aside for an inflate of the caller', async () => {
  const file = vector('valid/rich');
  assert.ok((await CsplatReader.open(new Blob([file]))).compiled);
  assert.equal((await CsplatReader.open(new Blob([file]), { inflate: await zlibInflate() })).compiled, null);
});

test('a page that forbids WebAssembly has no such decoder', async () => {
  const file = vector('valid/rich');
  for (const forbidden of ['compile', 'Instance']) {
    // WebKit forbids the second
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

test('a decoder that breaks down is not used again', async () => {
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
