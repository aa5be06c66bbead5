// SPDX-License-Identifier: Apache-2.0
// The form 'packed' has the same values as the form 'floats', for every vector and layer.
import assert from 'node:assert/strict';
import { test } from 'node:test';

import { CsplatReader, decode } from '../decoder.mjs';
import { zlibInflate } from '../inflate.mjs';
import { allTiles } from '../tile_records.mjs';
import { failures, hash, manifest, refusal, vector } from './helpers.mjs';

const valid = manifest.filter(({ error }) => error.code === undefined);

/** Values of columns, [splat, column], with the columns in the order of `place`. */
function values({ columns, offsets, step }, place = (c) => c) {
  const n = columns.length / offsets.length;
  const out = new Float32Array(columns.length);
  for (let c = 0; c < offsets.length; c++)
    for (let i = 0; i < n; i++) out[i * offsets.length + place(c)] = (offsets[c] + columns[c * n + i]) * step;
  return out;
}

/** Values of colours, [splat, coefficient, channel], after codebook lookup. */
function colours(packed, count) {
  const width = packed.offsets.length;
  const place = (c) => 3 * (c % (width / 3)) + Math.floor((3 * c) / width);
  const direct = values(packed, place);
  if (!packed.rows) return direct;
  const out = new Float32Array(count * width);
  if (packed.lookup) {
    const entries = values(packed.lookup.table, place);
    packed.lookup.index.forEach((row, i) => out.set(entries.subarray(row * width, (row + 1) * width), i * width));
  }
  packed.rows.forEach((splat, i) => out.set(direct.subarray(i * width, (i + 1) * width), splat * width));
  return out;
}

/** Opacities of spec 7.3. */
function alphas({ columns, offsets }, { levels, mapping }) {
  const square = mapping === 'square';
  return Float32Array.from(columns, (element) => {
    const q = offsets[0] + element;
    return square ? (q * q) / (levels * levels) : q / levels;
  });
}

/** Quats of spec 7.5. */
function rotations({ columns, offsets }, { levels }) {
  const n = columns.length / 3;
  const c = 1 / (levels * Math.SQRT2);
  const out = new Float32Array(4 * n);
  for (let i = 0; i < n; i++) {
    const q = [0, 1, 2].map((axis) => offsets[axis] + columns[axis * n + i]);
    out[4 * i] = Math.sqrt(2 * levels * levels - q[0] * q[0] - q[1] * q[1] - q[2] * q[2]) * c;
    q.forEach((one, axis) => (out[4 * i + 1 + axis] = one * c));
  }
  return out;
}

const inflate = await zlibInflate();
const ways = { WebAssembly: {}, JavaScript: { inflate } };

for (const [way, options] of Object.entries(ways)) {
  test(`packed integers of every vector have the values of the floats, by ${way}`, async () => {
    const failed = await failures(valid, async ({ name }) => {
      const reader = await CsplatReader.open(new Blob([vector(name)]), options);
      const record = Object.fromEntries(reader.header.attributes.map((one) => [one.name, one]));
      for (const { index } of allTiles(reader.header)) {
        const floats = await reader.readLayer(index, 0);
        const packed = await reader.readLayer(index, 0, { form: 'packed' });
        assert.equal(hash(values(packed.means)), hash(floats.means));
        assert.equal(hash(values(packed.scales)), hash(floats.scales));
        assert.equal(hash(colours(packed.sh0)), hash(floats.sh0));
        assert.equal(hash(alphas(packed.opacities, record.opacities)), hash(floats.opacities));
        assert.equal(hash(rotations(packed.quats, record.quats)), hash(floats.quats));
        for (let layer = 1; layer <= reader.header.shDegree; layer++) {
          const band = await reader.readLayer(index, layer);
          const integers = await reader.readLayer(index, layer, { form: 'packed' });
          if (band === null) assert.equal(integers, null);
          else assert.equal(hash(colours(integers.sh, band.count)), hash(band.sh), `layer ${layer}`);
        }
        const { shDegree } = reader.header;
        const whole = await reader.readTile(index, { form: 'packed' });
        assert.deepEqual(whole.means, packed.means);
        assert.equal(whole.sh.length, shDegree);
        for (const [i, sh] of whole.sh.entries()) {
          const integers = await reader.readLayer(index, i + 1, { form: 'packed' });
          assert.deepEqual(sh, integers && integers.sh);
        }
      }
    });
    assert.deepEqual(failed, {});
  });
}

test('a codebook stays a table, the same object for every tile, with one table per band', async () => {
  const reader = await CsplatReader.open(new Blob([vector('valid/codebook_sh_1_3')]));
  const [one, again, other] = await Promise.all(
    [1, 1, 2].map((layer) => reader.readLayer(0, layer, { form: 'packed' }).then(({ sh }) => sh.lookup)),
  );
  assert.equal(one.table, again.table);
  assert.notEqual(one.table, other.table);
  assert.ok(one.index instanceof Uint8Array);
  assert.deepEqual(one.index, other.index);
});

test('elements have the narrowest possible type', async () => {
  const reader = await CsplatReader.open(new Blob([vector('valid/rich')]));
  const { means, quats, opacities } = await reader.readLayer(0, 0, { form: 'packed' });
  const { extent, corner } = reader.header.tiles[0];
  assert.deepEqual(means.offsets, corner);
  assert.equal(means.columns.BYTES_PER_ELEMENT, Math.max(...extent) < 256 ? 1 : Math.max(...extent) < 65536 ? 2 : 4);
  assert.equal(opacities.columns.length, reader.header.tiles[0].splatCount);
  assert.equal(quats.columns.length, 3 * opacities.columns.length);
});

test('budgets apply to the form packed', async () => {
  const reader = await CsplatReader.open(new Blob([vector('valid/rich')]), { limits: { splats: 1 } });
  assert.equal((await refusal(() => reader.readLayer(0, 0, { form: 'packed' }))).code, 'E_LIMIT');
});

test('tiles can be packed up to a degree, whole scenes cannot', async () => {
  const file = vector('valid/rich');
  const reader = await CsplatReader.open(new Blob([file]));
  assert.equal((await reader.readTile(0, { form: 'packed', shDegree: 1 })).sh.length, 1);
  assert.equal((await refusal(() => decode(file, { form: 'packed' }))).code, 'E_INPUT');
});
