// SPDX-License-Identifier: Apache-2.0
// Sources of a file that is not in memory: HTTP with Range, or one of those in `whole_sources.mjs`.

import { readFileHeader } from './container.mjs';
import { InputError } from './errors.mjs';
import { toBytes } from './options.mjs';
import { HEADER_SIZE } from './spec.mjs';
import { Transport, onAbort, unlessAborted } from './transport.mjs';
import { CallerSource, LocalSource, WholeSource, cutShort, openFile, shortData } from './whole_sources.mjs';

const GAP_BYTES = 1 << 14; // bytes; ranges separated by less are fetched together
const REQUEST_BYTES = 1 << 23; // bytes; joined ranges do not exceed this
const UNSEEN_BYTES = 1 << 24; // memory of an answer before its bytes arrive; more grows with them
const TINY_BYTES = 256; // an answer to a longer range with fewer bytes is no progress
const TINY_ANSWERS = 16; // in a row after which the server is asked for the whole file

/**
 * @typedef {import('./decoder.d.ts').ByteSource} ByteSource
 * @typedef {import('./decoder.d.ts').ByteRange} ByteRange
 * @typedef {import('./decoder.d.ts').FileSource} FileSource
 * @typedef {import('./transport.mjs').Way} Way
 * @typedef {Uint8Array<ArrayBuffer>} Bytes
 */

/**
 * @param {FileSource} from
 * @param {Way} way request options
 * @returns {Promise<ByteSource>}
 */
export async function openSource(from, way) {
  if (typeof from === 'string' || from instanceof URL) {
    return isOnDisk(from, way) ? openFile(from, way) : openUrl(absolute(from, way), way);
  }
  if (from instanceof Blob) return new LocalSource('the Blob', from.size, partsOf(from), way);
  if (from instanceof ArrayBuffer || ArrayBuffer.isView(from)) {
    const bytes = toBytes(from);
    return new LocalSource('the data', bytes.length, async (start, end) => bytes.subarray(start, end), way);
  }
  const given = /** @type {any} */ (from);
  if (typeof given?.getReader === 'function' || (given?.headers && 'body' in given)) return openBody(given, way);
  if (typeof given?.pipe === 'function') {
    throw new InputError('the source is a stream of Node: pass `Readable.toWeb(stream)`');
  }
  if (typeof given?.read === 'function') return new CallerSource(given);
  const kinds = 'an address, a Blob, a Response, a ReadableStream, an ArrayBuffer, a view of one';
  throw new InputError(`the source is not ${kinds} or an object with a method read`);
}

/**
 * Return a function that reads parts of a Blob.
 *
 * @param {Blob} blob
 * @returns {(start: number, end: number) => Promise<Bytes>}
 */
const partsOf = (blob) => async (start, end) => new Uint8Array(await blob.slice(start, end).arrayBuffer());

/**
 * Tell whether an address is a path or a file: URL for Node and its like, which cannot fetch them all.
 *
 * @param {string | URL} address
 * @param {Way} way
 */
function isOnDisk(address, { hasFetch }) {
  const { process, document, location } = /** @type {any} */ (globalThis);
  const isPage = document !== undefined || location !== undefined; // also in Electron
  return (
    !hasFetch &&
    !isPage &&
    process?.versions?.node !== undefined &&
    /^(?:file:|(?![a-z][a-z\d+.-]+:))/i.test(String(address))
  );
}

/**
 * @param {string | URL} url
 * @param {Way} way
 */
function absolute(url, { hasFetch }) {
  const { document, location } = /** @type {any} */ (globalThis);
  try {
    return new URL(url, document?.baseURI ?? location?.href).href;
  } catch {
    if (hasFetch) return String(url); // which may understand it
    throw new InputError(`“${url}” is not a URL`);
  }
}

/**
 * Read an answer of the caller, or a stream, as it arrives.
 *
 * @param {Response | ReadableStream<Uint8Array>} from
 * @param {Way} way
 */
async function openBody(from, way) {
  const isStream = 'getReader' in from;
  const name = isStream ? 'the stream' : from.url || 'the response';
  if (isStream ? from.locked : from.bodyUsed || from.body?.locked) {
    throw new InputError(`${name}: its bytes are read elsewhere`);
  }
  const response = isStream ? new Response(from) : from;
  const once = { fetch: async () => response, isOnce: true, retries: 0, timeoutMs: Infinity, renew: undefined };
  const source = new HttpSource(new Transport(name, { ...way, ...once, isWhole: true }));
  return begun(source, way);
}

