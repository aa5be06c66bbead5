// SPDX-License-Identifier: Apache-2.0
// The adapters for engines return the numbers of the form 'floats', in the engines' layouts.
import assert from 'node:assert/strict';
import { test } from 'node:test';

import { CsplatReader } from '../decoder.mjs';
import { SplatScene, openScene } from '../engines/scene.mjs';
import { mirroredBand, mirroredGeometry } from '../engines/mirror.mjs';
import {
  places,
  putAlphas,
  putBand,
  putColumns,
  putCovariances,
  putQuats,
  uprightIn,
} from '../engines/packed_values.mjs';
import { allTiles } from '../tile_records.mjs';
import { failures, manifest, vector } from './helpers.mjs';

const same = (value) => value;
/** Covariances computed with matrices. */
function covariances({ count, quats, scales }) {
  const out = [];
  for (let i = 0; i < count; i++) {
    const [w, x, y, z] = quats.subarray(4 * i, 4 * i + 4);
    const rows = [
      [w * w + x * x - y * y - z * z, 2 * (x * y - w * z), 2 * (x * z + w * y)],
      [2 * (x * y + w * z), w * w - x * x + y * y - z * z, 2 * (y * z - w * x)],
      [2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z],
    ].map((row) => row.map((value, axis) => value * Math.exp(scales[3 * i + axis])));
    for (const [p, q] of [
      [0, 0],
      [0, 1],
      [0, 2],
      [1, 1],
      [1, 2],
      [2, 2],
    ]) {
      out.push(rows[p].reduce((sum, value, axis) => sum + value * rows[q][axis], 0));
    }
  }
  return out;
}

const valid = manifest.filter(({ name }) => /^(valid|render)/.test(name));
test("unpacked numbers of every vector equal the decoder's", async () => {
  const failed = await failures(valid, async ({ name }) => {
    const reader = await CsplatReader.open(new Blob([vector(name)]));
    const { header } = reader;
    for (const { index, splatCount: count } of allTiles(header)) {
      const floats = await reader.readTile(index);
      const tile = await reader.readTile(index, { form: 'packed' });
      // A different stride and one splat more than needed, so that no value is at its default position.
      const put = (width, fill) => {
        const array = new Float32Array(8 * (count + 1));
        fill(places(array, 8, 1, width));
        return Float32Array.from(
          { length: width * count },
          (_, at) => array[8 * (1 + Math.floor(at / width)) + 1 + (at % width)],
        );
      };
      assert.deepEqual(
        put(3, (to) => putColumns(tile.means, to, 1, same)),
        floats.means,
      );
      assert.deepEqual(
        put(3, (to) => putColumns(tile.scales, to, 1, same)),
        floats.scales,
      );
      assert.deepEqual(
        put(1, (to) => putAlphas(tile, header, to[0], 1, same)),
        floats.opacities,
      );
      assert.deepEqual(
        put(4, (to) => putQuats(tile.quats, header, to, 1, same)),
        floats.quats,
      );
      assert.deepEqual(
        put(3, (to) => putBand(tile.sh0, to, 1, same)),
        floats.sh0,
      );
      const width = floats.shN.length / count;
      const shN = new Float32Array(width * (count + 1));
      for (const [i, band] of tile.sh.entries()) {
        if (band) putBand(band, places(shN, width, 3 * ((i + 1) ** 2 - 1), 3 * (2 * i + 3)), 1, same);
      }
      assert.deepEqual(shN.subarray(width), floats.shN);
      const out = new Float32Array(6 * (count + 1));
      putCovariances(tile, { ...header, flat: false }, out, 1);
      for (const [at, expected] of covariances(floats).entries()) {
        const [of, p] = [at - (at % 6), at % 6];
        const length = Math.max(out[6 + of], out[9 + of], out[11 + of]); // off-diagonal values may cancel
        if (length < 1e38) assert.ok(Math.abs(out[6 + at] - expected) <= 1e-6 * length, `${p} of splat ${of / 6}`);
      }
    }
  });
  assert.deepEqual(failed, {});
});

