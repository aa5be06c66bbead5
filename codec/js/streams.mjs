// SPDX-License-Identifier: Apache-2.0
// Streams: head and coder (spec sections 6.1 and 6.2).

import { fault } from './errors.mjs';
import { InflateError } from './inflate.mjs';
import { parseJson } from './json.mjs';
import * as spec from './spec.mjs';
import { elements, putIntegers, undoDelta, undoRunLength, undoZigzag } from './transforms.mjs';

const AT = spec.STREAM_HEAD_OFFSETS;
const { TRANSFORM_DELTA, TRANSFORM_ZIGZAG, TRANSFORM_RUN_LENGTH } = spec;

/**
 * The elements of a stream as unsigned integers: `low` holds their lower 32 bits, `high` the others (null up to width 4).
 *
 * @typedef {{low: Uint32Array, high: Uint32Array | null, width: number, offset: number}} Elements
 * @typedef {import('./payload.mjs').Payload} Payload
 * @typedef {import('./inflate.mjs').Inflate} Inflate
 * @typedef {ReturnType<typeof spec.unpackStreamHead>} StreamHead
 */

/**
 * Read one stream.
 *
 * @param {Payload} payload at the stream's head
 * @param {number} count number of elements required here
 * @param {number} widthMax maximum bytes per element
 * @param {Inflate} inflate
 * @returns {Promise<Elements>} with the offset of the head
 */
export async function readStream(payload, count, widthMax, inflate) {
  const { head, offset } = readHead(payload, widthMax, (found, at) => checkCount(found, count, at));
  const bytes = await unpack(payload, head, offset, inflate);
  return { ...elements(bytes, head), width: head.width, offset };
}

/**
 * Read and parse the stream of a JSON chunk (spec 5.4).
 *
 * @param {Payload} payload
 * @param {number} limit maximum memory of the text (STR-8), in bytes
 * @param {Inflate} inflate
 * @returns {Promise<{value: unknown, offset: number}>} with the offset of the head
 */
export async function readJson(payload, limit, inflate) {
  const { head, offset } = readHead(payload, 1, (found, at) => {
    if (found === 0) throw fault(spec.ERROR_STREAM, at, 'STR-1', 'no elements');
    checkMemory(spec.JSON_BYTE_COST * found, limit, at);
  });
  const text = (await unpack(payload, head, offset, inflate)).slice();
  const transforms = [...head.transforms];
  if (transforms.includes(TRANSFORM_ZIGZAG)) undoZigzag(text, 1);
  if (transforms.includes(TRANSFORM_DELTA)) undoDelta(text, 1);
  payload.finish();
  let values = 0;
  for (const byte of text) if (byte === 0x2c || byte === 0x3a || byte === 0x5b || byte === 0x7b) values++;
  const memory = spec.JSON_BYTE_COST * text.length + spec.JSON_VALUE_COST * values;
  checkMemory(memory, limit, offset + spec.STREAM_HEAD_OFFSETS.count);
  try {
    return { value: parseJson(text), offset };
  } catch (error) {
    throw fault(spec.ERROR_JSON, offset, 'JSN-1', error instanceof Error ? error.message : String(error), error);
  }
}

/**
 * @param {number} memory of a JSON text, in bytes
 * @param {number} limit
 * @param {number} at offset of the count in the file
 */
function checkMemory(memory, limit, at) {
  if (memory <= limit) return;
  throw fault(spec.ERROR_LIMIT, at, 'STR-8', `JSON that takes ${memory} bytes of memory, the budget is ${limit}`);
}

/**
 * Read one stream as integers in binary64.
 *
 * @param {Payload} payload at the stream's head
 * @param {number} count
 * @param {number} widthMax at most 4
 * @param {boolean} isSigned
 * @param {Inflate} inflate
 * @param {Float64Array} columns filled with the integers
 * @returns {Promise<{columns: Float64Array, width: number, offset: number}>}
 */
export async function readIntegers(payload, count, widthMax, isSigned, inflate, columns) {
  const { head, offset } = readHead(payload, widthMax, (found, at) => checkCount(found, count, at));
  const bytes = await unpack(payload, head, offset, inflate);
  putIntegers(columns, bytes, head, isSigned);
  return { columns, width: head.width, offset };
}

