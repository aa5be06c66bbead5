// SPDX-License-Identifier: Apache-2.0
// The table of answers: what is done with each answer of an HTTP server to a request for a file, or for a part of it.
//
//   status  headers                            verdict
//   200                                        whole: the file from its beginning, coded or not
//   206     Content-Encoding                   plain: parts of coded bytes are useless, request the file without Range
//   206     none, or hidden across origins     part: as requested, until the body ends
//   206     Content-Range, fewer bytes         part: the caller requests the rest
//   206     Content-Range, another size        error: the file was replaced
//   206     Content-Range elsewhere, multipart error: the server's
//   206     without Range in the request       whole if it begins at 0, else error: the server's
//   416     bytes */N, N inside the range      within: request the bytes up to N
//   416     bytes */N, N before the range      end: nothing is left
//   416     bytes */N behind the range, none   plain; end if the range begins later and N is unknown
//   416     bytes */N, another size            error: the file was replaced
//   408, 425, 429, 5xx but 501 and 505         error: busy, transient, after Retry-After
//   0 (opaque), all others                     error: refused if 4xx, else the server's

import { InputError } from './errors.mjs';

/**
 * @typedef {import('./decoder.d.ts').FetchReason} FetchReason
 * @typedef {{start: number, end: number}} Asked requested bytes; `end` may be Infinity
 * @typedef {{take: 'whole' | 'plain' | 'within' | 'end', total: number | null}
 *   | {take: 'part', end: number | null, total: number | null}} Verdict `end`: of the announced bytes, null if unknown;
 *   `total`: size of the file as the server reports it
 */

const BUSY = new Set([408, 425, 429]); // HTTP statuses below 500 after which the same request may succeed
const NEVER = new Set([501, 505]); // those from 500 on after which it will not

/**
 * Decide what to do with an answer.
 *
 * @param {Pick<Response, 'status' | 'type' | 'headers'>} response
 * @param {Asked | null} asked null for a request without Range
 * @param {{url: string, size: number | null}} file `size` as far as known
 * @returns {Verdict}
 * @throws {InputError}
 */
export function judge({ status, type, headers }, asked, { url, size }) {
  const fail = (/** @type {string} */ detail, /** @type {FetchReason} */ reason = 'server') => {
    throw new InputError(`${url}: ${detail}`, { reason, status });
  };
  if (status === 0 || type === 'opaque' || type === 'opaqueredirect') {
    fail('the browser hides the answer of the server, because of the mode or redirect of `request`');
  }
  if (status === 200) return { take: 'whole', total: null };
  // The range and size of a coded body count other bytes than those of the file.
  if (status === 206 && asked !== null && isCoded(headers)) return { take: 'plain', total: null };
  const range = headers.get('content-range');
  const place = rangeOf(range);
  if ((status === 206 || status === 416) && place && size !== null && place.total !== null && place.total !== size) {
    throw replaced(url, `it has ${place.total} bytes instead of ${size}`);
  }
  if (status === 206) {
    const media = headers.get('content-type') ?? '';
    if (/^multipart\/byteranges/i.test(media)) fail('the server answers one range with multipart/byteranges');
    if (range !== null && place?.end === undefined) fail(`the server sent the invalid Content-Range “${range}”`);
    if (asked === null) {
      if (!place || place.start !== 0) fail('the server answers a request without Range with status 206');
      return { take: 'whole', total: place?.total ?? null };
    }
    if (place && place.start !== asked.start) {
      fail(`the server sent bytes from ${place.start} on (Content-Range “${range}”) instead of from ${asked.start} on`);
    }
    const length = headers.get('content-length');
    const end = place?.end ?? (length === null ? null : asked.start + Number(length));
    return { take: 'part', end: end === null ? null : Math.min(end, asked.end), total: place?.total ?? null };
  }
  if (status === 416 && asked !== null) {
    const total = place?.total ?? null;
    if (total === null) return { take: asked.start === 0 ? 'plain' : 'end', total };
    if (total <= asked.start) return { take: 'end', total };
    return { take: asked.end > total ? 'within' : 'plain', total };
  }
  throw statusError(url, status, headers);
}

/**
 * Parse Content-Range.
 *
 * @param {string | null} text
 * @returns {{start: number, end?: number, total: number | null} | null} `end` is absent in an answer without bytes; null if
 *   the text is invalid
 */
function rangeOf(text) {
  const match = /^\s*bytes[\s=]+(?:(\d+)-(\d+)|\*)\/(\d+|\*)\s*$/i.exec(text ?? '');
  if (!match) return null;
  const total = match[3] === '*' ? null : Number(match[3]);
  if (match[1] === undefined) return { start: 0, total };
  const [start, end] = [Number(match[1]), Number(match[2]) + 1];
  return end <= start || (total !== null && end > total) ? null : { start, end, total };
}

/** @param {Headers} headers */
export function isCoded(headers) {
  const coding = headers.get('content-encoding');
  return coding !== null && !/^\s*(identity)?\s*$/i.test(coding);
}

/**
 * @param {string} url
 * @param {number} status
 * @param {Headers} headers
 */
function statusError(url, status, headers) {
  const isTransient = BUSY.has(status) || (status >= 500 && !NEVER.has(status));
  const reason = isTransient ? 'busy' : status >= 400 && status < 500 ? 'refused' : 'server';
  const retryAfterMs = isTransient ? retryAfter(headers.get('retry-after')) : 0;
  return new InputError(`${url}: HTTP status ${status}`, { reason, status, isTransient, retryAfterMs });
}

/**
 * Parse Retry-After.
 *
 * @param {string | null} text seconds, or a date
 * @param {number} [now] milliseconds
 * @returns {number} milliseconds from now; 0 for none, the past or nonsense
 */
export function retryAfter(text, now = Date.now()) {
  if (text === null) return 0;
  if (/^\s*\d+(\.\d*)?\s*$/.test(text)) return 1000 * Number(text);
  if (!/[a-z]/i.test(text)) return 0; // Date.parse takes numbers for years
  const ms = Date.parse(text) - now;
  return ms > 0 ? ms : 0;
}

/**
 * Tell whether two answers are of different versions of a file, by the validators that both have. Weak comparison: a proxy
 * may weaken an ETag.
 *
 * @param {Headers} one
 * @param {Headers} other
 */
export function differ(one, other) {
  for (const name of ['etag', 'last-modified']) {
    const [a, b] = [one.get(name), other.get(name)].map((tag) => tag?.trim().replace(/^W\//, ''));
    if (a && b) return a !== b;
  }
  return false;
}

/**
 * @param {string} url
 * @param {string} detail
 * @param {unknown} [cause]
 */
export const replaced = (url, detail, cause) =>
  new InputError(`${url}: the file was replaced on the server while it was read: ${detail}`, {
    ...{ cause, reason: 'replaced' },
  });
