// SPDX-License-Identifier: Apache-2.0
// Attribute codings other than CODEBOOK: from streams to integers (spec section 6.4).

import { fault } from './errors.mjs';
import { SINGLE_MIN, ldexp, rgbFromYcocg } from './lattice.mjs';
import { nameOf } from './registry.mjs';
import * as spec from './spec.mjs';
import { readIntegers, readStream } from './streams.mjs';

const { ERROR_RANGE, ERROR_UNSUPPORTED, ERROR_VALUE } = spec;

/**
 * The integers of one block, column after column. Each is below 2^53 in magnitude and never −0.
 *
 * @typedef {object} Block
 * @property {AttributeRecord} attribute
 * @property {Float64Array} columns [C × n]; with `lookup`, only the columns of the escaped splats
 * @property {{id: number, table: Table, index: Uint32Array, escaped: Uint32Array}} [lookup] a colour codebook, the entry
 *   of each splat, and the splats without an entry
 * @property {Uint32Array} [present] the splats that the columns cover, the others are 0; if absent, all splats
 * @property {number} exponent exponent of the tile's lattice for this attribute
 * @property {number} bound maximum magnitude of the integers
 * @property {number} offset offset in the file of the stream or block, reported in errors about the integers
 *
 * @typedef {import('./codebooks.mjs').Table} Table
 * @typedef {import('./decoder.d.ts').AttributeRecord} AttributeRecord
 * @typedef {import('./payload.mjs').Payload} Payload
 * @typedef {import('./tile_blocks.mjs').TileContext} TileContext
 */

const AT = spec.BLOCK_HEAD_OFFSETS;

/**
 * Return the number of columns of an attribute.
 *
 * @param {AttributeRecord} attribute
 */
export const columnCount = ({ id }) => spec.ATTRIBUTE_COLUMNS[/** @type {keyof typeof spec.ATTRIBUTE_COLUMNS} */ (id)];

/**
 * Read the head of a block and check BLK-1.
 *
 * @param {Payload} payload
 */
export function readBlockHead(payload) {
  const { fields, offset } = payload.read(
    spec.unpackBlockHead,
    spec.BLOCK_HEAD_SIZE,
    spec.BLOCK_HEAD_RESERVED,
    'a block head',
  );
  const { attribute, coding } = fields;
  const name = nameOf(spec.CODING_NAMES, coding);
  if (name === undefined) throw fault(ERROR_UNSUPPORTED, offset + AT.coding, 'BLK-1', `coding ${coding}`);
  return { attribute, coding, name, offset };
}

/**
 * Refuse a coding that the registry does not list for the attribute.
 *
 * @param {ReturnType<typeof readBlockHead>} head
 */
export function checkCoding({ attribute, name, offset }) {
  /** @type {readonly string[]} */
  const listed = spec.ATTRIBUTE_CODINGS[/** @type {keyof typeof spec.ATTRIBUTE_CODINGS} */ (attribute)];
  if (!listed.includes(name))
    throw fault(ERROR_VALUE, offset + AT.coding, 'BLK-1', `attribute ${attribute} coded ${name}`);
}

/**
 * Read the parameters and streams of a block with a coding other than CODEBOOK.
 *
 * @param {TileContext} tile
 * @param {Payload} payload after the block's head
 * @param {AttributeRecord} attribute
 * @param {number} coding a coding that the registry lists for the attribute
 * @param {number} n number of splats
 * @param {boolean} escaped whether this is an escape block
 * @returns {Promise<Block>}
 */
export async function readValues(tile, payload, attribute, coding, n, escaped) {
  if (coding === spec.CODING_LEVELS) return readLevels(tile, payload, attribute, n);
  if (coding === spec.CODING_MORTON) return readMorton(tile, payload, attribute, n);
  if (coding === spec.CODING_AXIS) return readAxis(tile, payload, attribute, n);
  if (coding === spec.CODING_SPARSE) return readSparse(tile, payload, attribute, n);
  const exponent = readLatticeParams(payload, attribute, escaped);
  return coding === spec.CODING_OFFSET
    ? readOffset(tile, payload, attribute, n, exponent)
    : readSigned(tile, payload, attribute, n, exponent);
}

/**
 * Read lattice parameters (spec 6.4.4).
 *
 * @param {Payload} payload
 * @param {AttributeRecord} attribute
 * @param {boolean} mustBeZero
 * @returns {number} the exponent
 */
