// SPDX-License-Identifier: Apache-2.0
// The index (spec 4.3): records of the whole file. `tile_records.mjs` reads the tiles, which follow them.

import { CRC_SIZE } from './checksums.mjs';
import { fault } from './errors.mjs';
import { checkIndexCrc, typeName } from './container.mjs';
import { SINGLE_MIN, STEP_MIN } from './lattice.mjs';
import { Payload } from './payload.mjs';
import { nameOf, registeredFlags } from './registry.mjs';
import { checkResourceLevel } from './resource_level.mjs';
import * as spec from './spec.mjs';
import { checkCoverage, checkTables, readTile } from './tile_records.mjs';

const { ERROR_INDEX, ERROR_LIMIT, ERROR_RESERVED, ERROR_UNSUPPORTED, ERROR_VALUE } = spec;

/**
 * @typedef {import('./decoder.d.ts').Header} Header
 * @typedef {import('./decoder.d.ts').AttributeRecord} AttributeRecord
 * @typedef {import('./decoder.d.ts').CodebookRecord} CodebookRecord
 * @typedef {import('./decoder.d.ts').ExtraRecord} ExtraRecord
 * @typedef {import('./decoder.d.ts').DirectoryRecord} DirectoryRecord
 * @typedef {import('./decoder.d.ts').ChunkPlace} ChunkPlace
 * @typedef {import('./decoder.d.ts').Limits} Limits
 * @typedef {import('./decoder.d.ts').TileRecord} TileRecord
 * @typedef {import('./container.mjs').FileHeader} FileHeader
 * @typedef {ReturnType<typeof spec.unpackIndexHead>} IndexHead
 */

const AT_HEAD = spec.INDEX_HEAD_OFFSETS;
/** @type {Record<string, number | undefined>} axis of each direction letter */
const LINES = { R: 0, L: 0, U: 1, D: 1, F: 2, B: 2 };
/** Record sizes in the index head, with the minimum of each. */
const RECORD_SIZES = /** @type {const} */ ([
  ['head_size', spec.INDEX_HEAD_SIZE],
  ['attribute_size', spec.ATTRIBUTE_RECORD_SIZE],
  ['codebook_size', spec.CODEBOOK_RECORD_SIZE],
  ['extra_size', spec.EXTRA_RECORD_SIZE],
  ['directory_size', spec.DIRECTORY_RECORD_SIZE],
  ['tile_size', spec.TILE_RECORD_SIZE],
  ['layer_size', spec.LAYER_RECORD_SIZE],
]);
/** Fields whose unknown values from ANCILLARY_ID_MIN on are returned (ANC-4), with the known ones. */
const HINTS = /** @type {const} */ ([
  ['projection', spec.PROJECTION_NAMES],
  ['antialiasing', spec.ANTIALIASING_NAMES],
  ['colour_space', spec.COLOUR_SPACE_NAMES],
]);
const INDEX_GROWTH = 8; // memory of the parsed index, as a multiple of its bytes (approximate)

/**
 * Read and check the whole index.
 *
 * @param {Uint8Array<ArrayBuffer>} bytes the index with its CRC
 * @param {FileHeader} file
 * @param {Required<Limits>} limits
 * @returns {Header}
 */
