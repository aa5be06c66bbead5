// SPDX-License-Identifier: Apache-2.0
// Texels have the decoder's values, read back as in the shaders, for every conformance vector.
import assert from 'node:assert/strict';
import { readFileSync } from 'node:fs';
import { test } from 'node:test';

import { CsplatReader } from '../../../codec/js/decoder.mjs';
import { failures } from '../../../codec/js/test/helpers.mjs';
import { BLOCK_SPLATS, bitsFor, packBand, packGeometry, packRows, pagesOf } from '../texels.mjs';

const VECTORS = new URL('../../../conformance/csplat_conformance/vectors/', import.meta.url);
const { vectors } = JSON.parse(readFileSync(new URL('manifest.json', VECTORS), 'utf8'));
const valid = vectors.filter(({ error }) => error.code === undefined);
const open = (name) => CsplatReader.open(new Blob([readFileSync(new URL(`${name}.csplat`, VECTORS))]));

const float = (bits) => new Float32Array(Uint32Array.of(bits).buffer)[0];

/** Reads the fields of a splat in order. */
function fields(texels, i) {
  const stride = texels.moreWords;
  const words = [
    ...texels.first.subarray(4 * i, 4 * i + 4),
    ...(texels.more?.subarray(stride * i, stride * (i + 1)) ?? []),
  ];
  let bits = words.reduceRight((sum, word) => (sum << 32n) | BigInt(word), 0n);
  return (width) => {
    const value = Number(bits & ((1n << BigInt(width)) - 1n));
    bits >>= BigInt(width);
    return value;
  };
}

/** A splat's geometry, by the names of the decoder. */
function unpack(texels, i, tile, header) {
  const take = fields(texels, i);
  const [opacity, , quat] = header.attributes;
  const values = (bits, { offsets, step }) =>
    [0, 1, 2].map((c) =>
      ((n) => (bits === 32 ? float(n) : Math.fround(offsets[c]) + n * Math.fround(step)))(take(bits)),
    );
  const means = texels.bits.means.map((bits, axis) => (tile.corner[axis] + take(bits)) * tile.step);
  const level = take(texels.bits.opacities) / opacity.levels;
  const scales = values(texels.bits.scales, texels.scales);
  const q = [0, 1, 2].map(() => take(texels.bits.quats) - quat.levels);
  const w = Math.sqrt(2 * quat.levels ** 2 - q[0] ** 2 - q[1] ** 2 - q[2] ** 2);
  return {
    means,
    quats: [w, ...q].map((one) => one / (quat.levels * Math.SQRT2)),
    scales,
    opacities: [opacity.mapping === 'square' ? level * level : level],
    sh0: values(texels.bits.sh0, texels.sh0),
  };
}

/** Coefficients of a row: r g b of the first, then of the next. */
function row(rows, i, width) {
  const perWord = Math.floor(32 / rows.bits);
  const words = rows.texels.subarray(rows.rowWords * i, rows.rowWords * (i + 1));
  return Array.from({ length: width }, (_, k) => {
    const word = words[Math.floor(k / perWord)];
    if (rows.bits === 32) return float(word);
    const n = (word >>> ((k % perWord) * rows.bits)) & (2 ** rows.bits - 1);
    return (n + rows.offset) * rows.step;
  });
}

/** A splat's coefficients of a band. */
function coefficients(band, table, i, width) {
  if (band.codebook === null) return row(band.rows, i, width);
  const { index, indexBits, size } = band.codebook;
  const perWord = Math.floor(32 / indexBits);
  const at = (index[Math.floor(i / perWord)] >>> ((i % perWord) * indexBits)) & (2 ** indexBits - 1);
  return at < size ? row(table, at, width) : row(band.rows, at - size, width);
}

/** Values agree up to rounding to binary32, relative to the largest of all that share an offset. */
function near(found, wanted, scale, what) {
  assert.equal(found.length, wanted.length, what);
  found.forEach((value, k) => {
    assert.ok(Math.abs(value - wanted[k]) <= 4e-7 * scale, `${what} ${k}: ${value} instead of ${wanted[k]}`);
  });
}

/** Up to about 300 splats of a tile, including the first and the last. */
function some(count) {
  const step = Math.ceil(count / 300);
  return [...Array(Math.ceil(count / step)).keys()].map((k) => k * step).concat(count - 1);
}

const largest = (array) => array.reduce((most, one) => Math.max(most, Math.abs(one)), 1e-30);

