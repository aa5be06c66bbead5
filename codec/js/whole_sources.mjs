// SPDX-License-Identifier: Apache-2.0
// Sources that have the whole file: a body from a server without ranges, memory, a Blob, a file on disk.

import { replaced } from './answers.mjs';
import { readFileHeader } from './container.mjs';
import { InputError, LimitError, allocate, fault } from './errors.mjs';
import { toBytes } from './options.mjs';
import { ERROR_LIMIT, ERROR_TRAILING, ERROR_TRUNCATED, HEADER_SIZE, MAGIC } from './spec.mjs';
import { Arrivals, abortable, asInputError, unlessAborted } from './transport.mjs';

/**
 * @typedef {import('./decoder.d.ts').ByteSource} ByteSource
 * @typedef {import('./decoder.d.ts').ByteRange} ByteRange
 * @typedef {Uint8Array<ArrayBuffer>} Bytes
 * @typedef {import('./answers.mjs').Asked} Asked
 * @typedef {import('./transport.mjs').Transport} Transport
 * @typedef {import('./transport.mjs').Way} Way
 * @typedef {import('./transport.mjs').Answer} Sent
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
 * Return the error for an answer that a proxy has ended early, as if it were complete.
 *
 * @param {number} got bytes
 * @param {number | string} promised
 */
export const cutShort = (got, promised) =>
  new InputError(`the answer of the server ended after ${got} of ${promised} bytes`, {
    ...{ reason: 'connection', isTransient: true },
  });

/** A body with the whole file, usable as soon as its first part has arrived; requested again if it breaks. */
export class WholeSource {
  /**
   * @param {Transport} transport
   * @param {Bytes} head first bytes of the file, if they are known from an earlier answer
   */
  constructor(transport, head) {
    this.transport = transport;
    this.head = head.subarray(0, HEADER_SIZE);
    /** Room for the header, then for the file. @type {Bytes} */
    this.bytes = new Uint8Array(HEADER_SIZE);
    this.isOpen = false; // its header has arrived
    this.filled = 0;
    /** @type {{error: unknown} | null} */
    this.failure = null;
    /** @type {Set<{end: number, resolve: (value?: unknown) => void, reject: (error: unknown) => void}>} */
    this.waiting = new Set();
  }

  /**
   * Read the file in the background.
   *
   * @param {Sent | null} sent what has been answered; null for a new request
   * @param {Asked | null} asked the range that it answers
   */
  begin(sent, asked) {
    this.failure = null;
    this.#pump(sent, asked).catch((error) => {
      this.failure = { error };
      for (const waiter of this.waiting) waiter.reject(error);
      this.waiting.clear();
    });
  }

  /**
   * @param {number} offset
   * @param {number} size
   * @param {AbortSignal} [signal]
   * @returns {Promise<Bytes>}
   */
  async read(offset, size, signal) {
    const end = offset + size;
    if (this.failure) {
      const { error } = this.failure;
      if (!(error instanceof InputError && error.isTransient) || this.transport.way.isOnce) throw error;
      this.begin(null, null); // the caller tries again
    }
    if (!this.isOpen) await this.#arrival(HEADER_SIZE, signal);
    if (end > this.bytes.length) throw shortData(this.bytes.length, size);
    if (end > this.filled) await this.#arrival(end, signal);
    return this.bytes.subarray(offset, end);
  }

  /**
   * @param {number} end
   * @param {AbortSignal} [signal]
   */
  #arrival(end, signal) {
    return abortable(new Promise((resolve, reject) => this.waiting.add({ end, resolve, reject })), signal);
  }

  /**
   * @param {Sent | null} sent
   * @param {Asked | null} asked
   */
  async #pump(sent, asked) {
    const { transport } = this;
    const tries = transport.tries();
    let ended = -1;
    for (;;) {
      const before = this.filled;
      try {
        if (sent === null) {
          asked = transport.isPlain ? null : { start: before, end: Infinity };
          sent = await tries.ask(asked);
        }
        const { take } = sent;
        if (take === 'plain' || (take === 'end' && sent.total === null)) transport.isPlain = true;
        else if (take === 'end') throw shortData(before, this.bytes.length);
        else if (take !== 'within' && (await this.#receive(sent, asked, ended))) return;
      } catch (error) {
        if (error instanceof InputError && error.reason === 'connection') ended = this.filled;
        await tries.again(error, this.filled - before);
      }
      sent = null;
    }
  }

  /**
   * Read one body to its end.
   *
   * @param {Sent} sent
   * @param {Asked | null} asked
   * @param {number} ended where the last answer ended: two that end there without an announced size are complete
   * @returns {Promise<boolean>} whether the file is
   */
  async #receive({ take, body }, asked, ended) {
    const start = take === 'part' ? this.filled : 0;
    let at = start;
    for await (const part of body.parts()) {
      this.#take(part, at, asked);
      at += part.length;
    }
    if (this.isOpen && this.filled === this.bytes.length) return true;
    const isComplete = body.size === at - start || this.transport.way.isOnce === true;
    if (take === 'part' && isComplete && at > start) return false; // fewer bytes than requested
    if (this.isOpen && asked && take === 'whole' && at === asked.end - asked.start) throw this.#partAsWhole(asked);
    const size = this.isOpen ? this.bytes.length : HEADER_SIZE;
    if (take === 'part' || (!isComplete && (at !== ended || at !== this.filled))) throw cutShort(at, size);
    if (!this.isOpen) readFileHeader(this.bytes.subarray(0, this.filled)); // throws
    throw shortData(this.filled, size);
  }

  /**
   * @param {Uint8Array} part
   * @param {number} at its offset in the file
   * @param {Asked | null} asked
   */
  #take(part, at, asked) {
    for (let from = 0; from < part.length;) {
      const here = at + from;
      if (here < this.filled) {
        const known = this.bytes.subarray(here, Math.min(this.filled, at + part.length));
        if (known.some((byte, i) => byte !== part[from + i])) {
          throw replaced(this.transport.url, 'an answer differs from the one before');
        }
        from += known.length;
        continue;
      }
      if (this.filled === this.bytes.length) {
        throw fault(ERROR_TRAILING, this.bytes.length, 'HDR-6', 'the server sends bytes after the end of the file');
      }
      const taken = part.subarray(from, from + this.bytes.length - this.filled);
      this.bytes.set(taken, this.filled);
      this.transport.arrivals.count(this.filled, this.filled + taken.length);
      this.filled += taken.length;
      from += taken.length;
      if (!this.isOpen) this.#open(asked);
    }
    for (const waiter of this.waiting) {
      if (waiter.end > this.filled) continue;
      waiter.resolve();
      this.waiting.delete(waiter);
    }
  }

  /** @param {Asked | null} asked */
  #open(asked) {
    const { bytes, filled, head, transport } = this;
    if (head.subarray(0, filled).some((byte, i) => byte !== bytes[i])) {
      const isScene = MAGIC.every((byte, i) => i >= filled || byte === bytes[i]);
      if (asked && !isScene && !transport.isChanged) throw this.#partAsWhole(asked);
      throw replaced(transport.url, 'another answer begins with other bytes');
    }
    if (filled < HEADER_SIZE) return;
    const { fileSize } = readFileHeader(bytes);
    const { limit } = transport.way;
    if (fileSize > limit) {
      throw new LimitError(
        ERROR_LIMIT,
        `a file of ${fileSize} bytes from a server without ranges, the budget is ${limit}`,
      );
    }
    this.bytes = allocate(() => new Uint8Array(fileSize));
    this.bytes.set(bytes);
    this.isOpen = true;
    transport.stated ??= fileSize;
  }

  /** @param {Asked} asked */
  #partAsWhole({ start, end }) {
    const detail = `the server answers a request for the bytes ${start}–${end - 1} with them, but with status 200`;
    return new InputError(`${this.transport.url}: ${detail}, which announces the whole file; a part needs status 206`, {
      ...{ reason: 'server', status: 200 },
    });
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