export function readLatticeParams(payload, attribute, mustBeZero) {
  const { fields, offset } = payload.read(
    spec.unpackLatticeParams,
    spec.LATTICE_PARAMS_SIZE,
    spec.LATTICE_PARAMS_RESERVED,
    'lattice parameters',
  );
  const { exponent } = fields;
  if (exponent !== 0 && (mustBeZero || attribute.id === spec.ATTRIBUTE_QUATS)) {
    throw fault(ERROR_VALUE, offset, 'LAT-2', `exponent ${exponent}`);
  }
  checkStep(attribute, exponent, offset);
  return exponent;
}

/**
 * Check the step of a lattice (LAT-1).
 *
 * @param {AttributeRecord} attribute
 * @param {number} exponent
 * @param {number} offset
 */
function checkStep({ step }, exponent, offset) {
  if (step === 0) return;
  const s = ldexp(step, exponent);
  if (!(s >= SINGLE_MIN && s < 2 ** 128))
    throw fault(ERROR_VALUE, offset, 'LAT-1', `a lattice with the exponent ${exponent}`);
}

/**
 * Read offsets i32[count] (LAT-3).
 *
 * @param {Payload} payload
 * @param {number} count
 * @returns {number[]}
 */
export function readOffsets(payload, count) {
  const offsets = [];
  for (let i = 0; i < count; i++) {
    const { offset } = payload;
    const value = payload.view.getInt32(payload.claim(Int32Array.BYTES_PER_ELEMENT, 'an offset'), true);
    if (value > spec.COLUMN_MAX || value < -spec.COLUMN_MAX)
      throw fault(ERROR_VALUE, offset, 'LAT-3', `an offset of ${value}`);
    offsets.push(value);
  }
  return offsets;
}

/**
 * @param {TileContext} tile
 * @param {Payload} payload
 * @param {AttributeRecord} attribute
 * @param {number} n
 * @returns {Promise<Block>}
 */
async function readLevels(tile, payload, attribute, n) {
  const { columns, offset } = await readIntegers(
    payload,
    n,
    spec.CODING_WIDTH_MAX[spec.CODING_LEVELS],
    false,
    tile.inflate,
    tile.columns(attribute, n),
  );
  const block = { attribute, columns, exponent: 0, bound: attribute.levels, offset };
  checkIntegers(block, n);
  return block;
}

/**
 * @param {TileContext} tile
 * @param {Payload} payload
 * @param {AttributeRecord} attribute
 * @param {number} n
 * @returns {Promise<Block>}
 */
async function readMorton(tile, payload, attribute, n) {
  const { fields, offset: at } = payload.read(
    spec.unpackMortonParams,
    spec.MORTON_PARAMS_SIZE,
    spec.MORTON_PARAMS_RESERVED,
    'Morton parameters',
  );
  const { bits } = fields;
  if (bits < 1 || bits > spec.MORTON_BITS_MAX) throw fault(ERROR_VALUE, at, 'MOR-1', `${bits} bits per axis`);
  const { low, high, offset } = await readStream(payload, n, spec.CODING_WIDTH_MAX[spec.CODING_MORTON], tile.inflate);
  const end = 2 ** (3 * bits); // at most 2^51
  const columns = tile.columns(attribute, n);
  for (let i = 0; i < n; i++) {
    const l = low[i],
      h = high === null ? 0 : high[i];
    if (h * 4294967296 + l >= end) throw fault(ERROR_RANGE, offset, 'MOR-2', `a code of more than ${3 * bits} bits`);
    const a = l & 0x3fffffff; // the lower ten bits of each axis; the code's other 21 bits are the upper seven
    const b = (l >>> 30) | (h << 2);
    columns[i] = thirdBits(a) | (thirdBits(b) << 10);
    columns[n + i] = thirdBits(a >>> 1) | (thirdBits(b >>> 1) << 10);
    columns[2 * n + i] = thirdBits(a >>> 2) | (thirdBits(b >>> 2) << 10);
  }
  return { attribute, columns, exponent: 0, bound: 2 ** bits, offset };
}

/**
 * Compact bits 0, 3, 6, ... 27 into bits 0 to 9.
 *
 * @param {number} x 30 bits
 */