// Per axis, the SH coefficients that are odd along it: y z x, xy yz zz xz xx, …
const ODD = [
  [0, 0, 1, 1, 0, 0, 1, 0, 0, 1, 0, 0, 1, 0, 1],
  [1, 0, 0, 1, 1, 0, 0, 0, 1, 1, 1, 0, 0, 0, 0],
  [0, 1, 0, 0, 1, 0, 1, 0, 0, 1, 0, 1, 0, 1, 0],
];
for (const [name, mirror] of [
  ['valid/rich', [1, -1, -1]],
  ['valid/rich', [1, -1, 1]],
  ['valid/codebook_sh_1_3', [-1, 1, 1]],
  ['valid/codebook_sh_1_3', [-1, -1, -1]],
  ['valid/combined_tiles', [-1, 1, 1]],
]) {
  test(`${name}: mirroring by ${mirror} changes exactly the signs of values that are odd`, async () => {
    const reader = await CsplatReader.open(new Blob([vector(name)]));
    const { header } = reader;
    const negative = mirror.map((sign) => (sign < 0 ? 1 : 0));
    const reversed = (negative[0] + negative[1] + negative[2]) % 2; // axes of rotations are no vectors
    const odd = ODD[0].map((_, i) => negative.reduce((sum, one, axis) => sum + one * ODD[axis][i], 0) % 2);
    for (const { index, splatCount: count } of header.tiles) {
      const floats = await reader.readTile(index);
      const packed = await reader.readTile(index, { form: 'packed' });
      const tile = mirroredGeometry(packed, mirror);
      const [means, quats] = [new Float32Array(3 * count), new Float32Array(4 * count)];
      putColumns(tile.means, places(means, 3, 0), 0, same);
      putQuats(tile.quats, header, places(quats, 4, 0, 4), 0, same);
      const signed = (values, signs) => values.map((value, i) => (signs[i % signs.length] ? -value : value) + 0);
      assert.deepEqual(signed(means, [0]), signed(floats.means, negative));
      assert.deepEqual(signed(quats, [0]), signed(floats.quats, [0, ...negative.map((one) => one ^ reversed)]));
      const terms = floats.shN.length / count / 3;
      const shN = new Float32Array(3 * terms * count);
      for (const [i, band] of packed.sh.entries()) {
        if (band)
          putBand(
            mirroredBand(band, i + 1, mirror),
            places(shN, 3 * terms, 3 * ((i + 1) ** 2 - 1), 3 * (2 * i + 3)),
            0,
            same,
          );
      }
      const signs = odd.slice(0, terms).flatMap((one) => [one, one, one]);
      assert.deepEqual(signed(shN, [0]), signed(floats.shN, signs));
      assert.deepEqual(packed.means, (await reader.readTile(index, { form: 'packed' })).means);
    }
  });
}

test('in flat scenes the smallest scale is zero', async () => {
  const reader = await CsplatReader.open(new Blob([vector('valid/rich')]));
  const tile = await reader.readTile(0, { form: 'packed' });
  const [round, flat] = [new Float32Array(6 * tile.count), new Float32Array(6 * tile.count)];
  putCovariances(tile, { ...reader.header, flat: false }, round, 0);
  putCovariances(tile, { ...reader.header, flat: true }, flat, 0);
  const { scales } = await reader.readTile(0);
  for (let i = 0; i < tile.count; i++) {
    const trace = (array) => array[6 * i] + array[6 * i + 3] + array[6 * i + 5];
    const thin = Math.exp(2 * Math.min(...scales.subarray(3 * i, 3 * i + 3)));
    assert.ok(Math.abs(trace(round) - thin - trace(flat)) <= 1e-5 * trace(round) + 1e-30, `splat ${i}`);
  }
});

