// SPDX-License-Identifier: Apache-2.0
// The encoder: files that csplat-decoder reads, errors, progress, workers. Also: tasks. That its files equal those of the encoder
// in C, whose tests compare them with Python's, is tested by tests/system/test_js_encoder.py.
import assert from 'node:assert/strict';
import { readFileSync } from 'node:fs';
import { test } from 'node:test';

import { decode } from '../../js/decoder.mjs';
import { CsplatError, encode, encodePly, readPly } from '../encoder.mjs';

const sample = new Uint8Array(readFileSync(new URL('../../../tools/csplat_tools/data/sample.ply', import.meta.url)));
const NAMES = /** @type {const} */ (['means', 'quats', 'scales', 'opacities', 'sh0', 'shN']);

/** Some splats of the sample. @param {number} count */
async function someSplats(count) {
  const all = await readPly(sample);
  const total = all.opacities.length;
  const parts = NAMES.map((name) => [name, all[name].slice(0, (all[name].length / total) * count)]);
  return /** @type {import('../encoder.d.ts').Splats} */ (Object.fromEntries(parts));
}

/** A PLY in text. @param {string[][]} rows */
function textPly(...rows) {
  const names = 'x y z rot_0 rot_1 rot_2 rot_3 scale_0 scale_1 scale_2 opacity f_dc_0 f_dc_1 f_dc_2'.split(' ');
  const lines = names.map((name) => `property float ${name}`);
  const text = ['ply', 'format ascii 1.0', `element vertex ${rows.length}`, ...lines, 'end_header'];
  return new TextEncoder().encode([...text, ...rows.map((row) => row.join(' ')), ''].join('\n'));
}

test('encodes what the decoder decodes, near the source and within the source index', async () => {
  const splats = await readPly(sample);
  const count = splats.opacities.length;
  const sourceIndex = new Uint32Array(count);
  const file = await encode(splats, { sourceIndex });
  const scene = await decode(file.buffer);
  assert.equal(scene.opacities.length, count);
  assert.equal(scene.shN.length, 45 * count);
  assert.deepEqual(
    [...sourceIndex].sort((a, b) => a - b),
    [...Array(count).keys()],
  );
  sourceIndex.forEach((row, i) => {
    assert.ok(Math.abs(scene.opacities[i] - splats.opacities[row]) < 0.1);
    for (let k = 0; k < 3; k++) assert.ok(Math.abs(scene.means[3 * i + k] - splats.means[3 * row + k]) < 0.01);
  });
});

test('encodes a PLY, here and in a worker, to the same bytes', async () => {
  const expected = await encode(await readPly(sample));
  assert.deepEqual((await encodePly(sample)).file, expected);
  assert.deepEqual((await encodePly(sample, { worker: true })).file, expected);
  const splats = await readPly(sample.buffer, { worker: true });
  const sourceIndex = new Uint32Array(splats.opacities.length);
  assert.deepEqual(await encode(splats, { worker: true, sourceIndex }), expected);
  assert.ok(sourceIndex.some((row) => row > 0));
});

test('encodes here if no worker starts, and refuses if one fails at work', async () => {
  const expected = await encode(await readPly(sample));
  /** Ways to fail. @type {Record<string, (worker: EventTarget) => void>} */
  const ways = {
    construction: () => {
      throw new DOMException('forbidden', 'SecurityError');
    },
    script: (worker) => setTimeout(() => worker.dispatchEvent(new Event('error')), 1),
    message: (worker) => setTimeout(() => worker.dispatchEvent(new Event('messageerror')), 1),
    work: (worker) => {
      setTimeout(() => worker.dispatchEvent(new MessageEvent('message', { data: { done: 0.5 } })), 1);
      setTimeout(() => worker.dispatchEvent(new Event('error')), 2);
    },
  };
  const page = /** @type {any} */ (globalThis);
  for (const [name, way] of Object.entries(ways)) {
    page.Worker = class extends EventTarget {
      constructor() {
        super();
        way(this);
      }
      postMessage() {}
      terminate() {}
    };
    const encoded = encodePly(sample, { worker: true });
    if (name === 'work') {
      await assert.rejects(encoded, (error) => error instanceof CsplatError && error.code === 'E_LIMIT');
    } else assert.deepEqual((await encoded).file, expected, name);
  }
  delete page.Worker;
});

