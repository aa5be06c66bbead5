// Sources that hold the whole file: a body from a server without ranges, memory, a Blob.

import { readFileHeader } from './container.mjs';
import { CsplatError, InputError, LimitError, allocate, fault } from './errors.mjs';
import { toBytes } from './options.mjs';
import { ERROR_LIMIT, ERROR_TRAILING, ERROR_TRUNCATED, HEADER_SIZE } from './spec.mjs';

/**
 * @typedef {import('./decoder.d.ts').ByteSource} ByteSource
 * @typedef {import('./decoder.d.ts').ByteRange} ByteRange
 * @typedef {Uint8Array<ArrayBuffer>} Bytes
 * @typedef {(received: number) => void} Received called with the number of bytes of each part that arrives
 */

/**
 * Return the error for data that is shorter than the index requires.
 *
 * @param {number} offset length of the data
 * @param {number} size bytes that were requested
 */
export const shortData = (offset, size) =>
  fault(ERROR_TRUNCATED, offset, 'HDR-5', `${size} bytes were requested, the data ends earlier`);

/**
 * Turn a network error into E_INPUT; keep aborts and errors of the decoder.
 *
 * @param {unknown} error
 * @param {string | URL} url
 */
export function asInputError(error, url) {
  const isAbort = error instanceof Error && (error.name === 'AbortError' || error.name === 'TimeoutError');
  return isAbort || error instanceof CsplatError ? error : new InputError(`${url}: ${error}`, error, true);
}

/**
 * Yield the parts of a body as they arrive; the rest is cancelled if the loop is left early.
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

/** A body with the whole file, usable as soon as its first part has arrived. */
export class WholeSource {
  /**
   * @param {Response} response
   * @param {{limit: number, received: Received}} way maximum size of the file, and the callback for each part
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
    /** Whether later bytes arrive later. */
    this.isSequential = true;
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

  /** Do nothing: the whole file is already on its way. */
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
        throw fault(ERROR_TRAILING, this.bytes.length, 'HDR-6', 'the server sends bytes after the end of the file');
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

/** A source of the caller, whose results are checked. */
export class CallerSource {
  /** @param {ByteSource} source */
  constructor(source) {
    this.source = source;
    const { size } = source;
    if (size !== undefined && size !== null && !(Number.isSafeInteger(size) && size >= 0))
      throw new InputError('the size of the source is not a whole number of bytes');
  }

  get size() {
    return this.source.size;
  }

  get isSequential() {
    return this.source.isSequential ?? false;
  }

  /**
   * @param {number} offset
   * @param {number} size
   * @param {AbortSignal} [signal]
   * @returns {Promise<Bytes>}
   */
  async read(offset, size, signal) {
    /** @type {Bytes} */
    let bytes;
    try {
      bytes = toBytes(await this.source.read(offset, size, signal));
    } catch (error) {
      throw signal?.aborted ? error : asInputError(error, 'the source');
    }
    if (bytes.length < size) throw shortData(offset + bytes.length, size);
    if (bytes.length > size) throw new InputError(`the source returned ${bytes.length} bytes instead of ${size}`);
    return bytes;
  }

  /**
   * @param {ByteRange[]} ranges
   * @param {AbortSignal} [signal]
   */
  prefetch(ranges, signal) {
    try {
      this.source.prefetch?.(ranges, signal);
    } catch (error) {
      throw asInputError(error, 'the source');
    }
  }
}

/** A File or Blob, such as a file dropped on a page. */
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
