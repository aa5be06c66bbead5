// SPDX-License-Identifier: Apache-2.0
// Tile and layer records (spec 4.3.5) and the coverage of the file by chunks (4.3.6).

import { fault } from './errors.mjs';
import { ldexp } from './lattice.mjs';
import { nameOf, registeredFlags } from './registry.mjs';
import * as spec from './spec.mjs';

const { ERROR_INDEX, ERROR_RANGE, ERROR_UNSUPPORTED, ERROR_VALUE } = spec;
const { TILE_RECORD_OFFSETS: AT, TILE_RECORD_STRIDES: STRIDES, LAYER_RECORD_OFFSETS: AT_LAYER } = spec;
const TABLE_ID_SIZE = Uint16Array.BYTES_PER_ELEMENT;
const AXES = [0, 1, 2];

/**
 * @typedef {import('./decoder.d.ts').Header} Header
 * @typedef {import('./decoder.d.ts').TileRecord} TileRecord
 * @typedef {import('./decoder.d.ts').LayerRecord} LayerRecord
 * @typedef {import('./payload.mjs').Payload} Payload
 *
 * The record sizes in the index head.
 *
 * @typedef {Pick<ReturnType<typeof spec.unpackIndexHead>, 'tile_size' | 'layer_size'>} RecordSizes
 */

/**
 * Return the tiles of all levels, in the order of the index.
 *
 * @param {Header} header
 */
export const allTiles = ({ tiles, coarseTiles }) => [...tiles, ...coarseTiles];

/**
 * Read the record of one tile, with its layers and table ids.
 *
 * @param {Payload} index at the record
 * @param {RecordSizes} sizes
 * @param {Header} header with attributes and extras
 * @param {TileRecord} [before] the tile before it
 * @returns {TileRecord}
 */
export function readTile(index, sizes, header, before) {
  const { fields, offset } = index.read(
    spec.unpackTileRecord,
    sizes.tile_size,
    spec.TILE_RECORD_RESERVED,
    'a tile record',
  );
  const { splat_count: splatCount, level, exponent, extent, layer_count, table_count } = fields;
  const least = before?.level ?? 0;
  if (level < least)
    throw fault(ERROR_INDEX, offset + AT.level, 'TIL-12', `level ${level}, expected at least ${least}`);
  if (splatCount < 1 || splatCount > spec.TILE_SPLATS_MAX) {
    throw fault(ERROR_VALUE, offset, 'TIL-1', `a tile of ${splatCount} splats`);
  }
  const lists = layer_count * sizes.layer_size + TABLE_ID_SIZE * table_count;
  if (lists > index.left) throw fault(ERROR_INDEX, offset, 'IDX-2', `lists of ${lists} bytes, ${index.left} are left`);
  const corner = readCorner(fields.corner, extent, offset);
  const step = ldexp(header.attributes[spec.ATTRIBUTE_MEANS - 1].step, exponent);
  if (!(step > 0 && step < Infinity))
    throw fault(ERROR_VALUE, offset + AT.exponent, 'TIL-9', `a lattice with the exponent ${exponent}`);
  const min = AXES.map((axis) => Math.fround(corner[axis] * step));
  const max = AXES.map((axis) => Math.fround((corner[axis] + extent[axis]) * step));
  for (const axis of AXES) {
    if (!Number.isFinite(min[axis]) || !Number.isFinite(max[axis])) {
      const what = `a box from ${corner[axis]} × ${step}, ${extent[axis]} wide, is beyond binary32`;
      throw fault(ERROR_RANGE, offset + AT.corner + STRIDES.corner * axis, 'MEA-1', what);
    }
  }
  const layers = readLayers(index, sizes.layer_size, fields, header);
  const tablesOffset = index.offset;
  const tables = [];
  for (let i = 0; i < table_count; i++)
    tables.push(index.view.getUint16(index.claim(TABLE_ID_SIZE, 'a table id'), true));
  return {
    index: before ? before.index + 1 : 0,
    level,
    first: before ? before.first + before.splatCount : 0,
    splatCount,
    exponent,
    corner,
    extent,
    step,
    min,
    max,
    maxScale: fields.max_scale,
    layers,
    tables,
    recordOffset: offset,
    tablesOffset,
  };
}

/**
 * @param {bigint[]} corner
 * @param {number[]} extent
 * @param {number} offset offset of the tile record
 */
function readCorner(corner, extent, offset) {
  const most = BigInt(spec.INTEGER_MAX);
  for (const axis of AXES) {
    const end = corner[axis] + BigInt(extent[axis]);
    if (corner[axis] < -most || corner[axis] > most || end > most) {
      throw fault(
        ERROR_VALUE,
        offset + AT.corner + STRIDES.corner * axis,
        'TIL-7',
        `a box from ${corner[axis]} to ${end}`,
      );
    }
    if (extent[axis] >= 2 ** spec.AXIS_BITS_MAX) {
      throw fault(ERROR_VALUE, offset + AT.extent + STRIDES.extent * axis, 'TIL-8', `an extent of ${extent[axis]}`);
    }
  }
  return corner.map(Number); // exact: at most 2^53
}

