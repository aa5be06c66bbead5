// SPDX-License-Identifier: Apache-2.0
// Levels of detail: nodes, cuts, boxes, and the tiles of coarser levels.
import assert from 'node:assert/strict';
import { spawnSync } from 'node:child_process';
import { mkdtempSync, rmSync, writeFileSync } from 'node:fs';
import { tmpdir } from 'node:os';
import { join } from 'node:path';
import { test } from 'node:test';
import { fileURLToPath } from 'node:url';

import { CsplatReader, LimitError, decode, readHeader } from '../decoder.mjs';
import { Payload } from '../payload.mjs';
import { CHUNK_HEADER_SIZE, NODE_RECORD_OFFSETS, NODE_RECORD_SIZE, NO_PARENT } from '../spec.mjs';
import { allTiles } from '../tile_records.mjs';
import { cutAtLevel, cutAtPixelSize, cutWithin, readNodes } from '../tree.mjs';
import { forged, hash, refusal, serve, vector } from './helpers.mjs';

const ADAPTER = fileURLToPath(new URL('./adapter.mjs', import.meta.url));
const FLOATS = ['means', 'quats', 'scales', 'opacities', 'sh0', 'shN'];

const open = (name) => CsplatReader.open(new Blob([vector(name)]));

/** Nodes and header of a random forest with these numbers of nodes per level, one tile per node. */
function forest(counts, seed) {
  let state = seed;
  const random = (most) => {
    state = (Math.imul(state, 1103515245) + 12345) >>> 0;
    return Math.floor((state / 2 ** 32) * most);
  };
  const tiles = [];
  const records = [];
  for (const [level, count] of counts.entries()) {
    const end = records.length + count;
    for (let i = 0; i < count; i++) {
      const corner = [random(9), random(9), random(9)];
      tiles.push({
        index: tiles.length,
        level,
        splatCount: 1 + random(9),
        min: corner,
        max: corner.map((c) => c + random(3)),
      });
      const above = counts[level + 1] ?? 0;
      // The first nodes of a level have the nodes of the next one as parents, so that each of those has a child.
      const parent = i < above ? end + i : above && random(8) ? end + random(above) : NO_PARENT;
      records.push({ parent, error: 0 });
    }
  }
  const below = records.map(() => 0);
  for (const [n, record] of records.entries()) {
    const { level } = tiles[n];
    if (level) {
      tiles[n].splatCount = 1 + random(below[n]);
      record.error += random(3) / 2;
    }
    const parent = records[record.parent];
    if (parent === undefined) continue;
    below[record.parent] += tiles[n].splatCount;
    parent.error = Math.max(parent.error, record.error);
  }
  const bytes = new Uint8Array(NODE_RECORD_SIZE * records.length);
  const view = new DataView(bytes.buffer);
  for (const [n, { parent, error }] of records.entries()) {
    view.setUint32(NODE_RECORD_SIZE * n + NODE_RECORD_OFFSETS.parent, parent, true);
    view.setUint32(NODE_RECORD_SIZE * n + NODE_RECORD_OFFSETS.tile_count, 1, true);
    view.setFloat32(NODE_RECORD_SIZE * n + NODE_RECORD_OFFSETS.error, error, true);
  }
  const header = {
    ...{ resourceLevel: 'A', indexSize: 0, shDegree: 0, extras: [], directory: [], codebooks: [] },
    tiles: tiles.slice(0, counts[0]),
    coarseTiles: tiles.slice(counts[0]),
  };
  return { nodes: readNodes(new Payload(bytes, 0, 'TRE-2'), header), header };
}

/** `cut_within` of the spec, line by line; null if the budget does not suffice. */
function slowCutWithin(nodes, budget) {
  let cut = nodes.filter(({ parent }) => parent === null);
  const count = (list) => list.reduce((sum, { splatCount }) => sum + splatCount, 0);
  if (count(cut) > budget) return null;
  for (;;) {
    const inner = cut.filter(({ level }) => level > 0);
    if (inner.length === 0) break;
    const worst = inner.reduce((a, b) => (b.error > a.error || (b.error === a.error && b.index > a.index) ? b : a));
    const finer = [...cut.filter((node) => node !== worst), ...nodes.filter(({ parent }) => parent === worst.index)];
    if (count(finer) > budget) break;
    cut = finer;
  }
  return cut.map(({ index }) => index).sort((a, b) => a - b);
}

