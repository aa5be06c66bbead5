// SPDX-License-Identifier: Apache-2.0
// Budgets, options and invalid arguments.
import assert from 'node:assert/strict';
import { test } from 'node:test';

import { CRC_SIZE, crc32 } from '../checksums.mjs';
import { tableBytes } from '../codebooks.mjs';
import { CsplatReader, LimitError, decode, readHeader } from '../decoder.mjs';
import { drawnOtherwise } from '../registry.mjs';
import { HEADER_OFFSETS, HEADER_SIZE } from '../spec.mjs';
import { forged, hash, manifest, refusal, serve, vector } from './helpers.mjs';

const rich = vector('valid/rich');

test('a budget of exactly the number of splats suffices, one less does not', async () => {
  const { splatCount } = readHeader(rich);
  await decode(rich, { limits: { splats: splatCount } });
  const error = await refusal(() => decode(rich, { limits: { splats: splatCount - 1 } }));
  assert.ok(error instanceof LimitError);
  assert.deepEqual([error.code, error.clause], ['E_LIMIT', 'LIM-1']);
});

test('a budget of bytes counts arrays and tables before they are allocated', async () => {
  const file = vector('extreme/tile_of_65536');
  const { count, means, quats, scales, opacities, sh0, shN } = await decode(file);
  const bytes = [means, quats, scales, opacities, sh0, shN].reduce((sum, array) => sum + array.byteLength, 0);
  assert.equal(count, 65536);
  await decode(file, { limits: { bytes } });
  assert.equal((await refusal(() => decode(file, { limits: { bytes: bytes - 1 } }))).code, 'E_LIMIT');
  assert.equal((await refusal(() => decode(file, { form: 'integers', limits: { bytes } }))).code, 'E_LIMIT');
});

test('a budget of bytes counts four for each entry and column of a codebook', () => {
  const columns = { shape: 6 };
  const kinds = new Set();
  for (const { name } of manifest.filter(({ name }) => name.startsWith('valid/codebook_'))) {
    const { codebooks, directory } = readHeader(vector(name));
    let bytes = 0;
    for (const { kind, bandFirst, bandLast, size } of codebooks) {
      kinds.add(kind);
      for (let l = bandFirst; l <= bandLast; l++) bytes += 4 * size * (columns[kind] ?? 3 * (2 * l + 1));
    }
    assert.equal(tableBytes(directory, new Map(codebooks.map((codebook) => [codebook.id, codebook]))), bytes, name);
  }
  assert.deepEqual([...kinds].sort(), [...Object.keys(columns), 'sh'].sort());
});

test('a budget of JSON counts the bytes and the values of the text', async () => {
  const file = vector('valid/worked_example'); // {"title":"two"}: 15 bytes and 2 values
  assert.deepEqual((await decode(file, { limits: { jsonBytes: 248 } })).metadata, { title: 'two' });
  for (const jsonBytes of [247, 120, 119])
    assert.equal((await refusal(() => decode(file, { limits: { jsonBytes } }))).clause, 'STR-8', `${jsonBytes}`);
});

test('an index beyond the budget is refused before its records are read, or requested', async (t) => {
  const { url, requests } = await serve(t, rich);
  const options = { limits: { bytes: 1000 }, firstBytes: 32 };
  for (const read of [() => readHeader(rich, options), () => CsplatReader.open(url, options)]) {
    const error = await refusal(read);
    assert.deepEqual([error.code, error.clause], ['E_LIMIT', 'LIM-1']);
  }
  assert.deepEqual(requests, ['bytes=0-31']);
});

test('the bytes of a long answer are complete, and a short one takes no memory of the announced size', async () => {
  const size = 40_000_001;
  const header = forged(rich, (_, view) => {
    view.setUint32(HEADER_OFFSETS.index_size, size, true);
    view.setBigUint64(HEADER_OFFSETS.file_size, BigInt(HEADER_SIZE + size), true);
  }).subarray(0, HEADER_SIZE);
  const file = new Uint8Array(HEADER_SIZE + size).map((_, i) => header[i] ?? i ** 2);
  const open = (sent, status = 206) =>
    refusal(() =>
      CsplatReader.open('http://example.test/x.csplat', {
        retries: 0,
        fetch: async (_, { headers }) => {
          const [start, last] = /(\d+)-(\d+)/.exec(new Headers(headers).get('range')).slice(1).map(Number);
          const end = Math.min(last + 1, sent.length);
          if (start >= end) return new Response(null, { status: 503 });
          const range = `bytes ${start}-${end - 1}/${file.length}`;
          return new Response(sent.subarray(start, end), { status, headers: { 'content-range': range } });
        },
      }),
    );
  const computed = crc32(file.subarray(HEADER_SIZE, -CRC_SIZE)).toString(16);
  assert.match((await open(file)).message, new RegExp(`IDX-1.*computed 0x0*${computed}`));
  const before = process.memoryUsage().arrayBuffers;
  await open(file.subarray(0, 100_000));
  assert.ok(process.memoryUsage().arrayBuffers < before + 30e6);
});

