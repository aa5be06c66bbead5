// SPDX-License-Identifier: Apache-2.0
// Resource levels (spec 8.1): what a decoder of a file must be able to hold at once.

import { arrayBytes } from './arrays.mjs';
import { codebooksById } from './assemble.mjs';
import { tableBytes } from './codebooks.mjs';
import { fault } from './errors.mjs';
import * as spec from './spec.mjs';
import { allTiles } from './tile_records.mjs';

/**
 * @typedef {import('./decoder.d.ts').Header} Header
 * @typedef {import('./decoder.d.ts').TileRecord} TileRecord
 * @typedef {import('./decoder.d.ts').TreeNode} TreeNode
 */

/** @type {Record<number, number>[]} bounds by id, in the order of the sizes; none at the highest level */
const BOUNDS = [
  spec.RESOURCE_LEVEL_INDEX_BYTES,
  spec.RESOURCE_LEVEL_CODEBOOK_BYTES,
  spec.RESOURCE_LEVEL_TILE_BYTES,
  spec.RESOURCE_LEVEL_VERSION_BYTES,
];

/**
 * Return the lowest resource level whose bounds a file obeys.
 *
 * @param {Header} header
 * @param {TileRecord[]} coarsest tiles of the coarsest version
 */
export function requiredLevel(header, coarsest) {
  const { shDegree, extras, directory, codebooks } = header;
  const bytesOf = (/** @type {TileRecord[]} */ tiles) => {
    const count = tiles.reduce((sum, { splatCount }) => sum + splatCount, 0);
    return arrayBytes(count, shDegree, tiles.some(({ level }) => level > 0) ? [] : extras, false); // 5.7: level 0 alone has them
  };
  const tile = allTiles(header).reduce((most, one) => Math.max(most, bytesOf([one])), 0);
  const sizes = [header.indexSize, tableBytes(directory, codebooksById(codebooks)), tile, bytesOf(coarsest)];
  const [id, name] = /** @type {[string, 'A' | 'B' | 'C']} */ (
    Object.entries(spec.RESOURCE_LEVEL_NAMES).find(([level]) =>
      sizes.every((size, i) => size <= (BOUNDS[i][Number(level)] ?? Infinity)),
    )
  );
  return { id: Number(id), name };
}

/**
 * Check RSL-1 and RSL-2, without TREE only RSL-1 for the sizes that follow from the index.
 *
 * @param {Header} header
 * @param {TileRecord[] | null} coarsest null: TREE has not been read
 */
export function checkResourceLevel(header, coarsest) {
  const { resourceLevel: found } = header;
  const { name } = requiredLevel(header, coarsest ?? []);
  if (found === name || (found > name && !coarsest)) return;
  const clause = found < name ? 'RSL-1' : 'RSL-2';
  const detail = `the resource level is ${found}, the contents require ${name}`;
  throw fault(spec.ERROR_VALUE, spec.HEADER_OFFSETS.resource_level, clause, detail);
}