test('nodes have their tiles, children and regions', async () => {
  const reader = await open('valid/levels_of_many_tiles');
  const nodes = await reader.nodes();
  assert.deepEqual(
    nodes.map(({ level, parent, children, firstTile, tileCount, splatCount, error }) => [
      ...[level, parent, children, firstTile, tileCount, splatCount, error],
    ]),
    [
      [0, 2, [], 0, 3, 6, 0],
      [0, 3, [], 3, 2, 6, 0],
      [1, null, [0], 5, 2, 5, 0.75],
      [1, null, [1], 7, 1, nodes[3].splatCount, 0.5],
    ],
  );
  const tiles = allTiles(reader.header);
  assert.deepEqual(
    tiles.map(({ index, level }) => [index, level]),
    [0, 0, 0, 0, 0, 1, 1, 1].map((level, index) => [index, level]),
  );
  for (const [node, below] of [
    [0, [0, 1, 2]],
    [2, [0, 1, 2, 5, 6]],
    [3, [3, 4, 7]],
  ]) {
    for (const axis of [0, 1, 2]) {
      assert.equal(nodes[node].min[axis], Math.min(...below.map((tile) => tiles[tile].min[axis])));
      assert.equal(nodes[node].max[axis], Math.max(...below.map((tile) => tiles[tile].max[axis])));
    }
  }
  assert.equal(await reader.nodes(), nodes); // read once
});

test('a file without levels has one node, an empty file has none', async () => {
  const reader = await open('valid/rich');
  const [node, ...others] = await reader.nodes();
  const { index, level, parent, children, firstTile, tileCount, splatCount, error } = node;
  assert.deepEqual([index, level, parent, children, firstTile, error, others], [0, 0, null, [], 0, 0, []]);
  assert.deepEqual([tileCount, splatCount], [reader.header.tiles.length, reader.header.splatCount]);
  for (const options of [{}, { level: 3 }, { pixelSize: 9 }, { pixelSize: [0] }, { maxSplats: splatCount }])
    assert.deepEqual(await reader.cut(options), [0, 1]);
  assert.equal((await refusal(() => reader.cut({ maxSplats: splatCount - 1 }))).code, 'E_LIMIT');
  const empty = await open('valid/empty');
  assert.deepEqual(await empty.nodes(), []);
  for (const options of [{}, { pixelSize: 1 }, { pixelSize: [] }, { maxSplats: 0 }, { box: [0, 0, 0, 1, 1, 1] }])
    assert.deepEqual(await empty.cut(options), []);
});

test('cuts of random forests are those of the spec', () => {
  for (let seed = 1; seed <= 40; seed++) {
    const { nodes } = forest([40, 12, 5, 2].slice(0, 1 + (seed % 4)), seed);
    const path = (n) => (nodes[n].parent === null ? [n] : [...path(nodes[n].parent), n]); // from the root
    const first = (isReplaced) =>
      nodes.filter(({ index }) => !isReplaced(index) && path(index).slice(0, -1).every(isReplaced)).map((n) => n.index);
    for (const level of [0, 1, 2, 255])
      assert.deepEqual(
        cutAtLevel(nodes, level),
        first((n) => nodes[n].level > level),
      );
    for (const size of [0, 0.25, 0.5, 1, Infinity]) {
      const sizes = nodes.map(({ index }) => (index % 3 ? size : 1));
      assert.deepEqual(
        cutAtPixelSize(nodes, sizes),
        first((n) => nodes[n].error > sizes[n]),
      );
    }
    for (let budget = 0; budget < 260; budget += 7) {
      const wanted = slowCutWithin(nodes, budget);
      if (wanted) assert.deepEqual(cutWithin(nodes, budget), wanted);
      else assert.throws(() => cutWithin(nodes, budget), LimitError);
    }
  }
});

test('cuts of many nodes take no quadratic time', () => {
  const { nodes } = forest([30_000, 15_000, 20], 5);
  const before = performance.now();
  assert.equal(cutWithin(nodes, 1e9).length, cutAtLevel(nodes, 0).length);
  assert.ok(performance.now() - before < 2000);
});

test('a box selects tiles of level 0 one by one, and all tiles of coarser nodes', async () => {
  const touching = (box, min, max) => [0, 1, 2].every((axis) => min[axis] <= box[axis + 3] && max[axis] >= box[axis]);
  for (let seed = 1; seed <= 20; seed++) {
    const { nodes, header } = forest([30, 9, 3], seed);
    const reader = Object.assign(Object.create(CsplatReader.prototype), { header, nodes: async () => nodes });
    const tiles = allTiles(header); // one for each node
    const under = (n) => [n, ...nodes[n].children.flatMap(under)];
    const corner = (n, side) => [0, 1, 2].map((axis) => Math[side](...under(n).map((one) => tiles[one][side][axis])));
    const box = [seed % 5, 2, seed % 3, 4, 4, 4 + (seed % 4)];
    for (const level of [0, 1, 2]) {
      const wanted = cutAtLevel(nodes, level).filter((n) => touching(box, corner(n, 'min'), corner(n, 'max')));
      assert.deepEqual(await reader.cut({ level, box }), wanted);
    }
  }
});

