// SPDX-License-Identifier: Apache-2.0
// The generated constants match the layout of header and index in the spec.
import assert from 'node:assert/strict';
import { readFileSync } from 'node:fs';
import { test } from 'node:test';

import * as spec from '../spec.mjs';

const vectors = new URL('../../../conformance/csplat_conformance/vectors/', import.meta.url);
const file = readFileSync(new URL('valid/worked_example.csplat', vectors));
const view = new DataView(file.buffer, file.byteOffset, file.byteLength);

test('the fields of the header have the offsets of the registry', () => {
  const header = spec.unpackHeader(view, 0);
  assert.deepEqual([...header.magic], [...spec.MAGIC]);
  assert.equal(header.version_major, spec.VERSION_MAJOR);
  assert.equal(header.version_minor, spec.VERSION_MINOR);
  assert.equal(header.file_size, BigInt(file.length));
});

test('the index begins after the header and counts its tiles', () => {
  const head = spec.unpackIndexHead(view, spec.HEADER_SIZE);
  assert.equal(head.attribute_count, 5 + head.sh_degree);
  assert.ok(head.tile_count >= 1);
});

test('the tables of the registry are frozen and complete', () => {
  assert.throws(() => {
    spec.CODER_NAMES[0] = 'x';
  }, TypeError);
  assert.equal(spec.ATTRIBUTE_COLUMNS[spec.ATTRIBUTE_SH4], 27);
  assert.equal(spec.CODER_NAMES[spec.CODER_DEFLATE], 'deflate');
});