export function readIndex(bytes, file, limits) {
  checkIndexCrc(bytes);
  const index = new Payload(bytes.subarray(0, -CRC_SIZE), spec.HEADER_SIZE, 'IDX-2', ERROR_INDEX);
  const { fields: head } = index.read(
    spec.unpackIndexHead,
    spec.INDEX_HEAD_SIZE,
    spec.INDEX_HEAD_RESERVED,
    'the head of the index',
  );
  checkSizes(head);
  const scene = readScene(head);
  checkCounts(head, index, limits);
  index.claim(head.head_size - spec.INDEX_HEAD_SIZE, 'the tail of the head');

  const attributes = [];
  for (let i = 0; i < head.attribute_count; i++) attributes.push(readAttribute(index, head.attribute_size, i));
  /** @type {CodebookRecord[]} */
  const codebooks = [];
  for (let i = 0; i < head.codebook_count; i++)
    codebooks.push(readCodebook(index, head.codebook_size, codebooks.at(-1)?.id ?? -1, head.sh_degree));
  /** @type {ExtraRecord[]} */
  const extras = [];
  const names = new Set();
  for (let i = 0; i < head.extra_count; i++) {
    extras.push(readExtra(index, head.extra_size, spec.LAYER_EXTRA + i, names));
  }
  const directoryOffset = index.offset;
  const directory = [];
  for (let i = 0; i < head.directory_count; i++) directory.push(readDirectory(index, head.directory_size));
  checkDirectory(directory, codebooks, directoryOffset);

  /** @type {Header} */
  const header = {
    ...scene,
    ...omit(file),
    ...{ attributes, codebooks, extras, directory, tiles: [], coarseTiles: [], splatCount: 0 },
  };
  const ids = new Set(codebooks.map(({ id }) => id));
  /** @type {TileRecord | undefined} */
  let tile;
  for (let i = 0; i < head.tile_count; i++) {
    tile = readTile(index, head, header, tile);
    checkTables(tile, ids);
    (tile.level === 0 ? header.tiles : header.coarseTiles).push(tile);
    if (tile.level === 0) header.splatCount += tile.splatCount; // below 2^32 × 2^16
  }
  index.finish();
  if (head.splat_count !== BigInt(header.splatCount)) {
    throw fault(
      ERROR_INDEX,
      spec.HEADER_SIZE + AT_HEAD.splat_count,
      'IDX-7',
      `N is ${head.splat_count}, the tiles of level 0 have ${header.splatCount}`,
    );
  }
  checkTree(header);
  checkCoverage(header, file.end);
  checkResourceLevel(header, header.coarseTiles.length ? null : header.tiles);
  return header;
}

/** @param {FileHeader} file */
const omit = ({ version, profile, resourceLevel, fileSize, indexSize }) => ({
  ...{ version, profile, resourceLevel, fileSize, indexSize },
});

/**
 * Check IDX-8: the fields that this version reads lie within the record.
 *
 * @param {IndexHead} head
 */
function checkSizes(head) {
  for (const [name, least] of RECORD_SIZES) {
    const size = head[name];
    if (size < least) throw fault(ERROR_VALUE, spec.HEADER_SIZE + AT_HEAD[name], 'IDX-8', `${name} ${size}`);
  }
}

/** @param {IndexHead} head */
function readScene(head) {
  const at = spec.HEADER_SIZE;
  if (head.sh_degree > spec.SH_DEGREE_MAX) {
    const detail = `SH degree ${head.sh_degree}, this decoder reads 0 to ${spec.SH_DEGREE_MAX}`;
    throw fault(ERROR_UNSUPPORTED, at + AT_HEAD.sh_degree, 'IDX-3', detail);
  }
  const { kernel: kernelId, projection, antialiasing, colour_space: colourSpace } = head;
  const kernel = nameOf(spec.KERNEL_NAMES, kernelId);
  if (kernel === undefined) {
    const name = nameOf(spec.KERNEL_RESERVED, kernelId)?.toUpperCase() ?? kernelId;
    throw fault(ERROR_UNSUPPORTED, at + AT_HEAD.kernel, 'RES-2', `kernel ${name} is not supported`);
  }
  for (const [field, names] of HINTS) {
    const value = head[field];
    if (value < spec.ANCILLARY_ID_MIN && nameOf(names, value) === undefined)
      throw fault(ERROR_UNSUPPORTED, at + AT_HEAD[field], 'RES-2', `${field} ${value} is not supported`);
  }
  if (head.extra_count > spec.EXTRA_COLUMNS_MAX)
    throw fault(ERROR_VALUE, at + AT_HEAD.extra_count, 'EXR-4', `${head.extra_count} extra columns`);
  const flags = spec.SCENE_FLAG_FLAT | spec.ANCILLARY_SCENE_FLAGS;
  if (head.scene_flags & ~flags)
    throw fault(ERROR_RESERVED, at + AT_HEAD.scene_flags, 'RES-1', `scene flags ${head.scene_flags}`);
  const axes = [...head.axes];
  /** @type {Record<number, string>} */
  const letters = spec.DIRECTION_LETTER;
  const lines = new Set(axes.map((direction) => LINES[letters[direction]]));
  if ((lines.has(undefined) || lines.size < 3) && axes.some((direction) => direction !== spec.DIRECTION_UNSPECIFIED)) {
    throw fault(ERROR_VALUE, at + AT_HEAD.axes, 'IDX-4', `axes ${axes.join(', ')}`);
  }
  const unit = head.unit_metres;
  if (!(unit >= 0 && Number.isFinite(unit)))
    throw fault(ERROR_VALUE, at + AT_HEAD.unit_metres, 'IDX-5', `a unit of ${unit} metres`);
  const bad = head.origin.findIndex((x) => !Number.isFinite(x));
  if (bad >= 0) {
    const place = at + AT_HEAD.origin + spec.INDEX_HEAD_STRIDES.origin * bad;
    throw fault(ERROR_VALUE, place, 'IDX-6', `an origin of ${head.origin[bad]}`);
  }
  return {
    shDegree: head.sh_degree,
    ...{ kernel, projection, antialiasing, colourSpace },
    antialiased: antialiasing === spec.ANTIALIASING_MIP,
    flat: (head.scene_flags & spec.SCENE_FLAG_FLAT) !== 0,
    axes: axes.map((direction) => letters[direction]).join(''),
    unitMetres: Math.abs(unit), // −0 is 0
    origin: head.origin,
  };
}

