// SPDX-License-Identifier: Apache-2.0
// Writes an up direction and a first view to META of a file (spec 5.4). Index and header are updated, everything else is copied.

import { CRC_SIZE, crc32 } from '../../codec/js/checksums.mjs';
import { CsplatReader } from '../../codec/js/decoder.mjs';
import { registeredFlags } from '../../codec/js/registry.mjs';
import { requiredLevel } from '../../codec/js/resource_level.mjs';
import * as spec from '../../codec/js/spec.mjs';
import { allTiles } from '../../codec/js/tile_records.mjs';

const AT_HEADER = spec.HEADER_OFFSETS;
const AT_INDEX = spec.INDEX_HEAD_OFFSETS;
const AT_RECORD = spec.DIRECTORY_RECORD_OFFSETS;
const AT_CHUNK = spec.CHUNK_HEADER_OFFSETS;
const AT_STREAM = spec.STREAM_HEAD_OFFSETS;
const AXIS_AGREES = Math.SQRT1_2; // cosine of 45 degrees; beyond it another axis is up
const HEADER_FIXED = AT_HEADER.header_crc;

/**
 * Write `up`, `view` or both to the metadata. Axes and an estimated view that contradict `up` are removed, and so are chunks of
 * unknown type that are not safe to copy (CHK-5).
 *
 * @param {ArrayBuffer} bytes a file
 * @param {import('./types.d.ts').MetadataChanges} changes
 * @returns {Promise<Uint8Array<ArrayBuffer>>} the new file
 */
export async function withMetadata(bytes, { up, view: first }) {
  const reader = await CsplatReader.open(bytes);
  const { header } = reader;
  const { metadata } = await reader.describe();
  const directory = header.directory.filter(
    ({ type, flags }) => Object.hasOwn(spec.CHUNK_NAMES, type) || flags & spec.CHUNK_FLAG_SAFE_TO_COPY,
  );
  const before = directory.find(({ type }) => type === spec.CHUNK_METADATA);
  const flags = before?.flags ?? registeredFlags(spec.CHUNK_METADATA);
  const kept = up ? { ...withoutEstimates(metadata ?? {}), up } : metadata;
  const meta = metadataChunk(first ? { ...kept, view: { ...first, from: 'author' } } : (kept ?? {}), flags);

  const source = new Uint8Array(bytes);
  const index = source.slice(0, spec.HEADER_SIZE + header.indexSize - CRC_SIZE); // includes the header
  const view = new DataView(index.buffer);
  const head = spec.unpackIndexHead(view, spec.HEADER_SIZE);
  const begin = spec.HEADER_SIZE + recordsBefore(head);
  const end = begin + head.directory_count * head.directory_size;
  const count = directory.length + (before ? 0 : 1);
  const indexSize = header.indexSize + (count - head.directory_count) * head.directory_size;

  const others = [
    ...directory.filter((place) => place !== before),
    ...allTiles(header).flatMap(({ layers }) => layers),
  ];
  const tree = directory.find(({ type }) => type === spec.CHUNK_TREE);
  const place = before?.offset ?? (tree ? tree.offset + tree.size : 0); // a new META chunk comes first, or after TREE
  const chunks = [{ offset: place, bytes: meta, field: 0 }];
  for (const { offset, size, offsetField } of others) {
    chunks.push({ offset, bytes: source.subarray(offset, offset + size), field: offsetField });
  }
  chunks.sort((a, b) => a.offset - b.offset);
  let at = spec.HEADER_SIZE + indexSize;
  let metaAt = 0;
  for (const { bytes: chunk, field } of chunks) {
    if (field) view.setBigUint64(field, BigInt(at), true);
    else metaAt = at;
    at += chunk.length;
  }

  const records = directory.map(({ recordOffset }) => index.subarray(recordOffset, recordOffset + head.directory_size));
  const record = before ? records[directory.indexOf(before)] : new Uint8Array(head.directory_size);
  if (!before) records.push(record);
  putRecord(record, flags, meta, metaAt);
  const axesAt = spec.HEADER_SIZE + AT_INDEX.axes;
  if (up && !isUpright(header.axes, up)) index.fill(spec.DIRECTION_UNSPECIFIED, axesAt, axesAt + 3);
  view.setUint16(spec.HEADER_SIZE + AT_INDEX.directory_count, count, true);
  const tiles = allTiles(header);
  const roots = (await reader.nodes()).filter(({ parent }) => parent === null);
  const coarsest = roots.flatMap(({ firstTile, tileCount }) => tiles.slice(firstTile, firstTile + tileCount));
  view.setUint8(AT_HEADER.resource_level, requiredLevel({ ...header, indexSize }, coarsest).id);
  view.setUint32(AT_HEADER.index_size, indexSize, true);
  view.setBigUint64(AT_HEADER.file_size, BigInt(at), true);
  view.setUint32(AT_HEADER.header_crc, crc32(index.subarray(0, HEADER_FIXED)), true);
  const parts = [index.subarray(0, begin), ...records, index.subarray(end)];
  const written = joined([...parts, new Uint8Array(CRC_SIZE), ...chunks.map((chunk) => chunk.bytes)], at);
  const crcAt = spec.HEADER_SIZE + indexSize - CRC_SIZE;
  new DataView(written.buffer).setUint32(crcAt, crc32(written.subarray(spec.HEADER_SIZE, crcAt)), true);
  return written;
}

