// SPDX-License-Identifier: Apache-2.0
// Codebooks: their chunks (spec 5.3) and the blocks that refer to them (6.4.5).

import {
  checkFinite,
  checkIntegers,
  columnCount,
  liftColours,
  readBlockHead,
  readLatticeParams,
  readOffsets,
  readValues,
} from './codings.mjs';
import { fault } from './errors.mjs';
import { putRows, rgbFromYcocg } from './lattice.mjs';
import { Payload } from './payload.mjs';
import * as spec from './spec.mjs';
import { readStream } from './streams.mjs';
import { signed } from './transforms.mjs';

const { ERROR_CODEBOOK, ERROR_INDEX, ERROR_STREAM } = spec;
const { CODEBOOK_HEAD_OFFSETS: AT_HEAD, CODEBOOK_PARAMS_OFFSETS: AT_PARAMS } = spec;
const ENTRY_WIDTH_MAX = 4; // STR-2

/**
 * The entries of one chunk, column after column: `size` entries and a 0 in place of the escape index. No entry exceeds
 * `bound` in magnitude. Values and final integers of the entries are computed on first use.
 *
 * @typedef {{size: number, entries: Int32Array, bound: number, values?: Float32Array, packed?: PackedColumns}} Table
 *
 * The indices that all blocks of one codebook in a tile share.
 *
 * @typedef {{index: Uint32Array, escapeCount: number, escaped: Uint32Array}} Indices
 * @typedef {import('./codings.mjs').Block} Block
 * @typedef {import('./decoder.d.ts').AttributeRecord} AttributeRecord
 * @typedef {import('./decoder.d.ts').CodebookRecord} CodebookRecord
 * @typedef {import('./decoder.d.ts').DirectoryRecord} DirectoryRecord
 * @typedef {import('./decoder.d.ts').PackedColumns} PackedColumns
 * @typedef {import('./tile_blocks.mjs').TileContext} TileContext
 * @typedef {import('./inflate.mjs').Inflate} Inflate
 */

/** @param {string} name name of an attribute */
function columnsOf(name) {
  const id = Object.entries(spec.ATTRIBUTE_NAMES).find((entry) => entry[1] === name)?.[0];
  return spec.ATTRIBUTE_COLUMNS[/** @type {keyof typeof spec.ATTRIBUTE_COLUMNS} */ (Number(id))];
}

/**
 * Return the columns of a codebook's chunk: those of the band, or of all attributes of the kind.
 *
 * @param {CodebookRecord} codebook
 * @param {number} layer
 */
function tableColumns({ attributes, bandFirst }, layer) {
  if (layer > 0) return columnsOf(attributes[layer - bandFirst]);
  return attributes.reduce((sum, name) => sum + columnsOf(name), 0);
}

/**
 * Return the bytes that LIM-1 counts for the tables of some CODB chunks: four per entry and column.
 *
 * @param {DirectoryRecord[]} directory
 * @param {Map<number, CodebookRecord>} codebooks by id
 */
export function tableBytes(directory, codebooks) {
  let bytes = 0;
  for (const { type, id, layer } of directory) {
    const codebook = type === spec.CHUNK_CODEBOOK ? codebooks.get(id) : undefined;
    if (codebook) bytes += 4 * codebook.size * tableColumns(codebook, layer);
  }
  return bytes;
}

/**
 * Read the payload of a CODB chunk.
 *
 * @param {Uint8Array<ArrayBuffer>} bytes
 * @param {DirectoryRecord} record
 * @param {CodebookRecord} codebook
 * @param {AttributeRecord[]} attributes all attributes of the file
 * @param {Inflate} inflate
 * @returns {Promise<Table>}
 */
export async function readTable(bytes, { id, layer, offset }, codebook, attributes, inflate) {
  const payload = new Payload(bytes, offset + spec.CHUNK_HEADER_SIZE, 'CDB-2');
  const { fields, offset: at } = payload.read(
    spec.unpackCodebookHead,
    spec.CODEBOOK_HEAD_SIZE,
    spec.CODEBOOK_HEAD_RESERVED,
    'the head of a codebook',
  );
  const { codebook_id, layer: itsLayer } = fields;
  if (codebook_id !== id) throw fault(ERROR_INDEX, at, 'CDB-1', `codebook ${codebook_id} instead of ${id}`);
  if (itsLayer !== layer)
    throw fault(ERROR_INDEX, at + AT_HEAD.layer, 'CDB-1', `layer ${itsLayer} instead of ${layer}`);
  const { size } = codebook;
  const count = tableColumns(codebook, layer);
  const stream = await readStream(payload, size * count, ENTRY_WIDTH_MAX, inflate);
  const integers = signed(stream);
  const entries = new Int32Array((size + 1) * count);
  for (let c = 0; c < count; c++) entries.set(integers.subarray(c * size, (c + 1) * size), c * (size + 1));
  let bound = 0;
  for (let i = 0; i < integers.length; i++) bound = Math.max(bound, Math.abs(integers[i]));
  checkEntries({ integers, bound, offset: stream.offset }, codebook, layer, attributes);
  payload.finish();
  return { size, entries, bound };
}