/**
 * Check the counts in the head against the size of the index and the budget, before anything is allocated.
 *
 * @param {IndexHead} head
 * @param {Payload} index after the head
 * @param {Required<Limits>} limits
 */
function checkCounts(head, index, limits) {
  const at = spec.HEADER_SIZE;
  const wanted = spec.ATTRIBUTE_SH0 + head.sh_degree;
  if (head.attribute_count !== wanted) {
    throw fault(
      ERROR_INDEX,
      at + AT_HEAD.attribute_count,
      'ATT-1',
      `${head.attribute_count} attributes instead of ${wanted}`,
    );
  }
  const least =
    head.head_size -
    spec.INDEX_HEAD_SIZE +
    head.attribute_count * head.attribute_size +
    head.codebook_count * head.codebook_size +
    head.extra_count * head.extra_size +
    head.directory_count * head.directory_size +
    head.tile_count * head.tile_size;
  if (least > index.left)
    throw fault(ERROR_INDEX, at, 'IDX-2', `records of at least ${least} bytes, ${index.left} are left`);
  checkIndexBudget(index.bytes.length, limits);
}

/**
 * Compare the memory of the parsed index with the budget, for clients before they request the index.
 *
 * @param {number} size bytes of the index
 * @param {Required<Limits>} limits
 * @throws {FormatError} E_LIMIT
 */
export function checkIndexBudget(size, limits) {
  if (size * INDEX_GROWTH > limits.bytes) {
    throw fault(
      ERROR_LIMIT,
      spec.HEADER_OFFSETS.index_size,
      'LIM-1',
      `an index of ${size} bytes, the budget is ${limits.bytes / INDEX_GROWTH}`,
    );
  }
}

/**
 * @param {Payload} index
 * @param {number} size size of the record
 * @param {number} place
 * @returns {AttributeRecord}
 */
