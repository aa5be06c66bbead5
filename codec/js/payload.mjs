// SPDX-License-Identifier: Apache-2.0
// Bytes of a file with their offset in it. Every length is checked here before it is used.

import { fault } from './errors.mjs';
import { ERROR_RESERVED, ERROR_STREAM } from './spec.mjs';

/** The payload of a chunk (or the index), read from beginning to end. */
export class Payload {
  /**
   * @param {Uint8Array<ArrayBuffer>} bytes
   * @param {number} base offset in the file of the first byte
   * @param {string} clause the clause that requires the payload to end after its last part
   * @param {import('./decoder.d.ts').ErrorCode} [code]
   */
  constructor(bytes, base, clause, code = ERROR_STREAM) {
    this.bytes = bytes;
    this.view = new DataView(bytes.buffer, bytes.byteOffset, bytes.byteLength);
    this.base = base;
    this.clause = clause;
    this.code = code;
    this.at = 0;
  }

  /** Offset in the file of the next byte. */
  get offset() {
    return this.base + this.at;
  }

  get left() {
    return this.bytes.length - this.at;
  }

  /**
   * Skip the next `size` bytes.
   *
   * @param {number} size
   * @param {string} what name for the message
   * @returns {number} position of the first of them in `view`
   */
  claim(size, what) {
    if (size > this.left)
      throw fault(this.code, this.offset, this.clause, `${what} of ${size} bytes, ${this.left} left`);
    this.at += size;
    return this.at - size;
  }

  /**
   * Read a structure with its generated reader and refuse reserved fields other than 0.
   *
   * @template {Record<string, unknown>} T
   * @param {(view: DataView, at: number) => T} unpack
   * @param {number} size size of the structure with its tail, which is skipped
   * @param {Readonly<Record<string, number>>} reserved offsets of its reserved fields
   * @param {string} what name for the message
   * @returns {{fields: T, offset: number}} the offset in the file
   */
  read(unpack, size, reserved, what) {
    const offset = this.offset;
    const fields = unpack(this.view, this.claim(size, what));
    checkReserved(fields, offset, reserved, what);
    return { fields, offset };
  }

  finish() {
    if (this.left) throw fault(this.code, this.offset, this.clause, `${this.left} bytes too many`);
  }
}

/**
 * Check RES-1: "A reserved field or bit MUST be 0".
 *
 * @param {Record<string, unknown>} fields fields of a structure
 * @param {number} at offset of the structure in the file
 * @param {Readonly<Record<string, number>>} reserved offsets of its reserved fields
 * @param {string} what name for the message
 */
export function checkReserved(fields, at, reserved, what) {
  for (const name in reserved) {
    if (fields[name] !== 0)
      throw fault(ERROR_RESERVED, at + reserved[name], 'RES-1', `${what}: ${name} is ${fields[name]}`);
  }
}
