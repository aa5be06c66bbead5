// SPDX-License-Identifier: Apache-2.0
// Checksums, strict JSON and exact products.
import assert from 'node:assert/strict';
import { test } from 'node:test';

import { crc32 } from '../checksums.mjs';
import { parseJson } from '../json.mjs';
import { ldexp } from '../lattice.mjs';

const bytes = (text) => new TextEncoder().encode(text);

test('CRC-32 of known texts and of every length', () => {
  assert.equal(crc32(bytes('123456789')), 0xcbf43926);
  assert.equal(crc32(new Uint8Array(0)), 0);
  const data = Uint8Array.from({ length: 64 }, (_, i) => 37 * i);
  for (let size = 0; size <= 64; size++) {
    let slow = -1;
    for (const byte of data.subarray(0, size)) {
      slow ^= byte;
      for (let bit = 0; bit < 8; bit++) slow = slow & 1 ? (slow >>> 1) ^ 0xedb88320 : slow >>> 1;
    }
    assert.equal(crc32(data.subarray(0, size)), ~slow >>> 0);
  }
});

test('valid JSON is parsed as by JSON.parse', () => {
  const texts = [
    '{}',
    '[]',
    ' [ 1 , -0 , 2.5e-3, 1E+2 ] ',
    '"\\u00e9\\ud83d\\ude00\\n\\/"',
    '{"a":{"b":[true,false,null]}}',
    '"\u007f"',
    '0',
    '-0.0',
    '1e-999',
    '{"__proto__":{"a":1},"constructor":2}',
    '"é€😀"',
    '{"":0}',
    '[[],[[]],{}]',
  ];
  for (const text of texts) assert.deepEqual(parseJson(bytes(text)), JSON.parse(text), text);
  const hostile = parseJson(bytes('{"__proto__":{"polluted":1}}'));
  assert.equal(hostile.polluted, undefined);
});

test('invalid JSON is refused', () => {
  const texts = [
    '',
    ' ',
    '{',
    '[',
    '"',
    '[1,]',
    '{"a":1,}',
    '{a:1}',
    "'a'",
    '01',
    '1.',
    '.5',
    '+1',
    '-',
    '1e',
    'NaN',
    'Infinity',
    'nul',
    '"\n"',
    '"\\x"',
    '"\\u12"',
    '"\\u12G4"',
    '1 2',
    '\ufeff{}',
    '{"a":1,"a":2}',
    '{"a":1,"\\u0061":2}',
    '"\\ud800"',
    '"\\udc00\\ud800"',
    '1e999',
    '-1e999',
    '[1 2]',
    '{"a" 1}',
    '\u00a01',
    '[\v1]',
    '"\\',
    '\0',
    '{"a":1}}',
  ];
  for (const text of texts) assert.throws(() => parseJson(bytes(text)), SyntaxError, text);
  assert.throws(() => parseJson(Uint8Array.of(34, 0xff, 34)), SyntaxError);
  assert.throws(() => parseJson(Uint8Array.of(34, 0xed, 0xa0, 0x80, 34)), SyntaxError);
});

test('JSON may have 64 levels, not 65', () => {
  assert.ok(parseJson(bytes('['.repeat(64) + ']'.repeat(64))));
  assert.throws(() => parseJson(bytes('['.repeat(65) + ']'.repeat(65))), SyntaxError);
  assert.throws(() => parseJson(bytes('['.repeat(1_000_000))), SyntaxError);
});

test('ldexp is exact, or returns 0 or Infinity', () => {
  assert.equal(ldexp(0.1, 10), 102.4);
  assert.equal(ldexp(2 ** -1022, 2045), 2 ** 1023);
  assert.equal(ldexp(1.5, -1022), 1.5 * 2 ** -1022);
  assert.equal(ldexp(1, 1024), Infinity);
  assert.equal(ldexp(1, -1023), 0);
  assert.equal(ldexp(Number.MAX_VALUE, 32767), Infinity);
  assert.equal(ldexp(Number.MAX_VALUE, -32768), 0);
});