test('a tile touches a box that shares a point with its own', async () => {
  const reader = await open('valid/levels_of_many_tiles');
  const [tile] = reader.header.tiles;
  assert.ok((await reader.cut({ box: [...tile.max, ...tile.max.map((value) => value + 1)] })).includes(0));
  const beyond = [...tile.max];
  beyond[0] = Math.max(...allTiles(reader.header).map(({ max }) => max[0])) + 1;
  assert.deepEqual(await reader.cut({ level: 1, box: [...beyond, ...beyond] }), []);
  const all = [-Infinity, -Infinity, -Infinity, Infinity, Infinity, Infinity];
  assert.deepEqual(await reader.cut({ level: 1, box: all }), [5, 6, 7]);
  const [, , node] = await reader.nodes();
  const below = reader.header.tiles.slice(0, 3).flatMap(({ min }) => [[...min, ...min]]);
  for (const box of below) {
    const found = await reader.cut({ level: 1, box });
    assert.deepEqual(
      [5, 6].map((index) => found.includes(index)),
      [true, true],
      `node ${node.index}`,
    );
  }
});

test('a box that touches a decoded centre selects its tile, one beside it does not', async () => {
  for (const name of [
    'valid/levels_of_boxes',
    'extreme/levels_of_boxes_at_2_53',
    'extreme/levels_of_subnormal_boxes',
  ]) {
    const reader = await open(name);
    for (const { index, min, max } of reader.header.tiles) {
      const { means } = await reader.readTile(index);
      const column = (axis) => means.filter((_, i) => i % 3 === axis);
      for (const axis of [0, 1, 2]) {
        assert.ok(Math.min(...column(axis)) === min[axis] && Math.max(...column(axis)) === max[axis], name);
        const box = [-Infinity, -Infinity, -Infinity, Infinity, Infinity, Infinity];
        box[axis] = max[axis];
        assert.ok((await reader.cut({ box })).includes(index), name);
        const corners = [...box.slice(3), ...box.slice(0, 3)]; // in any order
        assert.ok((await reader.cut({ box: corners })).includes(index), name);
        box[axis] = max[axis] + Math.max(Number.MIN_VALUE, Math.abs(max[axis]) * 2 ** -52);
        assert.ok(!(await reader.cut({ box })).includes(index), name);
      }
    }
  }
});

test('a tile of a coarser level beyond binary32 is refused with the index', async () => {
  for (const name of ['beyond_float32', 'begins_below_float32', 'rounds_to_infinity']) {
    const error = await refusal(() => open(`invalid/coarse_tile_${name}`));
    assert.deepEqual([error.code, error.clause], ['E_RANGE', 'MEA-1'], name);
  }
});

test('invalid cuts are E_INPUT', async () => {
  const reader = await open('valid/levels_of_three');
  const mistakes = [
    { level: -1 },
    { level: 256 },
    { level: 0.5 },
    { level: NaN },
    { level: '1' },
    { pixelSize: -1 },
    { pixelSize: NaN },
    { pixelSize: '1' },
    { pixelSize: null },
    { pixelSize: [1, 1] },
    { pixelSize: [1, 1, NaN] },
    { pixelSize: [1, 1, 1, 1] },
    { maxSplats: -1 },
    { maxSplats: NaN },
    { maxSplats: '9' },
    { level: 1, maxSplats: 9 },
    { level: 0, pixelSize: 1 },
    { levels: 1 },
    { box: [0, 0, 0] },
    { box: null },
    { box: [0, 0, 0, 1, 1, NaN] },
    { box: [0, 0, 2, 1, 1, 1, 1] },
    { box: NaN },
    { box: ['0', 0, 0, 1, 1, 1] },
  ];
  for (const mistake of mistakes) {
    const error = await refusal(() => reader.cut(mistake));
    assert.deepEqual([error.name, error.code], ['InputError', 'E_INPUT'], JSON.stringify(mistake));
  }
  assert.deepEqual(await reader.cut({ pixelSize: Float32Array.of(0, Infinity, 0) }), [1]);
  assert.deepEqual(await reader.cut({ maxSplats: Infinity }), [0]);
  assert.deepEqual(await reader.cut({ level: undefined, maxSplats: undefined }), [0]);
  const error = await refusal(() => reader.cut({ maxSplats: 1 }));
  assert.deepEqual([error.name, error.code, error.clause], ['LimitError', 'E_LIMIT', 'TRE-9']);
});

