// SPDX-License-Identifier: Apache-2.0
// Transforms: from unpacked bytes to integers (spec section 6.3).

import { fault } from './errors.mjs';
import * as spec from './spec.mjs';

const { TRANSFORM_DELTA, TRANSFORM_ZIGZAG, TRANSFORM_BYTE_PLANES } = spec;

/** @typedef {ReturnType<typeof spec.unpackStreamHead>} StreamHead */

/**
 * Return the elements as signed integers of up to four bytes.
 *
 * @param {{low: Uint32Array, width: number}} stream its elements are overwritten
 * @returns {Int32Array}
 */
export function signed({ low, width }) {
  const integers = new Int32Array(low.buffer, low.byteOffset, low.length);
  const shift = 32 - 8 * width;
  if (shift) for (let i = 0; i < integers.length; i++) integers[i] = (integers[i] << shift) >> shift;
  return integers;
}

/**
 * Write elements as integers in binary64.
 *
 * @param {Float64Array} out `count` elements
 * @param {Uint8Array} bytes
 * @param {StreamHead} head with a width of at most 4
 * @param {boolean} isSigned
 */
export function putIntegers(out, bytes, head, isSigned) {
  const { width, transforms } = head;
  if (width > 1 || transforms.includes(TRANSFORM_DELTA)) {
    const { low } = elements(bytes, head);
    out.set(isSigned ? signed({ low, width }) : low);
    return;
  }
  // Most streams are single bytes, which a table converts.
  const every = Uint32Array.from({ length: 256 }, (_, byte) => byte);
  if (transforms.includes(TRANSFORM_ZIGZAG)) undoZigzag(every, 1);
  const table = new Float64Array(isSigned ? signed({ low: every, width }) : every);
  for (let i = 0; i < out.length; i++) out[i] = table[bytes[i]];
}

/**
 * @param {Uint8Array} packed values, then low bytes and high bytes of the lengths minus one
 * @param {number} size
 * @param {number} offset
 */
export function undoRunLength(packed, size, offset) {
  const runs = packed.length / 3; // an integer by STR-5
  let total = 0;
  for (let i = 0; i < runs; i++) total += 1 + packed[runs + i] + 256 * packed[2 * runs + i];
  // TRF-1: "The lengths of the runs MUST add up to count × width"
  if (total !== size) throw fault(spec.ERROR_CODER, offset, 'TRF-1', `runs of ${total} bytes for ${size}`);
  const bytes = new Uint8Array(size);
  for (let i = 0, at = 0; i < runs; i++) {
    const value = packed[i];
    const end = at + 1 + packed[runs + i] + 256 * packed[2 * runs + i];
    if (end - at > 32) bytes.fill(value, at, end);
    else for (let j = at; j < end; j++) bytes[j] = value;
    at = end;
  }
  return bytes;
}

/**
 * Gather the elements from their bytes and undo ZIGZAG and DELTA.
 *
 * @param {Uint8Array} bytes
 * @param {StreamHead} head
 * @returns {{low: Uint32Array, high: Uint32Array | null}}
 */
export function elements(bytes, { count, width, transforms }) {
  const planes = transforms.includes(TRANSFORM_BYTE_PLANES);
  const zigzag = transforms.includes(TRANSFORM_ZIGZAG);
  const delta = transforms.includes(TRANSFORM_DELTA);
  const low = gather(bytes, count, 0, Math.min(width, 4), planes ? 1 : width, planes ? count : 1);
  if (width <= 4) {
    if (zigzag) undoZigzag(low, width);
    if (delta) undoDelta(low, width);
    return { low, high: null };
  }
  const high = gather(bytes, count, 4, width, planes ? 1 : width, planes ? count : 1);
  if (zigzag) undoWideZigzag(low, high, width);
  if (delta) undoWideDelta(low, high, width);
  return { low, high };
}

/**
 * Return bytes `first` to `last` − 1 of each element; byte k of element i is at i × `step` + k × `plane`.
 *
 * @param {Uint8Array} bytes
 * @param {number} count
 * @param {number} first
 * @param {number} last at most `first` + 4
 * @param {number} step
 * @param {number} plane
 */
function gather(bytes, count, first, last, step, plane) {
  const out = new Uint32Array(count);
  const begin = first * plane;
  if (last - first === 1) {
    for (let i = 0, at = begin; i < count; i++, at += step) out[i] = bytes[at];
    return out;
  }
  for (let i = 0, at = begin; i < count; i++, at += step) out[i] = bytes[at] | (bytes[at + plane] << 8);
  for (let k = first + 2; k < last; k++) {
    const shift = 8 * (k - first);
    for (let i = 0, at = k * plane; i < count; i++, at += step) out[i] |= bytes[at] << shift;
  }
  return out;
}

/**
 * @param {Uint32Array | Uint8Array} x
 * @param {number} width 1 to 4
 */
export function undoZigzag(x, width) {
  const mask = width === 4 ? -1 : 2 ** (8 * width) - 1;
  for (let i = 0; i < x.length; i++) x[i] = ((x[i] >>> 1) ^ -(x[i] & 1)) & mask;
}

/**
 * @param {Uint32Array | Uint8Array} x
 * @param {number} width 1 to 4
 */
export function undoDelta(x, width) {
  const mask = width === 4 ? -1 : 2 ** (8 * width) - 1;
  let last = 0;
  for (let i = 0; i < x.length; i++) x[i] = last = (last + x[i]) & mask;
}

/**
 * @param {Uint32Array} low
 * @param {Uint32Array} high
 * @param {number} width 5 to 8
 */
function undoWideZigzag(low, high, width) {
  const mask = width === 8 ? -1 : 2 ** (8 * width - 32) - 1;
  for (let i = 0; i < low.length; i++) {
    const sign = -(low[i] & 1);
    low[i] = ((low[i] >>> 1) | (high[i] << 31)) ^ sign;
    high[i] = ((high[i] >>> 1) ^ sign) & mask;
  }
}

/**
 * @param {Uint32Array} low
 * @param {Uint32Array} high
 * @param {number} width 5 to 8
 */
function undoWideDelta(low, high, width) {
  const mask = width === 8 ? -1 : 2 ** (8 * width - 32) - 1;
  for (let i = 1; i < low.length; i++) {
    const sum = low[i - 1] + low[i]; // below 2^33
    low[i] = sum;
    high[i] = (high[i - 1] + high[i] + (sum > 0xffffffff ? 1 : 0)) & mask;
  }
}