test('texels have the values of the decoder for every vector', async () => {
  const failed = await failures(valid, async ({ name }) => {
    const reader = await open(name);
    const { header } = reader;
    for (const tile of header.tiles) {
      const floats = await reader.readLayer(tile.index, 0);
      const packed = await reader.readLayer(tile.index, 0, { form: 'packed' });
      const texels = packGeometry(packed, header.attributes[0], header.attributes[2]);
      const names = ['means', 'quats', 'scales', 'opacities', 'sh0'];
      const scales = Object.fromEntries(names.map((attribute) => [attribute, largest(floats[attribute])]));
      for (const i of some(tile.splatCount)) {
        for (const [attribute, found] of Object.entries(unpack(texels, i, tile, header))) {
          const wanted = [...floats[attribute].subarray(found.length * i, found.length * (i + 1))];
          near(found, wanted, scales[attribute], `${attribute} of splat ${i}`);
        }
      }
      for (let layer = 1; layer <= header.shDegree; layer++) {
        const wanted = await reader.readLayer(tile.index, layer);
        if (wanted === null) continue;
        const { sh } = await reader.readLayer(tile.index, layer, { form: 'packed' });
        const band = packBand(sh, tile.splatCount);
        const table = sh.lookup && packRows(sh.lookup.table);
        const width = 6 * layer + 3;
        const scale = largest(wanted.sh);
        for (const i of some(tile.splatCount)) {
          const values = wanted.sh.subarray(width * i, width * (i + 1));
          near(coefficients(band, table, i, width), [...values], scale, `layer ${layer} of splat ${i}`);
        }
      }
    }
  });
  assert.deepEqual(failed, {});
});

/** Packed columns of integers. */
const columns = (array, offsets, step = 1) => ({ columns: array, offsets, step });

test('a splat of usual precision takes one texel, one of the widest integers eleven words', async () => {
  const levels = { levels: 63 };
  const ordinary = (Type, most) => ({
    count: 1,
    opacities: columns(Uint8Array.of(63), [0], 0),
    scales: columns(Uint8Array.of(100, 50, 0), [-90, -90, -90], 0.1),
    quats: columns(Uint8Array.of(126, 63, 0), [-63, -63, -63], 0),
    means: columns(Uint16Array.of(65535, 0, 1), [0, 0, 0]),
    sh0: columns(Type.of(most, 0, 1), [0, 0, 0], 0.01),
  });
  assert.equal(packGeometry(ordinary(Uint8Array, 127), levels, levels).more, null);
  const wide = packGeometry(
    {
      ...ordinary(Uint32Array, 2 ** 31),
      scales: columns(Float64Array.of(-(2 ** 40), 0, 2 ** 40), [0, 0, 0], 1e-11),
      means: columns(Uint32Array.of(2 ** 24 - 1, 2 ** 24 - 1, 2 ** 24 - 1), [0, 0, 0]),
    },
    { levels: 65535 },
    { levels: 32767 },
  );
  assert.equal(wide.moreWords, 7);
  assert.deepEqual([wide.bits.scales, wide.bits.sh0], [32, 32]);
});

test('rows of columns with far offsets are binary32 patterns', () => {
  const rows = packRows(columns(Uint8Array.of(1, 2, 3), [2 ** 30, 0, -5], 0.5));
  assert.deepEqual([rows.bits, row(rows, 0, 3)], [32, [Math.fround((2 ** 30 + 1) / 2), 1, -1]]);
  const negative = packRows(columns(Float64Array.of(-(2 ** 34), -1, -(2 ** 33)), [0, 0, 0], 1));
  assert.deepEqual(row(negative, 0, 3), [-(2 ** 34), -1, -(2 ** 33)]);
});

test('tiles begin at blocks, and do not cross pages', () => {
  const sizes = (...counts) => counts.map((splatCount) => ({ splatCount }));
  assert.deepEqual(pagesOf(sizes(1, BLOCK_SPLATS, 257), Infinity), { pages: [1024], starts: [0, 256, 512] });
  assert.deepEqual(pagesOf([], Infinity), { pages: [0], starts: [] });
  const large = sizes(...new Array(9).fill(60_000));
  const { pages, starts } = pagesOf(large, 540_000);
  assert.deepEqual([pages, starts[4]], [[240_640, 240_640, 60_160], 240_640]);
});

test('a scene that is larger than the memory has no fixed places', () => {
  const tiles = new Array(20).fill({ splatCount: 60_000 });
  assert.deepEqual(pagesOf(tiles, 1_000_000), { pages: new Array(4).fill(250_112), starts: null });
  assert.deepEqual(pagesOf(tiles, 100), { pages: [60_160], starts: null }); // the largest tile fits
});

test('number of bits of integers', () => {
  assert.deepEqual([0, 1, 2, 255, 256, 2 ** 32 - 1].map(bitsFor), [1, 1, 2, 8, 9, 32]);
});