test('tiles of every level are decoded alone, together, by workers and in each form', async () => {
  for (const name of ['valid/levels_of_a_tree', 'valid/levels_of_the_rich_scene', 'valid/levels_without_harmonics']) {
    const file = vector(name);
    const reader = await CsplatReader.open(file.slice().buffer);
    const tiles = await reader.cut({ level: 1 });
    assert.ok(tiles.some((index) => index >= reader.header.tiles.length));
    const cut = await decode(file, { tiles });
    assert.deepEqual(Object.keys(cut.extra), []);
    const parts = [];
    for await (const part of reader.readTiles({ tiles, extra: true })) parts.push(part);
    assert.deepEqual(
      parts.map(({ index }) => index),
      tiles,
    );
    for (const field of FLOATS) assert.deepEqual([...cut[field]], parts.flatMap((part) => [...part[field]]), field); // prettier-ignore
    const byWorkers = await decode(file, { tiles, workers: 2 });
    for (const field of FLOATS) assert.equal(hash(byWorkers[field]), hash(cut[field]), `${name} ${field}`);
    const whole = await decode(file, { form: 'integers' });
    assert.equal(whole.tile_splats.length, allTiles(reader.header).length);
    for (const { index, first, splatCount } of allTiles(reader.header)) {
      const integers = await reader.readTile(index, { form: 'integers' });
      assert.equal(hash(integers.means), hash(whole.means.slice(3 * first, 3 * (first + splatCount))), name);
    }
    for await (const part of reader.readTiles({ tiles, form: 'packed', workers: 2 })) {
      assert.equal(part.count, allTiles(reader.header)[part.index].splatCount);
    }
  }
});

test('extra columns are those of level 0', async () => {
  const reader = await open('valid/levels_without_harmonics');
  assert.deepEqual([...(await reader.readTile(0, { extra: true })).extra.label], [255, 3, 0]);
  assert.deepEqual(Object.keys((await reader.readTile(1, { extra: true })).extra), []);
  const file = vector('valid/levels_without_harmonics');
  assert.deepEqual([...(await decode(file, { tiles: [0] })).extra.label], [255, 3, 0]);
  assert.deepEqual(Object.keys((await decode(file, { tiles: [1, 0] })).extra), []);
});

test('a whole decode counts the chunks of all levels, and progress ends at the splats of level 0', async () => {
  const progress = [];
  const scene = await decode(vector('valid/levels'), { workers: 2, onProgress: (...now) => progress.push(now) });
  assert.deepEqual([scene.count, scene.checks.chunks, progress.at(-1)], [5, 4, [5, 5]]);
  const { count } = await decode(vector('valid/levels'), { form: 'integers' });
  assert.equal(count, 8);
  assert.equal((await refusal(() => decode(vector('valid/levels'), { tiles: [3] }))).code, 'E_INPUT');
});

test('a damaged tile of a coarser level is refused when it is read, damage of its chunk by a whole decode', async () => {
  const file = vector('valid/levels');
  const { offset } = readHeader(file).coarseTiles[0].layers[0];
  const bad = forged(file, (bytes) => (bytes[offset + CHUNK_HEADER_SIZE] ^= 99)); // the layer
  await decode(bad);
  for (const options of [{ tiles: [2] }, { tiles: [2], workers: 1 }, { form: 'integers' }])
    assert.equal((await refusal(() => decode(bad, options))).clause, 'TLE-1');
  const damaged = file.slice();
  damaged[offset + CHUNK_HEADER_SIZE] ^= 1;
  assert.equal((await refusal(() => decode(damaged))).clause, 'CHK-1');
});

test('TREE is fetched by the first read of the nodes, and again after damage', async (t) => {
  const { url, requests } = await serve(t, vector('valid/levels_of_a_tree'));
  const reader = await CsplatReader.open(url, { firstBytes: 64 });
  const before = requests.length;
  const description = await reader.describe();
  assert.deepEqual(Object.values(description), [null, null, null, null]);
  assert.equal(requests.length, before);
  await Promise.all([reader.cut(), reader.cut({ level: 3 }), reader.nodes()]);
  assert.equal(requests.length, before + 1);
  const broken = await open('invalid/tree_crc');
  for (let i = 0; i < 2; i++) assert.equal((await refusal(() => broken.cut())).clause, 'CHK-1');
});

test('the adapter prints the tiles of cuts, or a refusal', (t) => {
  const folder = mkdtempSync(join(tmpdir(), 'csplat-cuts-'));
  t.after(() => rmSync(folder, { recursive: true }));
  const cuts = join(folder, 'cuts.txt');
  writeFileSync(cuts, 'level 1\nsplats 1\npixel_size 0.3 0.3 0.3\n');
  const run = (name) => {
    const path = fileURLToPath(
      new URL(`../../../conformance/csplat_conformance/vectors/${name}.csplat`, import.meta.url),
    );
    const { status, stdout } = spawnSync(process.execPath, [ADAPTER, '--cuts', path, cuts], { encoding: 'utf8' });
    return [status, stdout];
  };
  assert.deepEqual(run('valid/levels_of_three'), [0, '1\nE_LIMIT\n1\n']);
  assert.deepEqual(run('invalid/parent_itself').slice(0, 1), [1]);
});
