// SPDX-License-Identifier: Apache-2.0
// The words of Spark's splats have the values of the file, to the precision of their bits.
import assert from 'node:assert/strict';
import { test } from 'node:test';

import { CsplatReader } from '../decoder.mjs';
import {
  ExtWords,
  PackedWords,
  half,
  halvesSuffice,
  octahedral,
  paddedCount,
  sharedExponent,
} from '../engines/spark-words.mjs';
import { vector } from './helpers.mjs';

/** Decode a float16. */
function ofHalf(bits) {
  const [sign, exponent, fraction] = [bits >> 15 ? -1 : 1, (bits >> 10) & 31, bits & 1023];
  if (exponent === 31) return sign * Infinity;
  return sign * (exponent ? 2 ** (exponent - 15) * (1 + fraction / 1024) : 2 ** -24 * fraction);
}

/** Decode the quaternion w x y z as Spark does. */
function ofOctahedral(word, axisBits, angleBits) {
  const most = 2 ** axisBits - 1;
  let x = ((word & most) / most) * 2 - 1;
  let y = (((word >>> axisBits) & most) / most) * 2 - 1;
  const z = 1 - Math.abs(x) - Math.abs(y);
  const t = Math.max(-z, 0);
  x += x >= 0 ? -t : t;
  y += y >= 0 ? -t : t;
  const turn = (word >>> (2 * axisBits)) / (2 ** angleBits - 1);
  const s = Math.sin((turn * Math.PI) / 2) / Math.hypot(x, y, z);
  return [Math.cos((turn * Math.PI) / 2), x * s, y * s, z * s];
}

const ofShared = (word) =>
  [0, 1, 2].map(
    (c) => ((word >>> (24 + c)) & 1 ? -1 : 1) * ((word >>> (8 * c)) & 255) * (2 ** ((word >>> 27) - 15) / 255),
  );

test('float16 is rounded to nearest', () => {
  for (let bits = 0; bits < 0x7bff; bits += 7) {
    const [low, high] = [ofHalf(bits), ofHalf(bits + 1)];
    assert.deepEqual([half(low), half(-high)], [bits, 0x8000 | (bits + 1)]);
    assert.deepEqual([half(low * 0.51 + high * 0.49), half(low * 0.49 + high * 0.51)], [bits, bits + 1]);
    assert.equal(half((low + high) / 2) % 2, 0);
  }
  assert.deepEqual([half(65519), half(65520), half(-1e9), half(0)], [0x7bff, 0x7c00, 0xfc00, 0]);
});

test('rotations and triples are decoded within the precision of their bits', () => {
  for (let i = 0; i < 2000; i++) {
    const quat = [Math.abs(Math.sin(i)), Math.sin(3 * i), Math.cos(7 * i), Math.sin(11 * i + 1)];
    const norm = Math.hypot(...quat);
    const [w, x, y, z] = quat.map((one) => one / norm);
    for (const [axis, angle, off] of [
      [10, 12, 4e-3],
      [8, 8, 15e-3],
    ]) {
      const found = ofOctahedral(octahedral(w, x, y, z, axis, angle), axis, angle);
      assert.ok(Math.hypot(found[0] - w, found[1] - x, found[2] - y, found[3] - z) < off, `${[w, x, y, z]}: ${found}`);
    }
    const triple = [x, y, z].map((one) => one * 2 ** ((i % 16) - 10));
    const most = Math.max(...triple.map(Math.abs));
    for (const [c, value] of ofShared(sharedExponent(...triple)).entries())
      assert.ok(Math.abs(value - triple[c]) <= most / 250);
  }
  assert.deepEqual([octahedral(1, 0, 0, 0, 10, 12) >>> 20, sharedExponent(0, 0, 0)], [0, 0]);
});

test('arrays fill whole rows and layers of textures', () => {
  assert.deepEqual([1, 2048, 2049, 2048 * 2048 + 1].map(paddedCount), [2048, 2048, 4096, 2 * 2048 * 2048]);
});

test('float32 centres are used if float16 is coarser than the file', () => {
  const tile = (step, max) => ({ tiles: [{ min: [0, 0, 0], max: [0, max, 0], step }] });
  assert.deepEqual([tile(2 ** -11, 1.5), tile(2 ** -11, 2), tile(1, 70000)].map(halvesSuffice), [true, false, false]);
});