/** Bytes in memory, a Blob, such as a file dropped on a page, or a file on disk. */
export class LocalSource {
  /**
   * @param {string} name for messages
   * @param {number} size
   * @param {(start: number, end: number) => Promise<Bytes>} load
   * @param {Way} way
   */
  constructor(name, size, load, way) {
    this.name = name;
    this.size = size;
    this.load = load;
    this.way = way;
    this.arrivals = new Arrivals(way.received);
  }

  /**
   * @param {number} offset
   * @param {number} size
   * @param {AbortSignal} [signal]
   * @returns {Promise<Bytes>}
   */
  async read(offset, size, signal) {
    const end = offset + size;
    if (end > this.size) throw shortData(this.size, size);
    const bytes = await unlessAborted([...this.way.signals, signal], () =>
      this.load(offset, end).catch((error) => {
        throw unreadable(this.name, error);
      }),
    );
    if (bytes.length < size) throw shortData(offset + bytes.length, size); // it was shortened
    this.arrivals.count(offset, end);
    return bytes;
  }
}

/**
 * @param {string} name
 * @param {any} error
 */
const unreadable = (name, error) =>
  new InputError(`${name} cannot be read: ${error?.message ?? error}`, { cause: error });

/**
 * Open a file on disk, in Node and its like.
 *
 * @param {string | URL} from a path or a file: URL
 * @param {Way} way
 * @returns {Promise<LocalSource>}
 */
export async function openFile(from, way) {
  const name = 'node:fs/promises'; // hides it from bundlers for browsers
  try {
    const { open, stat } = await import(/* webpackIgnore: true */ /* @vite-ignore */ name);
    const path = String(from).startsWith('file:') ? new URL(from) : from;
    const { size } = await stat(path);
    return new LocalSource(`“${from}”`, size, (start, end) => readFile(open, path, start, end), way);
  } catch (error) {
    throw unreadable(`“${from}”`, error);
  }
}

/**
 * Read a part of a file, which is open meanwhile.
 *
 * @param {(path: string | URL) => Promise<any>} open of node:fs/promises
 * @param {string | URL} path
 * @param {number} start
 * @param {number} end
 * @returns {Promise<Bytes>} fewer bytes if the file ends before
 */
async function readFile(open, path, start, end) {
  const file = await open(path);
  try {
    const bytes = allocate(() => new Uint8Array(end - start));
    let filled = 0;
    while (filled < bytes.length) {
      const { bytesRead } = await file.read(bytes, filled, bytes.length - filled, start + filled);
      if (bytesRead === 0) break;
      filled += bytesRead;
    }
    return bytes.subarray(0, filled);
  } finally {
    await file.close();
  }
}