test('scenes are upright in the axes of an engine', () => {
  const map = (axes, engine, up) => uprightIn({ axes }, { up }, engine);
  assert.deepEqual(map('RUB', 'RUB'), [
    [1, 0, 0],
    [0, 1, 0],
    [0, 0, 1],
  ]);
  assert.deepEqual(map('', 'RUB'), [
    [1, 0, 0],
    [0, -1, 0],
    [0, 0, -1],
  ]);
  assert.deepEqual(map('RDF', 'RUF'), [
    [1, 0, 0],
    [0, -1, 0],
    [0, 0, 1],
  ]);
  assert.deepEqual(map('RFU', 'RUF', 'no direction'), [
    [1, 0, 0],
    [0, 0, 1],
    [0, 1, 0],
  ]);
  for (const up of [
    [0, -1, 0],
    [0, 1, 0],
    [0.6, -0.8, 0],
    [0, 0, 5],
    [2, 3, -1],
  ]) {
    const rows = map('RDF', 'RUF', up);
    const [x, y, z] = rows.map((row) => row.reduce((sum, one, i) => sum + (one * up[i]) / Math.hypot(...up), 0));
    assert.ok(Math.hypot(x, y - 1, z) < 1e-12, `${up} is up`);
    const [a, b, c] = rows;
    const cross = [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
    assert.ok(Math.hypot(...cross.map((one, i) => one + c[i])) < 1e-12, `${up}: a rotation`);
  }
});

const TARGET = { name: 'test', engine: 'RUB', mirrors: true, shDegree: 3 };

test('tiles have the axes of an engine that asks for them, if signs suffice', () => {
  const of = (axes, metadata) =>
    new SplatScene(
      { header: { axes, tiles: [], splatCount: 0 } },
      [],
      { metadata, cameras: null },
      {},
      { ...TARGET, aligns: true },
    );
  const turned = (axes, metadata = null) => of(axes, metadata).upright.map((row) => row.map((value) => value + 0));
  const unit = [0, 1, 2].map((k) => [0, 1, 2].map((i) => (i === k ? 1 : 0)));
  for (const [axes, signs] of Object.entries({
    '': [1, -1, -1],
    RUB: [1, 1, 1],
    LUF: [-1, 1, -1],
    LDF: [-1, -1, -1],
  })) {
    assert.deepEqual([of(axes, null).signs, turned(axes)], [signs, unit]);
  }
  assert.deepEqual(of('RFU', null).signs, [1, 1, 1]);
  assert.deepEqual(turned('RFU'), uprightIn({ axes: 'RFU' }, null, 'RUB'));
  // In these tiles, up is 0, 0.8, 0.6.
  const [, y] = turned('', { up: [0, -0.8, -0.6] });
  assert.deepEqual(y, [0, 0.8, 0.6]);
});

for (const [name, options] of [
  ['valid/combined_codebooks', {}],
  ['valid/combined_codebooks', { progressive: true }],
  ['valid/combined_codebooks', { workers: 0 }],
  ['valid/levels_of_the_rich_scene', { progressive: true }],
  ['valid/levels_of_the_rich_scene', { maxSplats: 1 }],
  ['valid/levels_of_the_rich_scene', { maxSplats: 1, progressive: true }],
]) {
  test(`${name}: a load requests every byte at most once: ${JSON.stringify(options)}`, async () => {
    const bytes = vector(name);
    const asked = [];
    const fetch = async (_url, { headers }) => {
      const [first, last] = new Headers(headers).get('range').slice(6).split('-').map(Number);
      const body = bytes.slice(first, last + 1);
      asked.push([first, first + body.length]);
      const known = {
        'Content-Range': `bytes ${first}-${first + body.length - 1}/${bytes.length}`,
        'Content-Length': body.length,
      };
      return new Response(body, { status: 206, headers: known });
    };
    const scene = await openScene('http://example.org/a.csplat', { ...options, fetch, firstBytes: 64 }, TARGET);
    let count = 0;
    for await (const tile of scene.tiles()) count += tile.count;
    const complete = scene.facts(async () => {
      for (let layer = 1; layer <= scene.degree; layer++)
        for await (const band of scene.bands(layer)) assert.ok(band.count > 0);
    });
    await complete.complete;
    await new Promise((resolve) => setTimeout(resolve)); // lets pending callbacks run
    assert.equal(count, scene.header.splatCount);
    assert.equal(scene.reader, null);
    asked.sort(([a], [b]) => a - b);
    for (const [i, [first]] of asked.entries()) if (i > 0) assert.ok(first >= asked[i - 1][1], `${asked.join(' ')}`);
  });
}

test('progress ends with the size of the file, even if all of it comes at once', async () => {
  const bytes = vector('valid/rich');
  const seen = [];
  const fetch = async () => new Response(bytes); // a server without ranges
  await openScene('https://example.org/scene', { fetch, onProgress: (...now) => seen.push(now) }, TARGET);
  assert.deepEqual(seen.at(-1), [bytes.length, bytes.length]);
});

test('a budget of splats selects the version of cut, renumbered', async () => {
  const bytes = vector('valid/levels_of_a_tree');
  const reader = await CsplatReader.open(new Blob([bytes]));
  const counts = new Set();
  const coarsest = await reader.cut({ level: 255 });
  for (const maxSplats of [...Array(reader.header.splatCount).keys(), Infinity]) {
    const cut = await reader.cut({ maxSplats }).catch(({ code }) => (assert.equal(code, 'E_LIMIT'), coarsest));
    for (const progressive of [false, true]) {
      const scene = await openScene(new Blob([bytes]), { maxSplats, progressive }, TARGET);
      const tiles = [];
      for await (const tile of scene.tiles()) tiles[tile.index] = tile;
      const { header, splatCount, complete } = scene.facts(async () => {});
      await complete;
      assert.deepEqual(header, reader.header);
      assert.equal(tiles.length, cut.length);
      let first = 0;
      for (const [number, index] of cut.entries()) {
        const tile = await reader.readTile(index, { form: 'packed', shDegree: progressive ? 0 : undefined });
        assert.deepEqual(tiles[number], { ...tile, index: number, first });
        first += tile.count;
      }
      assert.equal(splatCount, first);
      counts.add(first);
    }
  }
  assert.ok(counts.size > 2, [...counts].join(' '));
});

test('other files ignore the budget', async () => {
  const reader = await CsplatReader.open(new Blob([vector('valid/combined_codebooks')]));
  const scene = await openScene(new Blob([vector('valid/combined_codebooks')]), { maxSplats: 1 }, TARGET);
  assert.deepEqual(scene.header, reader.header);
  scene.release();
});
