// Sources of a file that is not in memory: HTTP with Range, or one of those in `whole_sources.mjs`.

import { InputError } from './errors.mjs';
import {
  BlobSource,
  CallerSource,
  MemorySource,
  WholeSource,
  asInputError,
  bodyParts,
  shortData,
} from './whole_sources.mjs';

const GAP_BYTES = 1 << 14; // bytes; ranges separated by less are fetched together
const REQUEST_BYTES = 1 << 23; // bytes; joined ranges do not exceed this
const TRANSIENT = new Set([408, 429]); // HTTP statuses below 500 after which the same request may succeed

/**
 * @typedef {import('./decoder.d.ts').ByteSource} ByteSource
 * @typedef {import('./decoder.d.ts').ByteRange} ByteRange
 * @typedef {Uint8Array<ArrayBuffer>} Bytes
 * @typedef {(received: number) => void} Received called with the number of bytes of each part that arrives
 * @typedef {{fetch: typeof fetch, init: RequestInit, firstBytes: number, received: Received, limit: number}} Way
 */

/**
 * @param {string | URL | Blob | ArrayBuffer | ByteSource} from
 * @param {Way} way request options
 * @returns {Promise<ByteSource>}
 */
export async function openSource(from, way) {
  if (typeof from === 'string' || from instanceof URL) return openUrl(from, way);
  if (from instanceof Blob) return new BlobSource(from);
  if (from instanceof ArrayBuffer) return new MemorySource(new Uint8Array(from));
  if (typeof from?.read === 'function') return new CallerSource(from);
  throw new InputError('the source is not a URL, a Blob, an ArrayBuffer or an object with a method read');
}

/**
 * Open a URL with one request for the first bytes. If the server ignores the range and sends the whole file, the body is
 * read as it arrives.
 *
 * @param {string | URL} url
 * @param {Way} way
 * @returns {Promise<HttpSource | WholeSource>}
 */
async function openUrl(url, way) {
  const response = await request(url, 0, way.firstBytes, way);
  if (response.status === 416) return new HttpSource(url, new Uint8Array(0), 0, way, null); // an empty file
  if (response.status === 200) return WholeSource.open(response, way);
  const { total } = checkRange(response, 0);
  return new HttpSource(
    url,
    await readBody(response, way.firstBytes, way.received),
    total,
    way,
    response.headers.get('etag'),
  );
}

/**
 * @param {string | URL} url
 * @param {number} start
 * @param {number} end
 * @param {Way} way
 * @param {AbortSignal} [signal]
 */
async function request(url, start, end, way, signal) {
  /** @type {Response} */
  let response;
  const headers = new Headers(way.init.headers);
  headers.set('Range', `bytes=${start}-${end - 1}`);
  try {
    response = await way.fetch(url, { ...way.init, headers, signal: signal ?? way.init.signal });
  } catch (error) {
    throw asInputError(error, url);
  }
  if (response.status !== 200 && response.status !== 206 && response.status !== 416) {
    await response.body?.cancel();
    const isTransient = TRANSIENT.has(response.status) || response.status >= 500;
    throw new InputError(`${url}: HTTP status ${response.status}`, undefined, isTransient);
  }
  return response;
}

/**
 * @param {Response} response with status 206
 * @param {number} start
 * @returns {{total: number | null}} size of the file if the server reports it (it may be hidden across origins)
 */
function checkRange(response, start) {
  const range = response.headers.get('content-range');
  if (range === null) return { total: null };
  const match = /^bytes (\d+)-\d+\/(\d+|\*)$/.exec(range);
  if (!match || Number(match[1]) !== start)
    throw new InputError(`the server sent the range ${range} instead of one from ${start}`);
  return { total: match[2] === '*' ? null : Number(match[2]) };
}

/**
 * @param {Response} response
 * @param {number} most maximum number of bytes to read
 * @param {Received} received
 * @returns {Promise<Bytes>}
 */
async function readBody(response, most, received) {
  const bytes = new Uint8Array(most);
  let filled = 0;
  for await (const part of bodyParts(response)) {
    const taken = part.subarray(0, most - filled);
    bytes.set(taken, filled);
    filled += taken.length;
    received(taken.length);
    if (filled === most) break;
  }
  return bytes.subarray(0, filled);
}

/** A server that supports ranges. */
export class HttpSource {
  /**
   * @param {string | URL} url
   * @param {Bytes} head the first bytes
   * @param {number | null} size size of the file, if known
   * @param {Way} way
   * @param {string | null} etag
   */
  constructor(url, head, size, way, etag) {
    this.url = url;
    this.head = head;
    this.size = size;
    this.way = way;
    this.etag = etag;
    /** @type {{start: number, end: number, bytes: Promise<Bytes>, due: number}[]} */
    this.fetched = []; // prefetched ranges, each kept until all its parts have been read
    /** @type {WholeSource | null} */
    this.whole = null;
  }

  /** Whether later bytes arrive later: the server has sent the whole file. */
  get isSequential() {
    return this.whole !== null;
  }

  /**
   * @param {number} offset
   * @param {number} size
   * @param {AbortSignal} [signal]
   * @returns {Promise<Bytes>}
   */
  async read(offset, size, signal) {
    const end = offset + size;
    if (this.whole) return this.whole.read(offset, size);
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
    const bytes = await range.bytes;
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
      const entry = { ...range, bytes: this.fetch(range.start, range.end, signal) };
      const drop = () => (this.fetched = this.fetched.filter((one) => one !== entry)); // allows another try
      entry.bytes.catch(drop);
      signal?.addEventListener('abort', drop, { once: true });
      this.fetched.push(entry);
    }
  }

  /**
   * @param {number} start
   * @param {number} end
   * @param {AbortSignal} [signal]
   * @returns {Promise<Bytes>}
   */
  async fetch(start, end, signal) {
    const response = await request(this.url, start, end, this.way, signal);
    if (response.status === 416) throw shortData(start, end - start);
    if (response.status === 200) {
      this.whole = await WholeSource.open(response, this.way);
      return this.whole.read(start, end - start);
    }
    checkRange(response, start);
    const etag = response.headers.get('etag');
    if (etag !== null && this.etag !== null && etag !== this.etag) {
      throw new InputError(`${this.url} has changed since it was opened`);
    }
    const bytes = await readBody(response, end - start, this.way.received);
    if (bytes.length < end - start) throw shortData(start + bytes.length, end - start);
    return bytes;
  }
}