/**
 * Check the entries of a table (CBK-7): each must satisfy the requirements on integers of a stream.
 *
 * @param {{integers: Int32Array, bound: number, offset: number}} table column after column; `offset` of its stream
 * @param {CodebookRecord} codebook
 * @param {number} layer layer of the chunk
 * @param {AttributeRecord[]} attributes all attributes of the file
 */
function checkEntries({ integers, bound, offset }, codebook, layer, attributes) {
  const { size } = codebook;
  let first = 0;
  for (const name of codebook.attributes) {
    const attribute = /** @type {AttributeRecord} */ (attributes.find((one) => one.name === name)); // exists by CBR-2
    if (layer > 0 && attribute.id !== spec.ATTRIBUTE_SH0 + layer) continue;
    const end = first + size * columnCount(attribute);
    // A summand is added to the scales, and CBK-6 bounds the sums instead.
    if (attribute.id !== spec.ATTRIBUTE_SCALES) {
      const block = { attribute, columns: new Float64Array(integers.subarray(first, end)), exponent: 0, bound, offset };
      checkIntegers(block, size);
      if (attribute.step !== 0) {
        liftColours(block);
        checkFinite(block, attribute.step);
      }
    }
    first = end;
  }
}

/**
 * Read a block with the coding CODEBOOK, after its head.
 *
 * @param {TileContext} tile
 * @param {Payload} payload
 * @param {AttributeRecord} attribute
 * @param {boolean} integers whether all integers are required; if not, colours may stay in a table
 * @returns {Promise<Block>}
 */
export async function readCodebookBlock(tile, payload, attribute, integers) {
  const { fields, offset: at } = payload.read(
    spec.unpackCodebookParams,
    spec.CODEBOOK_PARAMS_SIZE,
    spec.CODEBOOK_PARAMS_RESERVED,
    'codebook parameters',
  );
  const { codebook_id: id, escape_count: escapeCount } = fields;
  const codebook = tile.codebook(id);
  if (codebook === undefined || !codebook.attributes.includes(attribute.name)) {
    throw fault(
      ERROR_CODEBOOK,
      at,
      'CBK-1',
      `codebook ${id} for ${attribute.name}: not listed by the tile, or of another kind`,
    );
  }
  const isFirst = codebook.attributes[0] === attribute.name;
  const shared = isFirst
    ? await readIndices(tile, payload, codebook, escapeCount, at)
    : await knownIndices(tile, codebook, escapeCount, at);
  const isSh = codebook.bandFirst > 0;
  const table = await tile.table(id, isSh ? attribute.id - spec.ATTRIBUTE_SH0 : 0);
  const offset = at - spec.BLOCK_HEAD_SIZE;
  if (!integers && isSh) {
    const lookup = { id, table, index: shared.index, escaped: shared.escaped };
    if (escapeCount) return { ...(await readEscapes(tile, payload, attribute, escapeCount)), lookup };
    return { attribute, columns: new Float64Array(0), exponent: 0, bound: 0, offset, lookup };
  }
  // Columns of the codebook's attributes before this one. A band has its own chunk.
  const before = isSh ? 0 : codebook.attributes.indexOf(attribute.name) * spec.ATTRIBUTE_COLUMNS[spec.ATTRIBUTE_SCALES];
  const block = gatherEntries(tile.sums(attribute), table, before, shared.index, attribute, offset);
  const hasSummand = attribute.id === spec.ATTRIBUTE_SCALES;
  if (hasSummand) await addSummand(tile, payload, block);
  if (escapeCount) putEscapes(block, shared.escaped, await readEscapes(tile, payload, attribute, escapeCount));
  if (hasSummand) checkIntegers(block, tile.splatCount); // without a summand, CBK-7 has checked the entries
  return block;
}

/**
 * Read the indices in a codebook's first block (CBK-2, CBK-3) and keep them for its other blocks.
 *
 * @param {TileContext} tile
 * @param {Payload} payload
 * @param {CodebookRecord} codebook
 * @param {number} escapeCount
 * @param {number} at offset of the parameters
 * @returns {Promise<Indices>}
 */
async function readIndices(tile, payload, codebook, escapeCount, at) {
  const n = tile.splatCount;
  const { size } = codebook;
  const { low: index, offset } = await readStream(
    payload,
    n,
    spec.CODING_WIDTH_MAX[spec.CODING_CODEBOOK],
    tile.inflate,
  );
  for (let i = 0; i < n; i++)
    if (index[i] > size) throw fault(ERROR_CODEBOOK, offset, 'CBK-2', `index ${index[i]} of ${size} entries`);
  const escaped = new Uint32Array(Math.min(escapeCount, n));
  let found = 0;
  // Writes beyond the end of a typed array are ignored.
  for (let i = 0; i < n; i++) if (index[i] === size) escaped[found++] = i;
  if (found !== escapeCount) {
    throw fault(
      ERROR_CODEBOOK,
      at + AT_PARAMS.escape_count,
      'CBK-3',
      `${found} splats are escaped, ${escapeCount} announced`,
    );
  }
  const shared = { index, escapeCount, escaped };
  tile.indices.set(codebook.id, shared);
  return shared;
}

