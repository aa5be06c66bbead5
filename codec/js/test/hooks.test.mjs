// SPDX-License-Identifier: Apache-2.0
// Whatever the caller's hooks throw or return, the decoder answers with an error of its own.
import assert from 'node:assert/strict';
import { test } from 'node:test';
import { inflateRawSync } from 'node:zlib';

import { CsplatError, CsplatReader, decode } from '../decoder.mjs';
import { refusal, vector } from './helpers.mjs';

const coded = vector('valid/coder_deflate_fixed');
const damaged = vector('invalid/deflate_garbage');
const thrown = (value) => () => {
  throw value;
};

test('whatever an inflate of the caller throws is E_CODER', async () => {
  const values = [
    new Error('bad'),
    new RangeError('too long'),
    'text',
    undefined,
    null,
    7,
    Symbol('s'),
    Object.create(null),
  ];
  for (const value of values) {
    for (const inflate of [thrown(value), async () => thrown(value)()]) {
      const error = await refusal(() => decode(coded, { inflate }));
      assert.equal(error.code, 'E_CODER');
      assert.equal(error.clause, 'COD-2');
      assert.equal(error.cause.cause, value);
      assert.ok(!error.message.includes('\n') && error.message.length < 400);
    }
  }
  const long = await refusal(() => decode(coded, { inflate: thrown(new Error('a\n'.repeat(100_000))) }));
  assert.ok(!long.message.includes('\n') && long.message.length < 400);
});

test('the exception of zlib for damaged data is E_CODER with its clause and offset', async () => {
  const own = await refusal(() => decode(damaged));
  const error = await refusal(() => decode(damaged, { inflate: (bytes) => new Uint8Array(inflateRawSync(bytes)) }));
  assert.deepEqual([error.code, error.offset], [own.code, own.offset]);
});

test('an inflate that returns something else is the fault of the caller', async () => {
  for (const value of [undefined, null, 'text', [1], new ArrayBuffer(2), new Uint16Array(2), new Uint8Array(1), {}]) {
    for (const inflate of [() => value, async () => value]) {
      assert.equal((await refusal(() => decode(coded, { inflate }))).code, 'E_INPUT');
    }
  }
  assert.equal((await refusal(() => decode(coded, { inflate: /** @type {any} */ (7) }))).code, 'E_INPUT');
});

test('a source of the caller may return a view of anything, and nothing else', async () => {
  const open = (read, more = {}) => CsplatReader.open({ read, ...more });
  const bytes = new Uint8Array(coded);
  const right = (offset, size) => bytes.subarray(offset, offset + size);
  for (const read of [
    right,
    async (...at) => Buffer.from(right(...at)),
    (...at) => new DataView(right(...at).slice().buffer),
  ])
    assert.ok((await (await open(read)).readTile(0)).count > 0);
  const wrong = {
    E_TRUNCATED: [() => new Uint8Array(0), (offset, size) => right(offset, size - 1)],
    E_INPUT: [
      (offset, size) => bytes.slice(offset, offset + size + 1),
      () => 'text',
      () => undefined,
      () => [1, 2],
      thrown(new RangeError('no')),
      thrown(undefined),
    ],
  };
  for (const [code, reads] of Object.entries(wrong)) {
    for (const read of reads) {
      assert.equal((await refusal(() => open(read))).code, code, `${read}`);
      const later = await open(right); // a source that fails later
      later.source.source.read = read;
      assert.equal((await refusal(() => later.readTile(0))).code, code, `${read}`);
    }
  }
  for (const size of [-1, 0.5, NaN, 'x']) assert.equal((await refusal(() => open(right, { size }))).code, 'E_INPUT');
  const titled = new Uint8Array(vector('valid/metadata_coded'));
  const prefetch = thrown('no');
  const failing = await open((offset, size) => titled.subarray(offset, offset + size), { prefetch });
  await assert.rejects(async () => failing.describe(), CsplatError);
});
