// Sources that have the whole file, sooner or later: a body from a server without ranges, memory, a Blob.

import { readFileHeader } from './container.mjs';
import { CsplatError, InputError, LimitError, allocate, fault } from './errors.mjs';
import { ERROR_LIMIT, ERROR_TRAILING, ERROR_TRUNCATED, HEADER_SIZE } from './spec.mjs';

/**
 * @typedef {Uint8Array<ArrayBuffer>} Bytes
 * @typedef {(received: number) => void} Received called with the bytes of each part that arrives
 */

/**
 * The error for data that ends before what the index announces.
 *
 * @param {number} offset where it ends
 * @param {number} size
 */
export const shortData = (offset, size) =>
  fault(ERROR_TRUNCATED, offset, 'HDR-5', `${size} bytes were asked for, the data ends before`);

/**
 * An abort stays what it is; everything else that a network does is E_INPUT.
 *
 * @param {unknown} error
 * @param {string | URL} url
 */
export function asInputError(error, url) {
  const isAbort = error instanceof Error && (error.name === 'AbortError' || error.name === 'TimeoutError');
  return isAbort || error instanceof CsplatError ? error : new InputError(`${url}: ${error}`, error);
}

/**
 * The parts of a body as they arrive; the rest is dropped when the loop is left.
 *
 * @param {Response} response
 */
export async function* bodyParts(response) {
  const reader = response.body?.getReader();
  if (!reader) return;
  try {
    for (let part = await reader.read(); !part.done; part = await reader.read()) yield part.value;
  } catch (error) {
    throw asInputError(error, response.url);
  } finally {
    reader.cancel().catch(() => {});
  }
}

/** A body with the whole file in it, usable from its first part on. */
export class WholeSource {
  /**
   * @param {Response} response
   * @param {{limit: number, received: Received}} way the largest file, and what to call with each part
   */
  static async open(response, way) {
    const source = new WholeSource();
    const arriving = bodyParts(response);
    /** @type {Uint8Array[]} */
    const first = [];
    let size = 0;
    while (size < HEADER_SIZE) {
      const { value, done } = await arriving.next();
      if (done) break;
      first.push(value);
      size += value.length;
      way.received(value.length);
    }
    const head = new Uint8Array(Math.min(size, HEADER_SIZE));
    copyParts(head, first);
    const { fileSize } = readFileHeader(head);
    if (fileSize > way.limit) {
      await arriving.return();
      throw new LimitError(
        ERROR_LIMIT,
        `a file of ${fileSize} bytes from a server without ranges, the budget is ${way.limit}`,
      );
    }
    source.bytes = allocate(() => new Uint8Array(fileSize));
    source.take(first);
    source.pump(arriving, way.received).catch((error) => source.fail(error));
    return source;
  }

  constructor() {
    /** @type {Bytes} */
    this.bytes = new Uint8Array(0);
    this.filled = 0;
    /** @type {unknown} */
    this.error = null;
    /** @type {{end: number, resolve: (value?: unknown) => void, reject: (error: unknown) => void}[]} */
    this.waiting = [];
  }

  /**
   * @param {number} offset
   * @param {number} size
   * @param {AbortSignal} [_signal]
   * @returns {Promise<Bytes>}
   */
  async read(offset, size, _signal) {
    const end = offset + size;
    if (end > this.bytes.length) throw shortData(this.bytes.length, size);
    if (this.error !== null) throw this.error;
    if (end > this.filled) await new Promise((resolve, reject) => this.waiting.push({ end, resolve, reject }));
    return this.bytes.subarray(offset, end);
  }

  /** Everything is on its way. */
  prefetch() {}

  /**
   * @param {AsyncGenerator<Uint8Array>} arriving
   * @param {Received} received
   */
  async pump(arriving, received) {
    for await (const part of arriving) {
      received(part.length);
      this.take([part]);
    }
    if (this.filled < this.bytes.length) throw shortData(this.filled, this.bytes.length);
  }

  /** @param {Uint8Array[]} arrived */
  take(arrived) {
    for (const part of arrived) {
      if (part.length > this.bytes.length - this.filled) {
        throw fault(ERROR_TRAILING, this.bytes.length, 'HDR-6', 'the server sends bytes behind the end of the file');
      }
      this.bytes.set(part, this.filled);
      this.filled += part.length;
    }
    for (const waiter of this.waiting) if (waiter.end <= this.filled) waiter.resolve();
    this.waiting = this.waiting.filter((waiter) => waiter.end > this.filled);
  }

  /** @param {unknown} error */
  fail(error) {
    this.error = error;
    for (const waiter of this.waiting) waiter.reject(error);
  }
}

/**
 * @param {Uint8Array} into
 * @param {Uint8Array[]} from
 */
function copyParts(into, from) {
  let filled = 0;
  for (const part of from) {
    const taken = part.subarray(0, into.length - filled);
    into.set(taken, filled);
    filled += taken.length;
  }
}

/** Bytes in memory. */
export class MemorySource {
  /** @param {Bytes} bytes */
  constructor(bytes) {
    this.bytes = bytes;
    this.size = bytes.length;
  }

  /**
   * @param {number} offset
   * @param {number} size
   * @returns {Promise<Bytes>}
   */
  async read(offset, size) {
    if (offset + size > this.size) throw shortData(this.size, size);
    return this.bytes.subarray(offset, offset + size);
  }
}

/** A File or Blob: a file that was dropped on a page. */
export class BlobSource {
  /** @param {Blob} blob */
  constructor(blob) {
    this.blob = blob;
    this.size = blob.size;
  }

  /**
   * @param {number} offset
   * @param {number} size
   * @returns {Promise<Bytes>}
   */
  async read(offset, size) {
    if (offset + size > this.blob.size) throw shortData(this.blob.size, size);
    return new Uint8Array(await this.blob.slice(offset, offset + size).arrayBuffer());
  }
}
