// SPDX-License-Identifier: Apache-2.0
// The header of a file (spec 4.2) and the frame of a chunk (5.1).

import { CRC_SIZE, crc32 } from './checksums.mjs';
import { fault } from './errors.mjs';
import { checkReserved } from './payload.mjs';
import { HIGHEST_LEVEL, nameOf } from './registry.mjs';
import * as spec from './spec.mjs';

/**
 * @typedef {{version: string, profile: string, resourceLevel: 'A' | 'B' | 'C', indexSize: number, fileSize: number, end: number}} FileHeader
 * @typedef {import('./decoder.d.ts').ChunkPlace} ChunkPlace
 */

const { HEADER_OFFSETS: AT, CHUNK_HEADER_OFFSETS: AT_CHUNK } = spec;

/** Decode four letters as a string. @param {Uint8Array} bytes */
export const typeName = (bytes) => String.fromCharCode(...bytes);

/** @param {number} value */
const hex = (value) => `0x${value.toString(16).padStart(8, '0')}`;

/**
 * Name what a server sent in place of a csplat file, if the first bytes show it.
 *
 * @param {Uint8Array} bytes the first bytes
 * @returns {string} starts with a comma; '' if the content is not recognised
 */
function standIn(bytes) {
  const text = String.fromCharCode(...bytes.subarray(0, spec.HEADER_SIZE));
  if (/^version https:\/\/(git-lfs|hawser)/.test(text)) return ', but a pointer of Git LFS (git lfs pull)';
  if (/^(\xef\xbb\xbf)?\s*<(!doctype|html|head|body|script|\?xml|error)/i.test(text)) return ', but a web page or XML';
  return /^ply[\r\n]/.test(text) ? ', but a PLY' : '';
}

/**
 * Read and check the header. Bytes after it are ignored.
 *
 * @param {Uint8Array<ArrayBuffer>} bytes
 * @param {string} [levelMax] highest resource level to accept; default: all
 * @returns {FileHeader} `end` is the offset of the end of the index
 */
export function readFileHeader(bytes, levelMax = HIGHEST_LEVEL) {
  const wrong = spec.MAGIC.findIndex((byte, i) => i < bytes.length && bytes[i] !== byte);
  if (wrong >= 0) {
    const clause = bytes.length < spec.HEADER_SIZE ? 'HDR-11' : 'HDR-1';
    throw fault(
      spec.ERROR_MAGIC,
      0,
      clause,
      `not a csplat file${standIn(bytes)}: byte ${wrong} is ${bytes[wrong]}, not ${spec.MAGIC[wrong]}`,
    );
  }
  if (bytes.length < spec.HEADER_SIZE) {
    throw fault(spec.ERROR_TRUNCATED, bytes.length, 'HDR-11', `the header has ${spec.HEADER_SIZE} bytes`);
  }
  const view = new DataView(bytes.buffer, bytes.byteOffset, bytes.byteLength);
  const header = spec.unpackHeader(view, 0);
  const { version_major: major, version_minor: minor, profile, index_size: indexSize } = header;
  if (major !== spec.VERSION_MAJOR || minor > spec.VERSION_MINOR) {
    const ours = `${spec.VERSION_MAJOR}.${spec.VERSION_MINOR}`;
    const detail = `the file has version ${major}.${minor}, this decoder reads ${ours}`;
    throw fault(spec.ERROR_VERSION, AT.version_major, 'HDR-2', detail);
  }
  checkCrc(bytes.subarray(0, AT.header_crc), header.header_crc, AT.header_crc, 'HDR-3');
  checkReserved(header, 0, spec.HEADER_RESERVED, 'the header');
  if (profile !== spec.PROFILE_BASE) {
    throw fault(spec.ERROR_UNSUPPORTED, AT.profile, 'HDR-4', `profile ${profile}: this decoder reads the profile base`);
  }
  const resourceLevel = nameOf(spec.RESOURCE_LEVEL_NAMES, header.resource_level);
  if (resourceLevel === undefined) {
    throw fault(spec.ERROR_UNSUPPORTED, AT.resource_level, 'RES-2', `resource level ${header.resource_level}`);
  }
  if (resourceLevel > levelMax) {
    throw fault(
      spec.ERROR_LIMIT,
      AT.resource_level,
      'LIM-2',
      `resource level ${resourceLevel}, the limit is ${levelMax}`,
    );
  }
  const fileSize = Number(header.file_size); // rounded above 2^53; no data is that long
  const end = spec.HEADER_SIZE + indexSize;
  if (indexSize < spec.INDEX_HEAD_SIZE + CRC_SIZE || end > fileSize) {
    throw fault(spec.ERROR_VALUE, AT.index_size, 'HDR-7', `an index of ${indexSize} bytes in a file of ${fileSize}`);
  }
  const profileName = spec.PROFILE_NAMES[spec.PROFILE_BASE];
  return { version: `${major}.${minor}`, profile: profileName, resourceLevel, indexSize, fileSize, end };
}

