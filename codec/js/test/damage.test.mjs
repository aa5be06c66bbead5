// SPDX-License-Identifier: Apache-2.0
// Damaged files are refused with a CsplatError: they are not decoded, and cause no other exception.
import assert from 'node:assert/strict';
import { test } from 'node:test';

import { CsplatError, decode, readHeader } from '../decoder.mjs';
import { HEADER_SIZE } from '../spec.mjs';
import { forged, refusal, vector } from './helpers.mjs';

const example = vector('valid/worked_example');

test('every prefix of the worked example is refused', async () => {
  for (let size = 0; size < example.length; size++) {
    const { code } = await refusal(() => decode(example.subarray(0, size)));
    assert.equal(code, 'E_TRUNCATED', `${size} bytes`);
  }
});

test('flipped bits of the worked example are refused', async () => {
  for (let bit = 0; bit < 8 * example.length; bit += 3) {
    const damaged = example.slice();
    damaged[bit >> 3] ^= 1 << (bit & 7);
    const { code } = await refusal(() => decode(damaged));
    const allowed = bit < 64 ? ['E_MAGIC'] : ['E_VERSION', 'E_CRC'];
    assert.ok(allowed.includes(code), `bit ${bit}: ${code}`);
  }
});

test('other content that servers send in place of a file is named', async () => {
  for (const [text, pattern] of [
    ['version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 9\n', /pointer of Git LFS/],
    ['\n<!DOCTYPE html><html><head></head><body>Not Found</body></html>', /web page/],
    ['ply\nformat binary_little_endian 1.0\nelement vertex 1\n', /a PLY/],
    ['something else that is long enough for a header', /csplat file: byte 0/],
  ]) {
    const { code, message } = await refusal(() => decode(new TextEncoder().encode(text)));
    assert.equal(code, 'E_MAGIC');
    assert.match(message, pattern);
  }
});

test('bytes after the end are refused', async () => {
  const longer = new Uint8Array(example.length + 1);
  longer.set(example);
  const { code, offset } = await refusal(() => decode(longer));
  assert.deepEqual([code, offset], ['E_TRAILING', example.length]);
});

test('flipped bits under repaired checksums give a scene or a CsplatError', async () => {
  for (const [name, step] of [
    ['valid/rich', 7],
    ['extreme/seeded', 23],
    ['valid/codebook_shape_escape', 3],
    ['valid/levels_of_the_rich_scene', 11],
  ]) {
    const file = vector(name);
    let random = 1;
    let refused = 0;
    for (let at = 0; at < file.length; at += step) {
      random = (Math.imul(random, 1103515245) + 12345) >>> 0;
      const bytes = forged(file, (copy) => (copy[at] ^= 1 << (random >>> 29)));
      await decode(bytes).catch((error) => {
        if (!(error instanceof CsplatError)) throw new Error(`${name}, byte ${at}`, { cause: error });
        refused++;
      });
    }
    assert.ok(refused > file.length / step / 4, `${name}: ${refused} of ${file.length / step} refused`);
  }
});

test('words of all ones and all zeros under repaired checksums give a scene or a CsplatError', async () => {
  const file = vector('valid/rich');
  for (const [place, value] of [0xffffffff, 0, 0x7fffffff, 0x80000000].entries()) {
    for (let at = 8 + 2 * place; at + 4 <= file.length; at += 23) {
      const bytes = forged(file, (_, view) => view.setUint32(at, value, true));
      await decode(bytes).catch((error) => {
        if (!(error instanceof CsplatError)) throw new Error(`${value} at byte ${at}`, { cause: error });
      });
    }
  }
});

test('readHeader refuses every prefix that lacks a part of the index', async () => {
  const { indexSize } = readHeader(example);
  for (let size = 0; size < HEADER_SIZE + indexSize; size++) {
    const { code } = await refusal(() => readHeader(example.subarray(0, size)));
    assert.equal(code, 'E_TRUNCATED');
  }
});