/**
 * Return metadata without an estimated view, whose up direction is no estimate.
 *
 * @param {Record<string, unknown>} metadata
 */
export function withoutEstimates({ estimated, view, ...rest }) {
  const isEstimate = /** @type {any} */ (view)?.from === 'estimate';
  const others = view === undefined || isEstimate ? rest : { ...rest, view };
  if (!Array.isArray(estimated)) return estimated === undefined ? others : { ...others, estimated };
  const keys = estimated.filter((key) => key !== spec.META_KEY_UP);
  return keys.length ? { ...others, estimated: keys } : others;
}

/**
 * Return the bytes of the index before the directory.
 *
 * @param {ReturnType<typeof spec.unpackIndexHead>} head
 */
function recordsBefore(head) {
  const { head_size, attribute_count, attribute_size, codebook_count, codebook_size, extra_count, extra_size } = head;
  return head_size + attribute_count * attribute_size + codebook_count * codebook_size + extra_count * extra_size;
}

/**
 * Return a META chunk, stored without compression (spec 5.1, 6.1).
 *
 * @param {object} metadata
 * @param {number} flags
 */
function metadataChunk(metadata, flags) {
  const text = new TextEncoder().encode(JSON.stringify(metadata));
  const heads = spec.CHUNK_HEADER_SIZE + spec.STREAM_HEAD_SIZE;
  const chunk = new Uint8Array(heads + text.length);
  const view = new DataView(chunk.buffer);
  putType(chunk, AT_CHUNK.type);
  view.setUint16(AT_CHUNK.flags, flags, true);
  view.setUint32(AT_CHUNK.payload_size, chunk.length - spec.CHUNK_HEADER_SIZE, true);
  view.setUint8(spec.CHUNK_HEADER_SIZE + AT_STREAM.width, 1);
  view.setUint8(spec.CHUNK_HEADER_SIZE + AT_STREAM.coder, spec.CODER_STORED);
  for (const field of [AT_STREAM.count, AT_STREAM.packed_size, AT_STREAM.coded_size]) {
    view.setUint32(spec.CHUNK_HEADER_SIZE + field, text.length, true);
  }
  chunk.set(text, heads);
  return chunk;
}

/**
 * @param {Uint8Array} record directory record
 * @param {number} flags
 * @param {Uint8Array} chunk META chunk
 * @param {number} offset
 */
function putRecord(record, flags, chunk, offset) {
  const view = new DataView(record.buffer, record.byteOffset, record.byteLength);
  putType(record, AT_RECORD.type);
  view.setUint16(AT_RECORD.flags, flags, true);
  view.setUint32(AT_RECORD.size, chunk.length, true);
  view.setBigUint64(AT_RECORD.offset, BigInt(offset), true);
  view.setUint32(AT_RECORD.crc, crc32(chunk), true);
}

/**
 * @param {Uint8Array} bytes
 * @param {number} at
 */
function putType(bytes, at) {
  bytes.set(new TextEncoder().encode(spec.CHUNK_METADATA), at);
}

/**
 * Return true if the axes are compatible with an up direction.
 *
 * @param {string} axes
 * @param {number[]} up
 */
function isUpright(axes, up) {
  const signs = [...axes].map((letter) => Number(letter === 'U') - Number(letter === 'D'));
  return axes === '' || signs.reduce((sum, sign, k) => sum + sign * up[k], 0) >= AXIS_AGREES;
}

/**
 * @param {Uint8Array[]} parts
 * @param {number} size total size
 */
function joined(parts, size) {
  const whole = new Uint8Array(size);
  let at = 0;
  for (const part of parts) {
    whole.set(part, at);
    at += part.length;
  }
  return whole;
}
