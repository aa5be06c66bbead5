// SPDX-License-Identifier: Apache-2.0
// Adapts this decoder to the protocol of the conformance runner (conformance/IMPLEMENTERS.md), one process per file:
//
//   csplat conformance decoder --cmd 'node codec/js/test/adapter.mjs {input} {outdir}'
//   csplat conformance decoder --cmd 'node codec/js/test/adapter.mjs --cuts {input} {cuts}'
//
// With --serve, one process answers for any number of files. A request on standard input is a u32, the file's size, and the
// file; an answer is a line of JSON, either {code, offset, clause} or {header, arrays: {name: [bytes, SHA-256]}}.

import { createHash } from 'node:crypto';
import { readFileSync, writeFileSync } from 'node:fs';
import { join } from 'node:path';
import { pathToFileURL } from 'node:url';

import { cutOptions } from './cuts.mjs';

const FLOATS = ['means', 'quats', 'scales', 'opacities', 'sh0', 'shN'];
const INTEGERS = ['opacities', 'scales', 'quats', 'means', 'sh0', 'sh1', 'sh2', 'sh3', 'sh4', 'tile_splats', 'exponents']; // prettier-ignore

/** Folder of the decoder; a copy may be tested instead. */
const folder = process.env.CSPLAT_JS ? pathToFileURL(`${process.env.CSPLAT_JS}/`) : new URL('../', import.meta.url);
const { CsplatError, CsplatReader, decode } = await import(new URL('decoder.mjs', folder).href);
const { zlibInflate } = await import(new URL('inflate.mjs', folder).href);
const inflate = await zlibInflate();

/** @param {ArrayBufferView} array */
const raw = (array) => new Uint8Array(array.buffer, array.byteOffset, array.byteLength);

/**
 * Decode to floats with WebAssembly and with JavaScript, and check that they agree.
 *
 * @param {Uint8Array} bytes
 * @param {object} options
 */
async function floats(bytes, options) {
  const compiled = await decode(bytes, options).catch((error) => error);
  const scene = await decode(bytes, { ...options, inflate }).catch((error) => error);
  if (compiled instanceof Error !== scene instanceof Error) throw new Error('WebAssembly and JavaScript disagree');
  if (scene instanceof Error) throw scene;
  for (const name of FLOATS)
    if (Buffer.compare(raw(compiled[name]), raw(scene[name])))
      throw new Error(`WebAssembly and JavaScript disagree about ${name}`);
  return scene;
}

/**
 * Decode a file to floats and integers.
 *
 * @param {Uint8Array} bytes
 * @param {object} [limits] budgets
 * @returns {Promise<{header: object, arrays: Map<string, ArrayBufferView>}>} arrays by `part.name`
 */
async function decoded(bytes, limits = {}) {
  const scene = await floats(bytes, limits);
  const integers = await decode(bytes, { ...limits, form: 'integers' });
  const { header } = scene;
  const facts = {
    profile: header.profile,
    resource_level: header.resourceLevel,
    splat_count: header.splatCount,
    tile_count: header.tiles.length + header.coarseTiles.length,
    sh_degree: header.shDegree,
    scene_flags: header.flat ? ['flat'] : [],
    kernel: header.kernel,
    projection: header.projection,
    antialiasing: header.antialiasing,
    colour_space: header.colourSpace,
    extra_columns: header.extras.filter(({ dtype }) => dtype).map(({ name, semantic }) => [name, semantic]),
    axes: header.axes,
    unit_metres: header.unitMetres,
    origin: header.origin,
  };
  const arrays = new Map();
  for (const name of FLOATS) if (scene[name]) arrays.set(`floats.${name}`, scene[name]);
  for (const name of INTEGERS) if (integers[name]) arrays.set(`integers.${name}`, integers[name]);
  for (const name of Object.keys(scene.extra)) arrays.set(`extra.${name}`, scene.extra[name]);
  return { header: facts, arrays };
}

/** @param {string} character ASCII */
const encodeByte = (character) => `%${character.charCodeAt(0).toString(16).toUpperCase()}`;

/** Convert a refusal to the protocol. Any other error is a defect of the decoder. @param {unknown} error */
function refusal(error) {
  if (!(error instanceof CsplatError)) throw error;
  const { code, offset, clause } = error;
  return JSON.stringify({ code, offset, clause });
}

/** @param {string} input @param {string} outdir */
async function once(input, outdir) {
  try {
    const { header, arrays } = await decoded(readFileSync(input));
    writeFileSync(join(outdir, 'header.json'), JSON.stringify(header));
    for (const [key, array] of arrays) {
      const dot = key.indexOf('.');
      const name = encodeURIComponent(key.slice(dot + 1)).replace(/[!'()*]/g, encodeByte);
      writeFileSync(join(outdir, `${key.slice(0, dot)}.${name}.bin`), raw(array));
    }
  } catch (error) {
    console.log(refusal(error));
    process.exitCode = 1;
  }
}

/**
 * Print the tiles of cuts, one a line.
 *
 * @param {string} input
 * @param {string} cuts path of a text of lines for `cutOptions`
 */
async function cut(input, cuts) {
  try {
    const { buffer, byteOffset, length } = readFileSync(input);
    const reader = await CsplatReader.open(buffer.slice(byteOffset, byteOffset + length));
    await reader.nodes();
    for (const line of readFileSync(cuts, 'utf8').split('\n').filter(Boolean)) {
      const tiles = await reader.cut(cutOptions(line)).catch((error) => {
        if (error instanceof CsplatError) return [error.code];
        throw error;
      });
      console.log(tiles.join(' '));
    }
  } catch (error) {
    console.log(refusal(error));
    process.exitCode = 1;
  }
}

/** @param {Uint8Array} bytes @param {object} limits */
async function answer(bytes, limits) {
  try {
    const { header, arrays } = await decoded(bytes, limits);
    const sums = [...arrays].map(([key, array]) => [
      key,
      [array.byteLength, createHash('sha256').update(raw(array)).digest('hex')],
    ]);
    return JSON.stringify({ header, arrays: Object.fromEntries(sums) });
  } catch (error) {
    if (error instanceof CsplatError) return refusal(error);
    return JSON.stringify({ defect: error instanceof Error ? (error.stack ?? error.message) : String(error) });
  }
}

/** Answer requests until standard input ends. @param {object} limits */
async function serve(limits) {
  let waiting = Buffer.alloc(0);
  for await (const part of process.stdin) {
    waiting = waiting.length ? Buffer.concat([waiting, part]) : part;
    while (waiting.length >= 4) {
      const size = waiting.readUInt32LE(0);
      if (waiting.length < 4 + size) break;
      // Copies, so that the bytes start at 0 of their buffer, as in a file that was read.
      const bytes = Uint8Array.from(waiting.subarray(4, 4 + size));
      waiting = waiting.subarray(4 + size);
      process.stdout.write(`${await answer(bytes, limits)}\n`);
    }
  }
}

const [first, second, third] = process.argv.slice(2);
if (first === '--serve') await serve(JSON.parse(second ?? '{}'));
else if (first === '--cuts') await cut(second, third);
else await once(first, second);