/**
 * @param {HttpSource} source
 * @param {Way} way
 */
async function begun(source, way) {
  try {
    await source.begin(way.firstBytes);
    return source;
  } catch (error) {
    source.close();
    throw error;
  }
}

/**
 * Open a URL with one request for the first bytes. If the server ignores the range and sends the whole file, the body is
 * read as it arrives.
 *
 * @param {string} url absolute
 * @param {Way} way
 */
async function openUrl(url, way) {
  if (/^(blob|data):/.test(url)) {
    const blob = await fetchBlob(url, way);
    return new LocalSource(url, blob.size, partsOf(blob), { ...way, received: () => {} });
  }
  const isLocal = url.startsWith('file:');
  try {
    return await begun(new HttpSource(new Transport(url, isLocal ? { ...way, retries: 0 } : way)), way);
  } catch (error) {
    if (!isLocal || !(error instanceof InputError)) throw error;
    const detail =
      'a page opened from disk cannot load files. `csplat export-html` puts viewer and scene into one page';
    throw new InputError(`${url}: ${detail}; or open the page from a local server`, { cause: error, reason: 'local' });
  }
}

/**
 * Fetch an address whose bytes are in this browser: once, since a page may revoke it, and since Node serves its ranges wrong.
 *
 * @param {string} url of the scheme blob or data
 * @param {Way} way
 */
async function fetchBlob(url, way) {
  try {
    return await unlessAborted(way.signals, async (signal) => {
      const blob = await (await way.fetch(url, { ...way.init, signal })).blob();
      way.received(blob.size);
      return blob;
    });
  } catch (error) {
    for (const signal of way.signals) if (signal?.aborted) throw signal.reason;
    const shown = url.length > 100 ? `${url.slice(0, 100)}…` : url;
    const isBlob = url.startsWith('blob:');
    const why = isBlob ? 'it may have been revoked too early, or belong to another origin' : 'it may be malformed';
    throw new InputError(`${shown}: ${error}; ${why}, or connect-src of the page's policy forbids it`, {
      ...{ cause: error, reason: 'refused' },
    });
  }
}

/** A range on its way, whose first bytes can be read before the others are here. */
class ArrivingRange {
  /**
   * @param {{start: number, end: number, due: number}} range `due`: number of parts that have not been read
   * @param {AbortSignal} [signal] cancels the request
   */
  constructor({ start, end, due }, signal) {
    this.start = start;
    this.end = end;
    this.due = due;
    this.signal = signal;
    /** All of it. @type {Promise<Bytes>} */
    this.bytes = Promise.resolve(new Uint8Array(0));
    /** @type {{size: number, resolve: (bytes: Bytes) => void}[]} */
    this.waiting = [];
    this.here = new Uint8Array(0);
  }

  /** @param {Bytes} here its bytes so far */
  take(here) {
    this.here = here;
    for (const { size, resolve } of this.waiting) if (size <= here.length) resolve(here);
    this.waiting = this.waiting.filter(({ size }) => size > here.length);
  }

  /**
   * Wait for its first bytes.
   *
   * @param {number} size
   * @returns {Promise<Bytes>} these, and perhaps more
   */
  first(size) {
    if (size <= this.here.length) return Promise.resolve(this.here);
    const arrived = new Promise((/** @type {(bytes: Bytes) => void} */ resolve) =>
      this.waiting.push({ size, resolve }),
    );
    return Promise.race([this.bytes, arrived]);
  }
}

/** A file on a server. */
export class HttpSource {
  /** @param {Transport} transport */
  constructor(transport) {
    this.transport = transport;
    /** The first bytes. @type {Bytes} */
    this.head = new Uint8Array(0);
    /** Prefetched ranges, each kept until all its parts have been read. @type {ArrivingRange[]} */
    this.fetched = [];
    /** @type {WholeSource | null} */
    this.whole = null;
  }

  /** Size of the file as the server reports it; null if unknown. */
  get size() {
    return this.whole ? null : this.transport.total;
  }