/**
 * Return the indices that the tile's first block of the codebook holds (CBK-4).
 *
 * @param {TileContext} tile
 * @param {CodebookRecord} codebook
 * @param {number} escapeCount
 * @param {number} at offset of the parameters
 */
async function knownIndices(tile, codebook, escapeCount, at) {
  if (codebook.bandFirst && !tile.indices.has(codebook.id)) await tile.needLayer(codebook.bandFirst);
  const shared = tile.indices.get(codebook.id);
  if (shared === undefined) {
    throw fault(
      ERROR_CODEBOOK,
      at,
      'CBK-4',
      `${codebook.attributes[0]} of the tile are not coded with codebook ${codebook.id}`,
    );
  }
  if (shared.escapeCount !== escapeCount) {
    throw fault(
      ERROR_CODEBOOK,
      at,
      'CBK-4',
      `${escapeCount} escapes, the codebook's first block has ${shared.escapeCount}`,
    );
  }
  return shared;
}

/**
 * Return the values of a table's entries, row by row.
 *
 * @param {Table} table
 * @param {AttributeRecord} attribute
 * @returns {Float32Array}
 */
export function tableValues(table, attribute) {
  if (table.values === undefined) {
    const columns = entryColumns(table, attribute);
    table.values = new Float32Array(columns.length);
    const width = columnCount(attribute);
    putRows(table.values, width, 0, 0, columns, width / 3, columns.length / width, attribute.step);
  }
  return table.values;
}

/**
 * Return the final integers of a table's entries, column after column: R, G, B.
 *
 * @param {Table} table
 * @param {AttributeRecord} attribute
 */
export function entryColumns(table, { mapping, chromaShift }) {
  const columns = new Float64Array(table.entries);
  if (mapping === spec.MAPPING_NAMES[spec.MAPPING_YCOCG]) rgbFromYcocg(columns, columns.length / 3, chromaShift);
  return columns;
}

/**
 * Look up the entries that the indices name.
 *
 * @param {Float64Array} columns filled with the entries
 * @param {Table} table
 * @param {number} before number of columns of the table before the attribute's
 * @param {Uint32Array} index
 * @param {AttributeRecord} attribute
 * @param {number} offset offset of the block
 * @returns {Block}
 */
function gatherEntries(columns, { size, entries, bound }, before, index, attribute, offset) {
  const count = columnCount(attribute);
  const n = index.length;
  for (let c = 0; c < count; c++) {
    const column = entries.subarray((before + c) * (size + 1), (before + c + 1) * (size + 1));
    const at = c * n;
    for (let i = 0; i < n; i++) columns[at + i] = column[index[i]];
  }
  return { attribute, columns, exponent: 0, bound, offset };
}

/**
 * Add the common summand of the scales to their entries.
 *
 * @param {TileContext} tile
 * @param {Payload} payload
 * @param {Block} block changed; its sums are below 2^33
 */
async function addSummand(tile, payload, block) {
  const { attribute, columns } = block;
  const n = tile.splatCount;
  readLatticeParams(payload, attribute, true);
  const [first] = readOffsets(payload, 1);
  const { low, width } = await readStream(payload, n, spec.CODING_WIDTH_MAX[spec.CODING_OFFSET], tile.inflate);
  block.bound += Math.abs(first) + 2 ** (8 * width);
  for (let c = 0, at = 0; c < columnCount(attribute); c++)
    for (let i = 0; i < n; i++, at++) columns[at] += first + low[i];
}

/**
 * Read the escape block (CBK-5).
 *
 * @param {TileContext} tile
 * @param {Payload} payload
 * @param {AttributeRecord} attribute
 * @param {number} count
 */
async function readEscapes(tile, payload, attribute, count) {
  const head = readBlockHead(payload);
  if (head.attribute !== attribute.id) {
    throw fault(
      ERROR_STREAM,
      head.offset,
      'CBK-5',
      `escapes of attribute ${head.attribute} in a block of ${attribute.name}`,
    );
  }
  const mayOffset = attribute.id !== spec.ATTRIBUTE_QUATS;
  if (head.coding !== spec.CODING_SIGNED && !(mayOffset && head.coding === spec.CODING_OFFSET)) {
    const what = `escapes of ${attribute.name} coded ${head.name}`;
    throw fault(ERROR_STREAM, head.offset + spec.BLOCK_HEAD_OFFSETS.coding, 'CBK-5', what);
  }
  return readValues(tile, payload, attribute, head.coding, count, true);
}

/**
 * Replace the sums of the escaped splats with the escapes.
 *
 * @param {Block} block changed
 * @param {Uint32Array} escaped
 * @param {Block} escapes
 */
function putEscapes(block, escaped, escapes) {
  const n = escaped.length;
  const stride = block.columns.length / columnCount(block.attribute);
  for (let i = 0; i < escapes.columns.length; i++) {
    block.columns[Math.floor(i / n) * stride + escaped[i % n]] = escapes.columns[i];
  }
  block.bound = Math.max(block.bound, escapes.bound);
}