function thirdBits(x) {
  x &= 0x09249249;
  x = (x | (x >>> 2)) & 0x030c30c3;
  x = (x | (x >>> 4)) & 0x0300f00f;
  x = (x | (x >>> 8)) & 0x030000ff;
  return (x | (x >>> 16)) & 0x3ff;
}

/**
 * @param {TileContext} tile
 * @param {Payload} payload
 * @param {AttributeRecord} attribute
 * @param {number} n
 * @returns {Promise<Block>}
 */
async function readAxis(tile, payload, attribute, n) {
  const { columns, offset } = await readIntegers(
    payload,
    3 * n,
    spec.CODING_WIDTH_MAX[spec.CODING_AXIS],
    false,
    tile.inflate,
    tile.columns(attribute, n),
  );
  return { attribute, columns, exponent: 0, bound: 2 ** spec.AXIS_BITS_MAX, offset };
}

/**
 * @param {TileContext} tile
 * @param {Payload} payload
 * @param {AttributeRecord} attribute
 * @param {number} n
 * @param {number} exponent
 * @returns {Promise<Block>}
 */
async function readOffset(tile, payload, attribute, n, exponent) {
  const count = columnCount(attribute);
  const offsets = readOffsets(payload, count);
  const widthMax = spec.CODING_WIDTH_MAX[spec.CODING_OFFSET];
  const { columns, width, offset } = await readIntegers(
    payload,
    count * n,
    widthMax,
    false,
    tile.inflate,
    tile.columns(attribute, n),
  );
  let bound = 0;
  for (let c = 0, i = 0; c < count; c++) {
    const first = offsets[c];
    for (const end = (c + 1) * n; i < end; i++) columns[i] += first;
    bound = Math.max(bound, Math.abs(first) + 2 ** (8 * width));
  }
  const block = { attribute, columns, exponent, bound, offset };
  checkIntegers(block, n);
  return block;
}

/**
 * @param {TileContext} tile
 * @param {Payload} payload
 * @param {AttributeRecord} attribute
 * @param {number} n
 * @param {number} exponent
 * @returns {Promise<Block>}
 */
async function readSigned(tile, payload, attribute, n, exponent) {
  const widthMax = spec.CODING_WIDTH_MAX[spec.CODING_SIGNED];
  const wanted = columnCount(attribute) * n;
  const { columns, width, offset } = await readIntegers(
    payload,
    wanted,
    widthMax,
    true,
    tile.inflate,
    tile.columns(attribute, n),
  );
  const block = { attribute, columns, exponent, bound: 2 ** (8 * width - 1), offset };
  checkIntegers(block, n);
  return block;
}

/**
 * Read a mask and the integers of the splats in it (spec 6.4.7).
 *
 * @param {TileContext} tile
 * @param {Payload} payload
 * @param {AttributeRecord} attribute
 * @param {number} n
 * @returns {Promise<Block>}
 */
async function readSparse(tile, payload, attribute, n) {
  const { fields, offset: at } = payload.read(
    spec.unpackSparseParams,
    spec.SPARSE_PARAMS_SIZE,
    spec.SPARSE_PARAMS_RESERVED,
    'sparse parameters',
  );
  const { exponent, present_count: count } = fields;
  checkStep(attribute, exponent, at);
  if (count < 1 || count > n) {
    throw fault(ERROR_VALUE, at + spec.SPARSE_PARAMS_OFFSETS.present_count, 'SPA-1', `${count} of ${n} splats`);
  }
  const { low: mask, offset } = await readStream(payload, (n + 7) >> 3, 1, tile.inflate);
  if (n & 7 && mask[n >> 3] >> (n & 7)) throw fault(ERROR_RANGE, offset, 'SPA-3', `a mask of more than ${n} splats`);
  const present = new Uint32Array(count);
  let found = 0;
  // Writes beyond the end of a typed array are ignored.
  for (let i = 0; i < n; i++) if ((mask[i >> 3] >> (i & 7)) & 1) present[found++] = i;
  if (found !== count) throw fault(ERROR_RANGE, offset, 'SPA-2', `a mask that names ${found} splats, not ${count}`);
  return { ...(await readSigned(tile, payload, attribute, count, exponent)), present };
}

/**
 * Return the block with columns for all splats.
 *
 * @param {Block} block
 * @param {number} n splats
 * @returns {Block}
 */