  /** Whether later bytes arrive later: the server sends the whole file. */
  get isSequential() {
    return this.whole !== null;
  }

  /** End all requests. */
  close() {
    this.transport.close();
  }

  /** @param {number} firstBytes */
  async begin(firstBytes) {
    const head = await this.#collect(0, firstBytes);
    if (head) this.head = head;
  }

  /**
   * @param {number} offset
   * @param {number} size
   * @param {AbortSignal} [signal]
   * @returns {Promise<Bytes>}
   */
  async read(offset, size, signal) {
    const end = offset + size;
    if (this.whole) return this.whole.read(offset, size, signal);
    if (end <= this.head.length) return this.head.subarray(offset, end);
    const start = Math.max(offset, this.head.length);
    const bytes = await this.readBehindHead(start, end, signal);
    if (start === offset) return bytes;
    const joined = new Uint8Array(size);
    joined.set(this.head.subarray(offset));
    joined.set(bytes, start - offset);
    return joined;
  }

  /**
   * @param {number} start
   * @param {number} end
   * @param {AbortSignal} [signal]
   * @returns {Promise<Bytes>}
   */
  async readBehindHead(start, end, signal) {
    const range = this.fetched.find((one) => one.start <= start && end <= one.end);
    if (range === undefined) return this.fetch(start, end, signal);
    const bytes = await range.first(end - range.start).catch((error) => {
      if (!range.signal?.aborted || signal?.aborted) throw error;
    });
    if (!bytes) return this.fetch(start, end, signal); // another reader has cancelled the request
    if (--range.due <= 0) this.fetched = this.fetched.filter((one) => one !== range);
    return bytes.subarray(start - range.start, end - range.start);
  }

  /**
   * Start to fetch parts that will be read soon; neighbours share a request.
   *
   * @param {ByteRange[]} wanted
   * @param {AbortSignal} [signal] cancels the requests, and drops what has arrived
   */
  prefetch(wanted, signal) {
    if (this.whole) return; // all of it is on its way
    const missing = wanted
      .filter(({ offset, size }) => offset + size > this.head.length)
      .map(({ offset, size }) => {
        const start = Math.max(offset, this.head.length);
        return { offset: start, size: offset + size - start };
      })
      .filter(({ offset, size }) => !this.fetched.some(({ start, end }) => start <= offset && offset + size <= end))
      .sort((a, b) => a.offset - b.offset);
    /** @type {{start: number, end: number, due: number}[]} */
    const joined = [];
    for (const { offset, size } of missing) {
      const last = joined.at(-1);
      if (last && offset <= last.end + GAP_BYTES && offset + size - last.start <= REQUEST_BYTES) {
        last.end = Math.max(last.end, offset + size);
        last.due++;
      } else joined.push({ start: offset, end: offset + size, due: 1 });
    }
    for (const range of joined) {
      const entry = new ArrivingRange(range, signal);
      entry.bytes = this.fetch(range.start, range.end, signal, entry);
      const drop = () => (this.fetched = this.fetched.filter((one) => one !== entry)); // allows another try
      entry.bytes.catch(drop);
      if (signal) onAbort(signal, drop);
      this.fetched.push(entry);
    }
  }

  /**
   * @param {number} start
   * @param {number} end
   * @param {AbortSignal} [signal]
   * @param {ArrivingRange} [arriving] receives the bytes as they arrive
   * @returns {Promise<Bytes>}
   */
  async fetch(start, end, signal, arriving) {
    const bytes = await this.#collect(start, end, signal, arriving);
    if (bytes === null) return /** @type {WholeSource} */ (this.whole).read(start, end - start, signal);
    if (bytes.length < end - start) throw shortData(start + bytes.length, end - start);
    return bytes;
  }

