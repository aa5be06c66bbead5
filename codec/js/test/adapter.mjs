// This decoder behind the protocol of the conformance runner (conformance/README.md):
//
//   csplat conformance decoder --cmd 'node codec/js/test/adapter.mjs {input} {outdir}'

import { readFileSync, writeFileSync } from 'node:fs';
import { join } from 'node:path';

import { CsplatError, decode } from '../decoder.mjs';

const FLOATS = ['means', 'quats', 'scales', 'opacities', 'sh0', 'shN'];
const INTEGERS = ['opacities', 'scales', 'quats', 'means', 'sh0', 'sh1', 'sh2', 'sh3', 'tile_splats', 'exponents'];

const [input, outdir] = process.argv.slice(2);

/** @param {string} name @param {ArrayBufferView | undefined} array */
const write = (name, array) => {
  if (array)
    writeFileSync(join(outdir, `${name}.bin`), new Uint8Array(array.buffer, array.byteOffset, array.byteLength));
};

try {
  const bytes = readFileSync(input);
  const scene = await decode(bytes);
  const integers = await decode(bytes, { form: 'integers' });
  const { header } = scene;
  const facts = {
    profile: header.profile,
    splat_count: header.splatCount,
    tile_count: header.tiles.length,
    sh_degree: header.shDegree,
    scene_flags: ['antialiased', 'flat'].filter((name) => header[name]),
    axes: header.axes,
    unit_metres: header.unitMetres,
    origin: header.origin,
  };
  writeFileSync(join(outdir, 'header.json'), JSON.stringify(facts));
  for (const name of FLOATS) write(`floats.${name}`, scene[name]);
  for (const name of INTEGERS) write(`integers.${name}`, integers[name]);
  for (const name in scene.extra) write(`extra.${encodeURIComponent(name)}`, scene.extra[name]);
} catch (error) {
  if (!(error instanceof CsplatError)) throw error;
  const { code, offset, clause } = error;
  console.log(JSON.stringify({ code, offset, clause }));
  process.exitCode = 1;
}
