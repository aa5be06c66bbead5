// SPDX-License-Identifier: Apache-2.0
// Both inflate implementations enforce the declared size and the end of the stream.
import assert from 'node:assert/strict';
import { test } from 'node:test';
import { deflateRawSync } from 'node:zlib';

import { InflateError, streamInflate, zlibInflate } from '../inflate.mjs';
import { noStream } from './helpers.mjs';

const plain = Uint8Array.from({ length: 100_000 }, (_, i) => (i * i) >> 7);
const coded = new Uint8Array(deflateRawSync(plain));
const joined = (...parts) => new Uint8Array(Buffer.concat(parts));

for (const [name, make] of Object.entries({ zlib: zlibInflate, DecompressionStream: streamInflate })) {
  const skip = make === streamInflate && noStream;

  test(`${name} inflates`, { skip }, async () => {
    const inflate = await make();
    assert.deepEqual(new Uint8Array(await inflate(coded, plain.length)), plain);
  });

  test(`${name} refuses bytes after the end`, { skip }, async () => {
    const inflate = await make();
    for (const tail of [[0], [1, 2, 3], coded]) {
      await assert.rejects(async () => inflate(joined(coded, Uint8Array.from(tail)), plain.length), InflateError);
    }
    await assert.rejects(async () => inflate(joined(coded, new Uint8Array(100_000)), plain.length), InflateError);
  });

  test(`${name} refuses every early end`, { skip }, async () => {
    const inflate = await make();
    const small = new Uint8Array(deflateRawSync(plain.subarray(0, 50)));
    for (let size = 0; size < small.length; size++) {
      await assert.rejects(async () => inflate(small.slice(0, size), 50), InflateError);
    }
  });

  test(`${name} refuses another size than the declared one`, { skip }, async () => {
    const inflate = await make();
    for (const size of [1, plain.length - 1, plain.length + 1]) {
      await assert.rejects(async () => inflate(coded, size), InflateError);
    }
  });

  test(`${name} stops a bomb`, { skip }, async () => {
    const inflate = await make();
    const bomb = new Uint8Array(deflateRawSync(new Uint8Array(60_000_000)));
    const before = process.memoryUsage().arrayBuffers;
    await assert.rejects(async () => inflate(bomb, 1000), InflateError);
    assert.ok(process.memoryUsage().arrayBuffers - before < 20_000_000);
  });

  test(`${name} refuses damage`, { skip }, async () => {
    const inflate = await make();
    await assert.rejects(async () => inflate(Uint8Array.of(7, 0), 1), InflateError);
    await assert.rejects(async () => inflate(new Uint8Array(0), 1), InflateError);
  });
}