test('a file of a higher resource level is refused from its header', async () => {
  const file = vector('extreme/resource_level_b');
  assert.equal(readHeader(file, { limits: { resourceLevel: 'B' } }).resourceLevel, 'B');
  const limits = { resourceLevel: 'A' };
  for (const run of [() => readHeader(file.slice(0, 32), { limits }), () => CsplatReader.open(file, { limits })]) {
    const error = await refusal(run);
    assert.deepEqual([error.code, error.clause, error.offset], ['E_LIMIT', 'LIM-2', 13]);
  }
  assert.equal((await refusal(() => decode(file, { limits: { resourceLevel: 'D' } }))).code, 'E_INPUT');
});

for (const name of ['extreme/seeded', 'valid/sh_degree_4_mixed']) {
  test(`${name}: a lower SH degree gives the rows of the lower bands`, async () => {
    const file = vector(name);
    const whole = await decode(file);
    const width = whole.shN.length / whole.count;
    for (const shDegree of [0, 1, 2, 3, 4, 7]) {
      const part = await decode(file, { shDegree });
      const values = 3 * ((Math.min(shDegree, whole.shDegree) + 1) ** 2 - 1);
      assert.equal(part.shN.length, values * part.count);
      for (let i = 0; i < part.count; i++) {
        const [start, other] = [values * i, width * i];
        assert.deepEqual(part.shN.slice(start, start + values), whole.shN.slice(other, other + values));
      }
      assert.equal(hash(part.sh0), hash(whole.sh0));
    }
  });
}

test('files of other versions are refused by name', async () => {
  assert.equal(readHeader(rich).version, '1.0');
  for (const [name, version] of [
    ['major_below', '0.0'],
    ['major_above', '2.0'],
    ['minor_above', '1.1'],
  ]) {
    const error = await refusal(() => readHeader(vector(`invalid/header_version_${name}`)));
    assert.ok(error.message.endsWith(`has version ${version}, this decoder reads 1.0`));
  }
});

test('other kernels are refused by name, other ways of drawing are returned', async () => {
  for (const [id, name] of [...['SURFEL', 'BETA', 'TRIANGLE'].entries(), [3, '4']]) {
    const error = await refusal(() => readHeader(vector(`invalid/index_head_kernel_is_${id + 1}`)));
    assert.ok(error.message.endsWith(`kernel ${name} is not supported`));
  }
  assert.equal(drawnOtherwise(readHeader(rich)), '');
  const { projection, antialiasing, colourSpace } = readHeader(vector('valid/ancillary_hints'));
  assert.deepEqual([projection, antialiasing, colourSpace], [128, 128, 128]);
  const known = readHeader(vector('valid/scene_facts'));
  assert.equal(known.antialiased, true);
  assert.equal(drawnOtherwise(known), 'colours of lin_rec709_display are drawn as sRGB');
  assert.equal(
    drawnOtherwise(readHeader(vector('valid/ancillary_hints_private'))),
    'the projection 255 is drawn in perspective, colours of 255 are drawn as sRGB',
  );
});

test('tiles are returned in the requested order', async () => {
  const whole = await decode(rich);
  const [a, b] = whole.header.tiles;
  const swapped = await decode(rich, { tiles: [1, 0] });
  const second = whole.means.slice(3 * b.first);
  assert.deepEqual([...swapped.means], [...second, ...whole.means.slice(0, 3 * a.splatCount)]);
  const integers = await decode(rich, { tiles: [1], form: 'integers' });
  assert.deepEqual([...integers.tile_splats], [b.splatCount]);
  assert.equal((await decode(rich, { tiles: [] })).count, 0);
});

test('progress ends at all splats, and an abort is passed on', async () => {
  const seen = [];
  const { count } = await decode(rich, { onProgress: (done, total) => seen.push([done, total]) });
  assert.deepEqual(seen.at(-1), [count, count]);
  const reason = new Error('enough');
  await assert.rejects(decode(rich, { signal: AbortSignal.abort(reason) }), reason);
});

test('data may be an ArrayBuffer, any view, or shared memory', async () => {
  const shared = new Uint8Array(new SharedArrayBuffer(rich.length));
  shared.set(rich);
  const shifted = new Uint8Array(rich.length + 3);
  shifted.set(rich, 3);
  const whole = hash((await decode(rich)).means);
  for (const data of [rich.slice().buffer, new DataView(rich.buffer), Buffer.from(rich), shared, shifted.subarray(3)]) {
    assert.equal(hash((await decode(data)).means), whole);
  }
});

test('invalid arguments are E_INPUT', async () => {
  const reader = await CsplatReader.open(new Blob([rich]));
  const mistakes = [
    () => decode('a string'),
    () => decode(null),
    () => decode(rich, { form: 'doubles' }),
    () => decode(rich, { shDegree: -1 }),
    () => decode(rich, { shDegree: 1.5 }),
    () => decode(rich, { tiles: [2] }),
    () => decode(rich, { tiles: [-1] }),
    () => decode(rich, { limits: { splats: -1 } }),
    () => decode(rich, { limits: { splat: 1 } }),
    () => decode(rich, { limits: { bytes: '1' } }),
    () => decode(vector('valid/coder_deflate_fixed'), { inflate: () => new Uint8Array(1) }),
    () => CsplatReader.open(42),
    () => reader.readTile(2),
    () => reader.readLayer(0, 5),
    () => reader.readLayer(0, 8),
  ];
  for (const mistake of mistakes) {
    const error = await refusal(mistake);
    assert.deepEqual([error.name, error.code], ['InputError', 'E_INPUT'], String(mistake));
  }
});