for (const [name, flat] of [
  ['valid/rich', false],
  ['valid/codebook_sh_1_3', true],
  ['valid/combined_tiles', false],
]) {
  test(`${name}: both layouts have its values`, async () => {
    const reader = await CsplatReader.open(new Blob([vector(name)]));
    const header = { ...reader.header, flat };
    const tiles = [];
    for (const { index } of header.tiles) tiles.push(await reader.readTile(index, { form: 'packed' }));
    const ext = new ExtWords(header);
    const packed = new PackedWords(header, tiles);
    for (let layer = 1; layer <= header.shDegree; layer++) {
      const bands = header.tiles
        .map(({ first }, i) => ({ first, count: tiles[i].count, sh: tiles[i].sh[layer - 1] }))
        .filter(({ sh }) => sh);
      ext.addBands(layer, bands);
      packed.addBands(layer, bands);
    }
    const { rgbMin, rgbMax, lnScaleMin, lnScaleMax, ...most } = packed.splatEncoding;
    for (const { index, first } of header.tiles) {
      ext.put(tiles[index], first);
      packed.put(tiles[index], first);
      const floats = await reader.readTile(index);
      for (let i = 0; i < floats.count; i++) {
        const at = 4 * (first + i);
        const near = (found, wanted, off, what) =>
          assert.ok(Math.abs(found - wanted) <= off, `${what} ${i}: ${found}, ${wanted}`);
        const [a, b] = ext.extArrays;
        const scales = [...floats.scales.subarray(3 * i, 3 * i + 3)];
        const thin = flat ? scales.indexOf(Math.min(...scales)) : -1;
        for (let c = 0; c < 3; c++) {
          const mean = floats.means[3 * i + c];
          assert.equal(new Float32Array(a.buffer)[at + c], mean);
          if (Math.abs(mean) < 65504)
            near(
              ofHalf(new Uint16Array(packed.packedArray.buffer)[2 * at + 2 + c]),
              mean,
              Math.abs(mean) / 2048 + 1e-7,
              'mean',
            );
          const colour = 0.5 + 0.28209479177387814 * floats.sh0[3 * i + c];
          near(ofHalf(new Uint16Array(b.buffer)[2 * at + c]), colour, Math.abs(colour) / 2048 + 1e-7, 'colour');
          const bytes = new Uint8Array(packed.packedArray.buffer).subarray(4 * at);
          near(rgbMin + ((rgbMax - rgbMin) * bytes[c]) / 255, colour, (rgbMax - rgbMin) / 509, 'colour');
          near(
            ofHalf(new Uint16Array(b.buffer)[2 * at + 3 + c]),
            c === thin ? -30 : scales[c],
            Math.abs(scales[c]) / 2048 + 1e-7,
            'scale',
          );
          if (c === thin) assert.equal(bytes[12 + c], 0);
          else
            near(
              lnScaleMin + ((lnScaleMax - lnScaleMin) * (bytes[12 + c] - 1)) / 254,
              scales[c],
              (lnScaleMax - lnScaleMin) / 507,
              'scale',
            );
        }
        near(ofHalf(a[at + 3]), floats.opacities[i], 1 / 2048, 'alpha');
        near((packed.packedArray[at] >>> 24) / 255, floats.opacities[i], 1 / 509, 'alpha');
        const words = [[], [], []];
        const { sh1, sh2, sh3a, sh3b } = ext.extra;
        if (sh1) words[0].push(...sh1.subarray(at, at + 3));
        if (sh2) words[1].push(sh1[at + 3], ...sh2.subarray(at, at + 4));
        if (sh3a) words[2].push(...sh3a.subarray(at, at + 4), ...sh3b.subarray(at, at + 3));
        const terms = (header.shDegree + 1) ** 2 - 1;
        const shN = floats.shN.subarray(3 * terms * i, 3 * terms * (i + 1));
        for (const [c, value] of words.flat().flatMap(ofShared).entries()) {
          const triple = shN.subarray(c - (c % 3), c - (c % 3) + 3);
          near(value, shN[c], Math.max(...triple.map(Math.abs)) / 250 + 1e-7, 'sh');
        }
        let c = 0;
        for (const [band, bits] of [7, 8, 6].entries()) {
          const array = packed.extra[`sh${band + 1}`];
          const limit = 2 ** (bits - 1) - 1;
          const size = [2, 4, 4][band];
          for (let k = 0; array && k < 3 * (2 * band + 3); k++, c++) {
            const word =
              BigInt(array[size * (first + i) + ((k * bits) >> 5)]) |
              (BigInt(array[size * (first + i) + ((k * bits) >> 5) + 1] ?? 0) << 32n);
            const integer = Number(BigInt.asIntN(bits, word >> BigInt((k * bits) & 31)));
            near((integer * most[`sh${band + 1}Max`]) / limit, shN[c], most[`sh${band + 1}Max`] / limit / 1.99, 'sh');
          }
        }
      }
    }
  });
}