/** Return true for the layers of extra columns, whether the file has such a column or not. @param {number} layer */
const isExtra = (layer) => layer >= spec.LAYER_EXTRA && layer < spec.LAYER_EXTRA + spec.EXTRA_COLUMNS_MAX;

/**
 * @param {Payload} index
 * @param {number} recordSize
 * @param {Pick<ReturnType<typeof spec.unpackTileRecord>, 'level' | 'layer_count'>} tile
 * @param {Header} header
 * @returns {LayerRecord[]}
 */
function readLayers(index, recordSize, { level, layer_count: count }, header) {
  const start = index.offset;
  /** @type {LayerRecord[]} */
  const layers = [];
  const flags = registeredFlags(spec.CHUNK_TILE);
  for (let i = 0; i < count; i++) {
    const { fields, offset: at } = index.read(
      spec.unpackLayerRecord,
      recordSize,
      spec.LAYER_RECORD_RESERVED,
      'a layer record',
    );
    const { layer, size, offset, crc } = fields;
    const skipped = layer >= spec.ANCILLARY_ID_MIN;
    if (!skipped && nameOf(spec.LAYER_NAMES, layer) === undefined && !isExtra(layer))
      throw fault(ERROR_UNSUPPORTED, at, 'RES-2', `layer ${layer}`);
    const before = layers.at(-1)?.layer;
    if (before === undefined ? layer !== spec.LAYER_GEOMETRY : layer <= before) {
      throw fault(ERROR_INDEX, at, 'TIL-2', `layer ${layer} after ${before ?? 'none'}`);
    }
    if (!skipped && !isExtra(layer) && layer > header.shDegree) {
      throw fault(ERROR_INDEX, at, 'TIL-3', `layer ${layer} in a scene of SH degree ${header.shDegree}`);
    }
    layers.push({
      layer,
      type: spec.CHUNK_TILE,
      flags,
      size,
      offset: Number(offset),
      crc,
      offsetField: at + AT_LAYER.offset,
      sizeField: at + AT_LAYER.size,
    });
  }
  if (count === 0) throw fault(ERROR_INDEX, start, 'TIL-2', 'no layers');
  const extras = layers.map(({ layer }) => layer).filter(isExtra); // they ascend
  const wanted = level === 0 ? header.extras.length : 0;
  if (extras.length !== wanted || extras.some((layer, i) => layer !== spec.LAYER_EXTRA + i)) {
    const what = `layers ${extras.join(', ') || 'none'} of ${wanted} extra columns of a tile of level ${level}`;
    throw fault(ERROR_INDEX, start, 'TIL-5', what);
  }
  return layers;
}

/**
 * TIL-6: "The table ids MUST ascend strictly, and each MUST be the id of a codebook record."
 *
 * @param {TileRecord} tile
 * @param {Set<number>} codebooks ids of the codebooks
 */
export function checkTables({ tables, tablesOffset }, codebooks) {
  tables.forEach((id, i) => {
    if ((i > 0 && id <= tables[i - 1]) || !codebooks.has(id)) {
      throw fault(ERROR_INDEX, tablesOffset + TABLE_ID_SIZE * i, 'TIL-6', `table id ${id}`);
    }
  });
}

/**
 * Check COV-1: the chunks start at the end of the index, follow each other without gap or overlap, and end with the file.
 *
 * @param {Header} header
 * @param {number} start offset of the end of the index
 */
export function checkCoverage(header, start) {
  const places = [...header.directory, ...allTiles(header).flatMap((tile) => tile.layers)];
  for (const { size, sizeField } of places) {
    const least = spec.CHUNK_HEADER_SIZE;
    if (size < least) throw fault(ERROR_INDEX, sizeField, 'CHK-3', `a chunk of ${size} bytes, its header has ${least}`);
  }
  // Offsets from 2^53 on are rounded. They lie beyond the end of the file, or `end` differs from it: both are refused.
  places.sort((a, b) => a.offset - b.offset);
  let end = start;
  for (const { offset, offsetField, size } of places) {
    if (offset !== end)
      throw fault(ERROR_INDEX, offsetField, 'COV-1', `a chunk at ${offset}, the one before ends at ${end}`);
    end += size;
  }
  if (end !== header.fileSize)
    throw fault(
      ERROR_INDEX,
      spec.HEADER_OFFSETS.file_size,
      'COV-1',
      `the chunks end at ${end}, the file at ${header.fileSize}`,
    );
}