export function everySplat({ present, ...block }, n) {
  if (present === undefined) return block;
  const { columns } = block;
  const all = new Float64Array(columnCount(block.attribute) * n);
  const count = present.length;
  for (let from = 0, to = 0; from < columns.length; from += count, to += n)
    for (let i = 0; i < count; i++) all[to + present[i]] = columns[from + i];
  return { ...block, columns: all };
}

/**
 * Check integers against LEV-1, QUA-1, QUA-2 or LAT-4, depending on the attribute.
 *
 * @param {Block} block
 * @param {number} n splats
 */
export function checkIntegers({ attribute, columns, bound, offset }, n) {
  const { id, levels } = attribute;
  if (id === spec.ATTRIBUTE_OPACITIES) {
    const bad = outside(columns, 0, levels);
    if (bad >= 0) throw fault(ERROR_RANGE, offset, 'LEV-1', `a level of ${columns[bad]}, the file has ${levels}`);
  } else if (id === spec.ATTRIBUTE_QUATS) {
    const bad = outside(columns, -levels, levels);
    if (bad >= 0) throw fault(ERROR_RANGE, offset, 'QUA-1', `a component of ${columns[bad]}, M is ${levels}`);
    for (let i = 0; i < n; i++) {
      const r = radicand(columns[i], columns[n + i], columns[2 * n + i], levels);
      if (r < 0) throw fault(ERROR_RANGE, offset, 'QUA-2', `R is ${r}`);
    }
  } else if (bound * 2 ** attribute.chromaShift > spec.COLUMN_MAX) {
    checkColumns(attribute, columns, n, offset);
  }
}

/**
 * Return the position of the first integer below `low` or above `high`, or −1.
 *
 * @param {Float64Array} columns
 * @param {number} low
 * @param {number} high
 */
function outside(columns, low, high) {
  // findIndex, which calls a function per element, is several times slower.
  for (let i = 0; i < columns.length; i++) if (columns[i] < low || columns[i] > high) return i;
  return -1;
}

/**
 * Return R of spec 7.5.
 *
 * @param {number} q1 magnitude at most `levels`, also for q2 and q3
 * @param {number} q2
 * @param {number} q3
 * @param {number} levels at most 32,767
 */
export const radicand = (q1, q2, q3, levels) => 2 * levels * levels - q1 * q1 - q2 * q2 - q3 * q3;

/**
 * LAT-4: "Each integer, times 2^chroma_shift in the columns of Co and Cg, MUST be at most COLUMN_MAX in magnitude."
 *
 * @param {AttributeRecord} attribute
 * @param {Float64Array} columns
 * @param {number} n
 * @param {number} offset
 */
function checkColumns(attribute, columns, n, offset) {
  const firstChroma = (n * columnCount(attribute)) / 3; // a third of the columns each for Y, Co and Cg
  for (let i = 0; i < columns.length; i++) {
    const most = i < firstChroma ? spec.COLUMN_MAX : spec.COLUMN_MAX / 2 ** attribute.chromaShift;
    if (Math.abs(columns[i]) > most)
      throw fault(ERROR_RANGE, offset, 'LAT-4', `an integer of ${columns[i]} in column ${Math.floor(i / n)}`);
  }
}

/**
 * Apply spec 7.1 in place to columns of Y, Co, Cg; leave other columns alone.
 *
 * @param {Block} block
 */
export function liftColours(block) {
  const { mapping, chromaShift } = block.attribute;
  if (mapping !== spec.MAPPING_NAMES[spec.MAPPING_YCOCG]) return;
  rgbFromYcocg(block.columns, block.columns.length / 3, chromaShift);
  block.bound *= 4 * 2 ** chromaShift; // |R| <= |Y| + |Cg| / 2 + 3 |Co| / 2 plus 1 for each rounding
}

/**
 * Refuse integers whose values are outside binary32 (LAT-5).
 *
 * @param {Block} block
 * @param {number} step
 */
export function checkFinite({ attribute, columns, bound, offset }, step) {
  if (Number.isFinite(Math.fround(bound * step))) return;
  for (const n of columns) {
    if (!Number.isFinite(Math.fround(n * step))) {
      throw fault(ERROR_RANGE, offset, 'LAT-5', `${attribute.name}: ${n} × ${step} is beyond binary32`);
    }
  }
}