  /**
   * Request a range until all of it is here.
   *
   * @param {number} start
   * @param {number} end
   * @param {AbortSignal} [signal]
   * @param {ArrivingRange} [arriving]
   * @returns {Promise<Bytes | null>} fewer bytes if the file ends before; null if the whole file is on its way
   */
  async #collect(start, end, signal, arriving) {
    const { transport } = this;
    const tries = transport.tries(signal);
    let bytes = new Uint8Array(Math.min(end - start, UNSEEN_BYTES));
    let filled = 0;
    let tiny = 0;
    for (;;) {
      if (this.whole) return null;
      const until = Math.min(end, transport.size ?? Infinity);
      const asked = { start: start + filled, end: until };
      if (asked.start >= until) return bytes.subarray(0, filled);
      const before = filled;
      try {
        const answer = await tries.ask(transport.isPlain ? null : asked);
        if (answer.take === 'plain') transport.isPlain = true;
        if (answer.take === 'whole') this.#becomeWhole(answer, transport.isPlain ? null : asked, signal);
        if (answer.take === 'end') return bytes.subarray(0, filled);
        if (answer.take !== 'part') continue;
        for await (const part of answer.body.parts()) {
          const taken = part.subarray(0, until - start - filled);
          if (filled + taken.length > bytes.length) bytes = longer(bytes, filled + taken.length, end - start);
          bytes.set(taken, filled);
          transport.arrivals.count(start + filled, start + filled + taken.length);
          filled += taken.length;
          arriving?.take(bytes.subarray(0, filled));
          if (start + filled >= until) break;
        }
        const got = filled - before;
        if (start === 0) transport.stated ??= statedSize(bytes.subarray(0, filled));
        if (answer.end === null && got === 0 && transport.size === null) return bytes.subarray(0, filled);
        const promised = Math.min(answer.end ?? (got > 0 ? 0 : until), transport.size ?? Infinity);
        if (start + filled < promised) throw cutShort(got, promised - asked.start);
        tiny = got < TINY_BYTES ? tiny + 1 : 0;
        if (tiny > TINY_ANSWERS) transport.isPlain = true;
      } catch (error) {
        await tries.again(error, filled - before);
      }
    }
  }

  /**
   * @param {import('./transport.mjs').Answer} answer
   * @param {import('./answers.mjs').Asked | null} asked
   * @param {AbortSignal} [signal]
   */
  #becomeWhole(answer, asked, signal) {
    const { body } = answer;
    if (this.whole || signal?.aborted) return body.drop();
    body.detach(); // others wait for it, too
    this.whole = new WholeSource(this.transport, this.head);
    this.whole.begin(answer, asked);
  }

  /**
   * Tell whether the server has another file by now.
   *
   * @param {number} offset
   * @param {Bytes} bytes of the file as it was
   * @returns {Promise<boolean>} false if the server does not tell
   */
  async isOther(offset, bytes) {
    const { transport, whole } = this;
    if (transport.isChanged) return true;
    try {
      const end = offset + bytes.length;
      const now = whole ? await whole.read(offset, bytes.length) : await readNow(transport, offset, end);
      return now !== null && bytes.some((byte, i) => byte !== now[i]);
    } catch (error) {
      return error instanceof InputError && error.isReplaced;
    }
  }
}

/**
 * Request a range once, not from a cache.
 *
 * @param {Transport} transport
 * @param {number} start
 * @param {number} end
 * @returns {Promise<Bytes | null>} null if the server sends something else
 */
async function readNow(transport, start, end) {
  const { take, body } = await transport.tries().ask({ start, end }, { cache: 'no-store' });
  if (take !== 'whole' && take !== 'part') return null;
  const bytes = new Uint8Array(take === 'whole' ? end : end - start);
  let filled = 0;
  for await (const part of body.parts()) {
    const taken = part.subarray(0, bytes.length - filled);
    bytes.set(taken, filled);
    filled += taken.length;
    if (filled === bytes.length) break;
  }
  return filled === bytes.length ? bytes.subarray(start - end) : null;
}

/**
 * Copy the bytes of an answer to a longer array, of twice the length unless all of the answer is shorter.
 *
 * @param {Bytes} bytes
 * @param {number} least
 * @param {number} most
 * @returns {Bytes}
 */
function longer(bytes, least, most) {
  const copy = new Uint8Array(Math.min(most, Math.max(least, 2 * bytes.length)));
  copy.set(bytes);
  return copy;
}

/**
 * Return the size in a header.
 *
 * @param {Bytes} bytes
 * @returns {number | null} null without a valid header, which its reader reports
 */
function statedSize(bytes) {
  try {
    return bytes.length < HEADER_SIZE ? null : readFileHeader(bytes).fileSize;
  } catch {
    return null;
  }
}