function readAttribute(index, size, place) {
  const places = spec.ATTRIBUTE_RECORD_OFFSETS;
  const { fields, offset } = index.read(
    spec.unpackAttributeRecord,
    size,
    spec.ATTRIBUTE_RECORD_RESERVED,
    'an attribute record',
  );
  const { attribute: id, levels, step, chroma_shift: chromaShift } = fields;
  const wanted = spec.ATTRIBUTE_OPACITIES + place;
  if (id !== wanted) throw fault(ERROR_INDEX, offset, 'ATT-1', `attribute ${id} instead of ${wanted}`);
  const known = /** @type {keyof typeof spec.ATTRIBUTE_NAMES} */ (id);
  const mapping = nameOf(spec.MAPPING_NAMES, fields.mapping) ?? '';
  /** @type {readonly string[]} */
  const mappings = spec.ATTRIBUTE_MAPPINGS[known];
  if (!mappings.includes(mapping))
    throw fault(ERROR_VALUE, offset + places.mapping, 'ATT-2', `mapping ${fields.mapping}`);
  if (spec.ATTRIBUTE_KIND[known] === 'lattice') {
    if (levels !== 0) throw fault(ERROR_RESERVED, offset + places.levels, 'ATT-5', `levels ${levels}`);
    if (!(step >= STEP_MIN && Number.isFinite(step)))
      throw fault(ERROR_VALUE, offset + places.step, 'ATT-6', `a step of ${step}`);
    if (id !== spec.ATTRIBUTE_MEANS && !(step >= SINGLE_MIN && Math.fround(step) === step && step < Infinity))
      throw fault(ERROR_VALUE, offset + places.step, 'ATT-10', `a step of ${step}`);
  } else {
    const isQuats = id === spec.ATTRIBUTE_QUATS;
    const [low, high] = isQuats ? [spec.QUAT_LEVELS_MIN, spec.QUAT_LEVELS_MAX] : [1, spec.OPACITY_LEVELS_MAX];
    if (levels < low || levels > high)
      throw fault(ERROR_VALUE, offset + places.levels, isQuats ? 'ATT-4' : 'ATT-3', `levels ${levels}`);
    if (!Object.is(step, 0)) throw fault(ERROR_RESERVED, offset + places.step, 'ATT-7', `a step of ${step}`);
  }
  if (chromaShift > spec.CHROMA_SHIFT_MAX)
    throw fault(ERROR_VALUE, offset + places.chroma_shift, 'ATT-8', `chroma shift ${chromaShift}`);
  if (chromaShift && fields.mapping !== spec.MAPPING_YCOCG) {
    throw fault(
      ERROR_VALUE,
      offset + places.chroma_shift,
      'ATT-9',
      `chroma shift ${chromaShift} of the mapping ${mapping}`,
    );
  }
  return { id, name: spec.ATTRIBUTE_NAMES[known], mapping, chromaShift, levels, step };
}

/**
 * @param {Payload} index
 * @param {number} recordSize
 * @param {number} before id of the previous record
 * @param {number} shDegree
 * @returns {CodebookRecord}
 */
function readCodebook(index, recordSize, before, shDegree) {
  const places = spec.CODEBOOK_RECORD_OFFSETS;
  const { fields, offset } = index.read(
    spec.unpackCodebookRecord,
    recordSize,
    spec.CODEBOOK_RECORD_RESERVED,
    'a codebook record',
  );
  const { codebook_id: id, band_first: bandFirst, band_last: bandLast, size } = fields;
  if (id <= before) throw fault(ERROR_INDEX, offset, 'CBR-1', `codebook ${id} after ${before}`);
  const kind = nameOf(spec.CODEBOOK_KIND_NAMES, fields.kind);
  if (kind === undefined) throw fault(ERROR_UNSUPPORTED, offset + places.kind, 'RES-2', `codebook kind ${fields.kind}`);
  const isSh = fields.kind === spec.CODEBOOK_KIND_SH;
  if (isSh ? !(bandFirst >= 1 && bandFirst <= bandLast && bandLast <= shDegree) : bandFirst || bandLast) {
    throw fault(
      ERROR_VALUE,
      offset + places.band_first,
      'CBR-2',
      `bands ${bandFirst} to ${bandLast} of the kind ${kind}`,
    );
  }
  if (size < 1 || size > spec.CODEBOOK_ENTRIES_MAX)
    throw fault(ERROR_VALUE, offset + places.size, 'CBR-4', `a codebook of ${size} entries`);
  /** @type {readonly string[]} */
  let attributes =
    spec.CODEBOOK_KIND_ATTRIBUTES[/** @type {keyof typeof spec.CODEBOOK_KIND_ATTRIBUTES} */ (fields.kind)];
  if (isSh) attributes = attributes.slice(bandFirst - 1, bandLast);
  return { id, kind, attributes: [...attributes], bandFirst, bandLast, size };
}

