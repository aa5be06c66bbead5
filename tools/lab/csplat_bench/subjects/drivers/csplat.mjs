// SPDX-License-Identifier: Apache-2.0
// Ways to decode in JavaScript, for Node and pages. An export returns, once it is ready, a function of a file's bytes.

import { CsplatReader, decode } from '../../../../../codec/js/decoder.mjs';
import { platformInflate } from '../../../../../codec/js/inflate.mjs';

export const compiled = async () => decode;

export async function plain() {
  const inflate = await platformInflate();
  return (bytes) => decode(bytes, { inflate });
}

export async function workers() {
  const count = globalThis.navigator?.hardwareConcurrency ?? (await import('node:os')).availableParallelism();
  return (bytes) => decode(bytes, { workers: count });
}

export const packed = async () => async (bytes) => {
  const reader = await CsplatReader.open(bytes.buffer);
  const arrays = [];
  for (const { index } of reader.header.tiles) {
    const { count, sh, ...geometry } = await reader.readTile(index, { form: 'packed' });
    for (const { columns } of Object.values(geometry)) arrays.push(columns);
    for (const band of sh) if (band) arrays.push(band.columns, ...(band.lookup ? [band.lookup.index, band.rows] : []));
  }
  return arrays;
};