test('states fields and metadata', async () => {
  const splats = await someSplats(300);
  const fields = {
    origin: [4e6, 0, -1.5],
    axes: 'RDF',
    unitMetres: 0.5,
    antialiased: true,
    flat: true,
    colourSpace: 1,
  };
  const scene = await decode((await encode({ ...splats, ...fields, metadata: { title: 'Zürich' } })).buffer);
  const { origin, axes, unitMetres, antialiased, flat, colourSpace } = scene.header;
  assert.deepEqual({ origin, axes, unitMetres, antialiased, flat, colourSpace }, fields);
  assert.deepEqual(scene.metadata, { title: 'Zürich' });
  for (const worker of [false, true]) {
    const again = await decode((await encode(scene, { worker })).buffer);
    assert.deepEqual([again.header.origin, again.header.axes, again.header.flat], [origin, axes, flat]);
    assert.deepEqual((await decode((await encode({ ...scene, axes: 'RUB' }, { worker })).buffer)).header.axes, 'RUB');
  }
});

test('reports progress, and stops', async () => {
  for (const worker of [false, true]) {
    /** @type {number[]} */
    const fractions = [];
    await encodePly(sample, { worker, onProgress: (done) => fractions.push(done) });
    assert.deepEqual(
      fractions,
      [...fractions].sort((a, b) => a - b),
    );
    assert.ok(fractions.length > 3 && /** @type {number} */ (fractions.at(-1)) <= 1);
    const controller = new AbortController();
    const { signal } = controller;
    await assert.rejects(
      encodePly(sample, { worker, signal, onProgress: () => controller.abort() }),
      (/** @type {Error} */ error) => error.name === 'AbortError',
    );
    await assert.rejects(encodePly(sample, { worker, signal }), { name: 'AbortError' });
  }
});

test('reads numbers in text', async () => {
  const values = ['1', '-2.5', '3e1', '1', '0', '0', '0', '-inf', '-1', '.5', 'Infinity', '1.', '-0', '+1E-2'];
  const { means, scales, opacities, sh0 } = await readPly(textPly(values));
  assert.deepEqual([...means], [1, -2.5, 30]);
  assert.deepEqual([...scales], [-88, -1, 0.5]);
  assert.deepEqual([...opacities], [1]);
  assert.deepEqual([...sh0], [1, -0, Math.fround(0.01)]);
});

test('reports rows that are left out', async () => {
  const ones = Array(14).fill('1');
  const ply = textPly(ones, ['nan', ...ones.slice(1)], [...ones.slice(1), '-inf'], ones);
  for (const worker of [false, true]) {
    const { file, splatCount, rowCount } = await encodePly(ply, { worker });
    assert.deepEqual([splatCount, rowCount, (await decode(file.buffer)).count], [2, 4, 2]);
  }
});

test('refuses invalid input with one line', async () => {
  const splats = await someSplats(10);
  const ones = Array(14).fill('1');
  const cases = [
    [() => readPly(new Uint8Array()), 'the PLY header has no line end_header'],
    [() => readPly(textPly([...ones.slice(1), 'one'])), "line 19: row 0 contains 'one', expected a number"],
    [() => readPly(textPly(Array(13).fill('1.0'))), 'line 19: row 0 has 13 values, expected 14'],
    [() => readPly(textPly(['nan', ...ones.slice(1)])), 'all 1 rows contain NaN or infinity'],
    [() => encodePly(sample.subarray(0, 100000)), 'the file is cut off: it has no room for its rows'],
    [() => encode({ ...splats, means: new Float32Array(29) }), 'means is not a Float32Array of 30'],
    [() => encode({ ...splats, means: new Float32Array(30).fill(NaN) }), 'means contains NaN or infinity'],
    [
      () => encode({ ...splats, shN: new Float32Array(20) }),
      'shN has 20 elements, which match no SH degree from 0 to 4',
    ],
    [
      () => encode({ ...splats, positions: new Float64Array(30) }),
      'mean 0 is not its position minus the origin, rounded',
    ],
    [() => encode({ ...splats, axes: 'RRU' }), 'axes are not three directions along three lines, such as RDF'],
    [() => encode(splats, { sourceIndex: new Uint32Array(3) }), 'sourceIndex has 3 elements, expected 10'],
    [() => encodePly(new Uint8Array(3), { worker: true }), 'the PLY header has no line end_header'],
  ];
  for (const [run, message] of /** @type {[() => Promise<unknown>, string][]} */ (cases)) {
    await assert.rejects(run, (/** @type {CsplatError} */ error) => {
      assert.ok(error instanceof CsplatError);
      assert.deepEqual([error.code, error.message], ['E_INPUT', `E_INPUT: ${message}`]);
      return true;
    });
  }
});

test('encodes a scene without splats', async () => {
  const empty = new Float32Array();
  const splats = { means: empty, quats: empty, scales: empty, opacities: empty, sh0: empty };
  assert.equal((await decode((await encode(splats)).buffer)).opacities.length, 0);
});