/**
 * @param {Payload} index
 * @param {number} recordSize
 * @param {number} layer of the column
 * @param {Set<string>} names names of the previous columns
 * @returns {ExtraRecord}
 */
function readExtra(index, recordSize, layer, names) {
  const places = spec.EXTRA_RECORD_OFFSETS;
  const { fields, offset } = index.read(
    spec.unpackExtraRecord,
    recordSize,
    spec.EXTRA_RECORD_RESERVED,
    'an extra column record',
  );
  const dtype = nameOf(spec.EXTRA_DTYPE_NAMES, fields.dtype);
  if (dtype === undefined && fields.dtype < spec.ANCILLARY_ID_MIN)
    throw fault(ERROR_UNSUPPORTED, offset, 'RES-2', `type ${fields.dtype} of an extra column`);
  const { coding, components, name_size: nameSize, semantic_size: semanticSize } = fields;
  if (coding !== spec.CODING_RAW && coding < spec.ANCILLARY_ID_MIN)
    throw fault(ERROR_UNSUPPORTED, offset + places.coding, 'EXR-6', `coding ${coding} of an extra column`);
  if (components < 1 || components > spec.EXTRA_COMPONENTS_MAX)
    throw fault(ERROR_VALUE, offset + places.components, 'EXR-5', `${components} components`);
  if (nameSize < 1 || nameSize > spec.EXTRA_NAME_MAX)
    throw fault(ERROR_VALUE, offset + places.name_size, 'EXR-1', `a name of ${nameSize} bytes`);
  if (semanticSize > spec.EXTRA_SEMANTIC_MAX)
    throw fault(ERROR_VALUE, offset + places.semantic_size, 'EXR-7', `a semantic of ${semanticSize} bytes`);
  const name = readText(fields.name, nameSize, offset + places.name, 'EXR-2', 'name');
  const semantic = readText(fields.semantic, semanticSize, offset + places.semantic, 'EXR-7', 'semantic');
  if (names.has(name)) throw fault(ERROR_VALUE, offset + places.name, 'EXR-2', `two columns ${JSON.stringify(name)}`);
  names.add(name);
  if (dtype === undefined || coding !== spec.CODING_RAW)
    return { name, dtype: null, bytes: 0, components, semantic, layer };
  const bytes = spec.EXTRA_DTYPE_BYTES[/** @type {keyof typeof spec.EXTRA_DTYPE_BYTES} */ (fields.dtype)];
  return { name, dtype: /** @type {ExtraRecord['dtype']} */ (dtype), bytes, components, semantic, layer };
}

/**
 * Return the first bytes of a field as text.
 *
 * @param {Uint8Array} field
 * @param {number} size bytes of the text; zeros follow
 * @param {number} offset of the field
 * @param {string} clause of a text that is invalid
 * @param {string} what
 */
function readText(field, size, offset, clause, what) {
  const text = decodeUtf8(field.slice(0, size));
  if (text === null) {
    let sound = size - 1; // length of the longest valid UTF-8 prefix
    while (decodeUtf8(field.slice(0, sound)) === null) sound--;
    throw fault(ERROR_VALUE, offset + sound, clause, `a ${what} that is not UTF-8`);
  }
  if (/[\u0000-\u001f\u007f]/.test(text)) throw fault(ERROR_VALUE, offset, clause, `a control character in a ${what}`);
  const rest = field.subarray(size).find((byte) => byte !== 0);
  if (rest !== undefined) throw fault(ERROR_RESERVED, offset + size, 'EXR-3', `a byte of ${rest} after the ${what}`);
  return text;
}

/**
 * @param {Uint8Array} bytes
 * @returns {string | null} null if the bytes are not UTF-8
 */
function decodeUtf8(bytes) {
  try {
    return new TextDecoder('utf-8', { fatal: true, ignoreBOM: true }).decode(bytes);
  } catch {
    return null;
  }
}

/**
 * @param {Payload} index
 * @param {number} recordSize
 * @returns {DirectoryRecord}
 */