/**
 * @param {number} size size of the data
 * @param {FileHeader} header
 */
export function checkFileSize(size, { fileSize }) {
  if (size < fileSize)
    throw fault(spec.ERROR_TRUNCATED, size, 'HDR-5', `the file has ${fileSize} bytes, the data has ${size}`);
  if (size > fileSize) throw fault(spec.ERROR_TRAILING, fileSize, 'HDR-6', `${size - fileSize} bytes follow the end`);
}

/**
 * Check the CRC at the end of an index.
 *
 * @param {Uint8Array<ArrayBuffer>} index
 */
export function checkIndexCrc(index) {
  const at = index.length - CRC_SIZE;
  const found = new DataView(index.buffer, index.byteOffset, index.byteLength).getUint32(at, true);
  checkCrc(index.subarray(0, at), found, spec.HEADER_SIZE + at, 'IDX-1');
}

/**
 * Check the CRC and header of a chunk against its record in the index.
 *
 * @param {Uint8Array<ArrayBuffer>} chunk all bytes of the chunk, of the size in the record
 * @param {ChunkPlace} place
 * @returns {Uint8Array<ArrayBuffer>} the payload
 */
export function openChunk(chunk, place) {
  const { offset } = place;
  checkCrc(chunk, place.crc, offset, 'CHK-1');
  const header = spec.unpackChunkHeader(new DataView(chunk.buffer, chunk.byteOffset, chunk.byteLength), 0);
  const type = typeName(header.type);
  if (type !== place.type) {
    throw fault(spec.ERROR_INDEX, offset, 'CHK-3', `a chunk ${JSON.stringify(type)}, the index has ${place.type}`);
  }
  if (header.flags !== place.flags) {
    throw fault(
      spec.ERROR_INDEX,
      offset + AT_CHUNK.flags,
      'CHK-3',
      `flags ${header.flags}, the index has ${place.flags}`,
    );
  }
  checkReserved(header, offset, spec.CHUNK_HEADER_RESERVED, 'a chunk header');
  const payload = chunk.subarray(spec.CHUNK_HEADER_SIZE);
  if (header.payload_size !== payload.length) {
    throw fault(
      spec.ERROR_INDEX,
      offset + AT_CHUNK.payload_size,
      'CHK-3',
      `a payload of ${header.payload_size} bytes, the index has ${payload.length}`,
    );
  }
  return payload;
}

/**
 * @param {Uint8Array<ArrayBuffer>} bytes
 * @param {number} found the CRC stored in the file
 * @param {number} at offset in the file, for the error
 * @param {string} clause
 */
function checkCrc(bytes, found, at, clause) {
  const computed = crc32(bytes);
  if (found !== computed) throw fault(spec.ERROR_CRC, at, clause, `found ${hex(found)}, computed ${hex(computed)}`);
}