/**
 * @param {Payload} payload
 * @param {number} widthMax
 * @param {(count: number, offset: number) => void} checkItsCount throws if the count is not allowed here
 */
function readHead(payload, widthMax, checkItsCount) {
  const { fields: head, offset } = payload.read(
    spec.unpackStreamHead,
    spec.STREAM_HEAD_SIZE,
    spec.STREAM_HEAD_RESERVED,
    'a stream head',
  );
  const { width, coder, packed_size, coded_size } = head;
  if (width < 1 || width > widthMax) {
    throw fault(spec.ERROR_STREAM, offset, 'STR-2', `elements of ${width} bytes, expected 1 to ${widthMax}`);
  }
  if (!(coder in spec.CODER_NAMES)) throw fault(spec.ERROR_UNSUPPORTED, offset + AT.coder, 'RES-2', `coder ${coder}`);
  checkTransforms(head.transforms, offset + AT.transforms);
  checkItsCount(head.count, offset + AT.count);
  const plain = head.count * width; // below 2^35
  if (head.transforms.includes(TRANSFORM_RUN_LENGTH)) {
    if (packed_size < 3 || packed_size % 3 || packed_size > 3 * plain) {
      throw fault(spec.ERROR_STREAM, offset + AT.packed_size, 'STR-5', `runs of ${packed_size} bytes for ${plain}`);
    }
  } else if (packed_size !== plain) {
    throw fault(spec.ERROR_STREAM, offset + AT.packed_size, 'STR-4', `${packed_size} bytes for ${plain}`);
  }
  if (coded_size > payload.left) {
    throw fault(spec.ERROR_STREAM, offset + AT.coded_size, 'STR-6', `${coded_size} coded bytes, ${payload.left} left`);
  }
  return { head, offset };
}

/**
 * @param {number} found
 * @param {number} count
 * @param {number} offset
 */
function checkCount(found, count, offset) {
  if (found !== count) throw fault(spec.ERROR_STREAM, offset, 'STR-1', `${found} elements instead of ${count}`);
}

/**
 * @param {Uint8Array} transforms
 * @param {number} offset
 */
function checkTransforms(transforms, offset) {
  const unknown = transforms.find((transform) => !(transform in spec.TRANSFORM_NAMES));
  if (unknown !== undefined) throw fault(spec.ERROR_UNSUPPORTED, offset, 'RES-2', `transform ${unknown}`);
  let last = 0;
  for (let i = 0; i < transforms.length; i++) {
    const transform = transforms[i];
    const after = i > 0 && last === spec.TRANSFORM_NONE; // only NONE may follow NONE
    if (after ? transform !== spec.TRANSFORM_NONE : transform !== spec.TRANSFORM_NONE && transform <= last) {
      throw fault(spec.ERROR_STREAM, offset, 'STR-3', `transforms ${[...transforms].join(', ')}`);
    }
    last = transform;
  }
}

/**
 * Undo the coder and RUN_LENGTH.
 *
 * @param {Payload} payload after the stream's head; left after the coded bytes
 * @param {StreamHead} head
 * @param {number} offset
 * @param {Inflate} inflate
 * @returns {Promise<Uint8Array>} count × width bytes
 */
async function unpack(payload, head, offset, inflate) {
  const { coder, packed_size: size, coded_size } = head;
  const at = payload.claim(coded_size, 'coded bytes');
  const coded = payload.bytes.subarray(at, at + coded_size);
  const start = offset + spec.STREAM_HEAD_SIZE;
  /** @type {Uint8Array} */
  let packed = coded;
  if (coder === spec.CODER_STORED) {
    if (coded_size !== size) throw fault(spec.ERROR_CODER, start, 'COD-1', `${coded_size} stored bytes for ${size}`);
  } else {
    try {
      packed = await inflate(coded, size);
    } catch (error) {
      if (!(error instanceof InflateError)) throw error;
      throw fault(spec.ERROR_CODER, start + error.at, error.clause, error.message, error);
    }
  }
  if (!head.transforms.includes(TRANSFORM_RUN_LENGTH)) return packed;
  return undoRunLength(packed, head.count * head.width, start);
}