function readDirectory(index, recordSize) {
  const places = spec.DIRECTORY_RECORD_OFFSETS;
  const { fields, offset: at } = index.read(
    spec.unpackDirectoryRecord,
    recordSize,
    spec.DIRECTORY_RECORD_RESERVED,
    'a directory record',
  );
  const { flags, id, layer, size, offset, crc } = fields;
  const type = typeName(fields.type);
  if (type === spec.CHUNK_TILE || /[^\x20-\x7e]/.test(type)) {
    throw fault(ERROR_VALUE, at, 'DIR-1', `the type ${JSON.stringify(type)} in the directory`);
  }
  const known = flags & ~spec.ANCILLARY_CHUNK_FLAGS;
  if (known & ~(spec.CHUNK_FLAG_CRITICAL | spec.CHUNK_FLAG_SAFE_TO_COPY)) {
    throw fault(ERROR_RESERVED, at + places.flags, 'RES-1', `chunk flags ${flags}`);
  }
  if (Object.hasOwn(spec.CHUNK_NAMES, type)) {
    const registered = registeredFlags(type);
    if (known !== registered)
      throw fault(ERROR_VALUE, at + places.flags, 'CHK-4', `flags ${flags} of ${type}, not ${registered}`);
  } else if (flags & spec.CHUNK_FLAG_CRITICAL) {
    if (/^[a-z]/.test(type)) throw fault(ERROR_VALUE, at + places.flags, 'DIR-6', `a critical private chunk ${type}`);
    throw fault(ERROR_UNSUPPORTED, at, 'DIR-2', `an unknown critical chunk ${JSON.stringify(type)}`);
  }
  return {
    type,
    flags,
    id,
    layer,
    size,
    offset: Number(offset),
    crc,
    recordOffset: at,
    offsetField: at + places.offset,
    sizeField: at + places.size,
  };
}

/**
 * Check DIR-4 and DIR-5: required chunks occur exactly once, and no other chunks occur.
 *
 * @param {DirectoryRecord[]} directory
 * @param {CodebookRecord[]} codebooks
 * @param {number} offset offset of the directory
 */
function checkDirectory(directory, codebooks, offset) {
  const due = new Set(); // CODB chunks still to come, as id × 256 + layer
  for (const { id, kind, bandFirst, bandLast } of codebooks) {
    if (kind !== spec.CODEBOOK_KIND_NAMES[spec.CODEBOOK_KIND_SH]) due.add(id * 256);
    else for (let band = bandFirst; band <= bandLast; band++) due.add(id * 256 + band);
  }
  const seen = new Set();
  for (const { type, id, layer, recordOffset } of directory) {
    if (type === spec.CHUNK_CODEBOOK) {
      const key = id * 256 + layer;
      if (!due.delete(key))
        throw fault(ERROR_INDEX, recordOffset, 'DIR-5', `a chunk of codebook ${id}, layer ${layer}`);
    } else if (Object.hasOwn(spec.CHUNK_NAMES, type)) {
      if (id || layer || seen.has(type))
        throw fault(ERROR_INDEX, recordOffset, 'DIR-4', `${type} with id ${id} and layer ${layer}, or twice`);
      seen.add(type);
    }
  }
  if (due.size) throw fault(ERROR_INDEX, offset, 'DIR-5', `${due.size} chunks of codebooks are missing`);
}

/**
 * TRE-1: "A file MUST contain a TREE chunk if a tile has a level above 0, and MUST NOT contain one otherwise".
 *
 * @param {Header} header
 */
function checkTree({ directory, coarseTiles: [coarse] }) {
  const tree = directory.find(({ type }) => type === spec.CHUNK_TREE);
  if (coarse && !tree) {
    const at = coarse.recordOffset + spec.TILE_RECORD_OFFSETS.level;
    throw fault(ERROR_INDEX, at, 'TRE-1', `a tile of level ${coarse.level}, but no chunk TREE`);
  }
  if (tree && !coarse) throw fault(ERROR_INDEX, tree.recordOffset, 'TRE-1', 'a chunk TREE, but no tile above level 0');
}
