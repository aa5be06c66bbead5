// SPDX-License-Identifier: Apache-2.0
// node convert.mjs NAME: converts NAME.ply to NAME.ksplat, and NAME.spz of any version to NAME.v2.spz, .v3.spz, .v4.spz.
// The formats' owners write them, with their defaults: SH of SPZ in 5 and 4 bits, KSPLAT of level 1.

import { readFileSync, writeFileSync } from 'node:fs';

import createSpz from '@adobe/spz';
import { PlyLoader } from '@mkkellogg/gaussian-splats-3d';

const name = process.argv[2];
const spz = await createSpz({ print() {} });
const from = spz.CoordinateSystem.UNSPECIFIED;
const cloud = spz.loadSpzFromBuffer(new Uint8Array(readFileSync(`${name}.spz`)), { to: from });
for (const version of [2, 3, 4]) {
  writeFileSync(`${name}.v${version}.spz`, spz.saveSpzToBuffer(cloud, { version, from, sh1Bits: 5, shRestBits: 4 }));
}
globalThis.window ??= globalThis; // GaussianSplats3D reads setTimeout from it
const ply = new Uint8Array(readFileSync(`${name}.ply`)).buffer;
const splats = await PlyLoader.loadFromFileData(ply, 1, 1, true, 2);
writeFileSync(`${name}.ksplat`, new Uint8Array(splats.bufferData));
