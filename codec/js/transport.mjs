// SPDX-License-Identifier: Apache-2.0
// Requests for one file over HTTP: the only place that fetches, retries, times out and asks for a new address.

import { differ, isCoded, judge } from './answers.mjs';
import { CsplatError, InputError } from './errors.mjs';
import { toBytes } from './options.mjs';

const RETRIES = 4; // in a row; with the waits below, 7.5 s until the error
const RETRY_MS = 500; // until the first retry; doubled each time
const RETRY_MS_MAX = 30_000; // also of Retry-After: who waits longer has left
const TIMEOUT_MS = 8_000; // without a byte; phones that change networks stall, slow servers need seconds to begin
const GRACE_MS = 100; // from the end of that time until the request is given up
const TIMER_MS_MAX = 2 ** 31 - 1; // of setTimeout
const PROBE_FAILURES = 2; // in a row without an answer, until a request is made without Range
const PROGRESS_BYTES = 1024; // bytes between two failures after which they are not in a row

/**
 * @typedef {import('./answers.mjs').Asked} Asked
 * @typedef {import('./answers.mjs').Verdict} Verdict
 * @typedef {import('./decoder.d.ts').ReaderOptions} ReaderOptions
 * @typedef {Verdict & {body: Body}} Answer
 *
 * How to fetch: the options of a reader with their defaults.
 *
 * @typedef {object} Way
 * @property {typeof fetch} fetch
 * @property {boolean} hasFetch whether it is the caller's
 * @property {boolean} isWhole whether the whole file will be read: it is requested without Range
 * @property {boolean} [isOnce] whether `fetch` has one answer, which ends where the file does
 * @property {RequestInit} init
 * @property {(AbortSignal | null | undefined)[]} signals each ends everything
 * @property {number} firstBytes
 * @property {number} limit bytes of a file that has to be kept whole
 * @property {(received: number) => void} received called with the number of bytes of each part that arrives, once for each byte
 * @property {number} retries
 * @property {number} retryMs
 * @property {number} timeoutMs
 * @property {ReaderOptions['renew']} [renew]
 * @property {ReaderOptions['onRetry']} [onRetry]
 * @property {typeof pause} pause
 */

/**
 * @param {ReaderOptions} options
 * @param {Pick<Way, 'firstBytes' | 'isWhole' | 'limit' | 'received'>} sizes
 * @returns {Way}
 */
export function wayOf(options, sizes) {
  const { signal, ...init } = options.request ?? {};
  return {
    fetch: options.fetch ?? ((...request) => globalThis.fetch(...request)),
    hasFetch: options.fetch !== undefined,
    init,
    signals: [options.signal, signal],
    retries: checked('retries', options.retries, RETRIES),
    retryMs: checked('retryMs', options.retryMs, RETRY_MS),
    timeoutMs: checked('timeoutMs', options.timeoutMs, TIMEOUT_MS),
    renew: options.renew,
    onRetry: options.onRetry,
    pause,
    ...sizes,
  };
}

/**
 * @param {string} name
 * @param {unknown} value
 * @param {number} usual
 */
function checked(name, value, usual) {
  if (value === undefined) return usual;
  if (typeof value !== 'number' || !(value >= 0)) throw new InputError(`${name} is ${value}, expected 0 or more`);
  return value;
}

/**
 * Wait, but no longer than until the signal aborts, or the browser is online again.
 *
 * @param {number} ms
 * @param {AbortSignal} signal
 * @param {boolean} wakes whether being online again ends the wait
 * @returns {Promise<void>}
 */
export function pause(ms, signal, wakes) {
  return new Promise((resolve) => {
    const over = new AbortController();
    const done = () => {
      clearTimeout(timer);
      over.abort();
      resolve();
    };
    const timer = setTimeout(done, Math.min(ms, TIMER_MS_MAX));
    if (signal.aborted) return done();
    signal.addEventListener('abort', done, { signal: over.signal });
    if (wakes) globalThis.addEventListener?.('online', done, { signal: over.signal });
  });
}

/** What to do when a signal aborts. @type {WeakMap<AbortSignal, Set<() => void>>} */
const aborted = new WeakMap();

/**
 * Call a function when a signal aborts. One listener serves all: Node warns of a leak if there are more than ten.
 *
 * @param {AbortSignal} signal
 * @param {() => void} work
 * @returns {() => void} takes it back
 */
export function onAbort(signal, work) {
  let all = aborted.get(signal);
  if (all === undefined) {
    all = new Set();
    aborted.set(signal, all);
    const each = all;
    signal.addEventListener('abort', () => each.forEach((one) => one()), { once: true });
  }
  all.add(work);
  return () => all.delete(work);
}

/**
 * Reject as soon as a signal aborts, with its reason, whatever the work does.
 *
 * @template T
 * @param {Promise<T>} work
 * @param {AbortSignal} [signal]
 * @returns {Promise<T>}
 */
export function abortable(work, signal) {
  if (!signal) return work;
  return new Promise((resolve, reject) => {
    const abort = () => reject(signal.reason);
    if (signal.aborted) abort();
    const forget = onAbort(signal, abort);
    work.then(resolve, reject).finally(forget);
  });
}

/** A signal that aborts with any of others, or by itself if nothing has arrived for some time. */
class Attempt {
  /**
   * @param {(AbortSignal | null | undefined)[]} signals
   * @param {number} [timeoutMs]
   * @param {() => void} [stalled]
   */
  constructor(signals, timeoutMs = Infinity, stalled = () => {}) {
    this.controller = new AbortController();
    this.signal = this.controller.signal;
    /** @type {(() => void)[]} */
    this.links = [];
    this.timeoutMs = timeoutMs;
    this.stalled = stalled;
    /** @type {ReturnType<typeof setTimeout> | undefined} */
    this.timer = undefined;
    this.link(signals);
  }

  /** @param {(AbortSignal | null | undefined)[]} signals in place of earlier ones */
  link(signals) {
    for (const unlink of this.links) unlink();
    this.links = signals.flatMap((signal) => {
      if (!signal) return [];
      if (signal.aborted) this.controller.abort(signal.reason);
      return [onAbort(signal, () => this.controller.abort(signal.reason))];
    });
  }

  /**
   * Wait for something that the network does.
   *
   * @template T
   * @param {Promise<T>} work
   */
  async during(work) {
    const late = () => {
      // If this thread was busy, what has arrived is still to be delivered.
      this.timer = setTimeout(() => this.#stall(), Math.min(this.timeoutMs, GRACE_MS));
    };
    if (this.timeoutMs <= TIMER_MS_MAX) this.timer = setTimeout(late, this.timeoutMs);
    try {
      return await abortable(work, this.signal);
    } finally {
      clearTimeout(this.timer);
    }
  }

  #stall() {
    this.stalled();
    const seconds = this.timeoutMs / 1000;
    this.controller.abort(
      new InputError(`nothing arrived for ${seconds} s`, { reason: 'connection', isTransient: true }),
    );
  }

  end() {
    clearTimeout(this.timer);
    this.link([]);
  }
}

/** The body of an answer. */
class Body {
  /**
   * @param {Response} response
   * @param {Attempt} attempt
   * @param {(AbortSignal | null | undefined)[]} lifetime signals that end the whole source
   */
  constructor(response, attempt, lifetime) {
    this.response = response;
    this.attempt = attempt;
    this.lifetime = lifetime;
    /** Size as announced; null if unknown, or of coded bytes. */
    this.size = isCoded(response.headers) ? null : numberOf(response.headers.get('content-length'));
  }

  /**
   * Yield the parts as they arrive; the rest is cancelled if the loop is left early.
   *
   * @returns {AsyncGenerator<Uint8Array, void>}
   */
  async *parts() {
    const { response, attempt } = this;
    const reader = response.body?.getReader();
    try {
      while (reader) {
        const { value, done } = await attempt.during(reader.read());
        if (done) break;
        yield toBytes(value); // a caller's stream may have other parts
      }
    } finally {
      reader?.cancel().catch(() => {});
      attempt.end();
    }
  }

  /** Be independent of the caller that has made the request. */
  detach() {
    this.attempt.link(this.lifetime);
  }

  drop() {
    this.response.body?.cancel().catch(() => {});
    this.attempt.end();
  }
}

/** @param {string | null} text */
const numberOf = (text) => (text === null ? null : Number(text));

/** Counts bytes that have arrived, each once. */
export class Arrivals {
  /** @param {Way['received']} received */
  constructor(received) {
    this.received = received;
    /** @type {[number, number][]} */
    this.ranges = [];
  }

  /**
   * @param {number} start
   * @param {number} end
   */
  count(start, end) {
    let fresh = end - start;
    let [low, high] = [start, end];
    this.ranges = this.ranges.filter(([from, to]) => {
      if (to < start || from > end) return true;
      fresh -= Math.max(0, Math.min(to, end) - Math.max(from, start));
      [low, high] = [Math.min(low, from), Math.max(high, to)];
      return false;
    });
    this.ranges.push([low, high]);
    if (fresh > 0) this.received(fresh);
  }
}

/** A file at an address. */
export class Transport {
  /**
   * @param {string} url absolute
   * @param {Way} way
   */
  constructor(url, way) {
    this.way = way;
    /** Where and how the file is requested now. `isProven`: it was answered. */
    this.address = { url, init: way.init, isProven: false, isRenewed: false };
    /** @type {Promise<void> | null} */
    this.renewing = null;
    /** Ends all requests. */
    this.closing = new AbortController();
    this.lifetime = [this.closing.signal, ...way.signals];
    /** Size of the file as the server reports it, and as its header does. @type {number | null} */
    this.total = null;
    /** @type {number | null} */
    this.stated = null;
    /** Headers of the first answer. @type {Headers | null} */
    this.headers = null;
    /** Whether a later answer had another ETag or date. The file may still be the same, which its checksums decide. */
    this.isChanged = false;
    /** Whether the server has answered with parts, and whether it is not asked for them any more. */
    this.hasParts = false;
    this.isPlain = way.isWhole;
    this.arrivals = new Arrivals(way.received);
  }

  /** Size of the file; null if unknown. */
  get size() {
    return this.total ?? this.stated;
  }

  get url() {
    return this.address.url;
  }

  close() {
    this.closing.abort();
  }

  /**
   * @param {Response} response with bytes of the file
   * @param {Verdict} verdict
   */
  note({ headers }, { take, total }) {
    this.address.isProven = true;
    this.total ??= total;
    if (take !== 'whole' && take !== 'part') return;
    if (take === 'part') this.hasParts = true;
    this.headers ??= headers;
    if (differ(this.headers, headers)) this.isChanged = true;
  }

  /**
   * Ask the caller's hook for another address, once for all requests that wait for it.
   *
   * @param {Transport['address']} refusedBy the address that did not work
   * @param {InputError} error
   * @returns {Promise<void>} throws the error if there is no other address
   */
  async renew(refusedBy, error) {
    if (refusedBy !== this.address) return; // another request has asked
    const { renew } = this.way;
    if (!renew || (refusedBy.isRenewed && !refusedBy.isProven)) throw error;
    this.renewing ??= (async () => {
      const { url, init } = refusedBy;
      /** @type {Awaited<ReturnType<NonNullable<Way['renew']>>>} */
      let given;
      try {
        given = await renew({ url, status: error.status ?? 0, message: error.message });
      } catch (cause) {
        const { status, reason } = error;
        throw new InputError(`${url}: HTTP status ${status}, and \`renew\` failed: ${cause}`, {
          cause,
          status,
          reason,
        });
      }
      if (!given) throw error;
      const isAddress = typeof given === 'string' || given instanceof URL;
      const { url: to = url, ...other } = isAddress ? { url: given } : requestFields(given);
      const next = URL.canParse?.(to, url) === false ? String(to) : new URL(to, url).href;
      this.address = { url: next, init: { ...init, ...other }, isProven: false, isRenewed: true };
    })().finally(() => (this.renewing = null));
    return this.renewing;
  }

  /** @param {AbortSignal} [signal] of the caller */
  tries(signal) {
    return new Tries(this, signal);
  }
}

/** @param {any} given a Request, or an object with `url` and fields of a RequestInit */
function requestFields(given) {
  if (typeof Request !== 'function' || !(given instanceof Request)) return given;
  const { url, headers, credentials, mode, cache, redirect, referrer, referrerPolicy } = given;
  return { url, headers, credentials, mode, cache, redirect, referrer, referrerPolicy };
}

/**
 * Do work that is not a request; any of the signals ends it.
 *
 * @template T
 * @param {(AbortSignal | null | undefined)[]} signals
 * @param {(signal: AbortSignal) => Promise<T>} work
 * @returns {Promise<T>}
 */
export async function unlessAborted(signals, work) {
  const attempt = new Attempt(signals);
  try {
    attempt.signal.throwIfAborted();
    return await abortable(work(attempt.signal), attempt.signal);
  } finally {
    attempt.end();
  }
}

/** Requests for one purpose, and their failures. */
class Tries {
  /**
   * @param {Transport} transport
   * @param {AbortSignal} [signal]
   */
  constructor(transport, signal) {
    this.transport = transport;
    this.signals = [...transport.lifetime, signal];
    this.failures = 0; // in a row
    this.stalls = 0; // each doubles the patience: some servers need long to begin
    this.unanswered = 0; // requests with Range in a row that failed without an answer
    this.hasProbed = false;
  }

  /**
   * Request bytes, once.
   *
   * @param {Asked | null} asked null for the whole file, without Range
   * @param {RequestInit} [extra]
   * @returns {Promise<Answer>}
   */
  async ask(asked, extra = {}) {
    const { transport } = this;
    // Chromium fails without an answer if one to a request with Range is coded. Without Range it decodes.
    const isProbe = asked !== null && this.unanswered >= PROBE_FAILURES + Number(transport.hasParts);
    const { response, address, attempt } = await this.#send(isProbe ? null : asked, extra);
    const body = new Body(response, attempt, transport.lifetime);
    try {
      const verdict = judge(response, isProbe ? null : asked, transport);
      transport.note(response, verdict);
      if (isProbe && !isCoded(response.headers) && !this.hasProbed) {
        // The coding may be hidden across origins, or the connection was lost. If Range fails once more, it is the coding.
        this.hasProbed = true;
        this.unanswered--;
        body.drop();
        return this.ask(asked, extra);
      }
      if (isProbe) transport.isPlain = true;
      else this.unanswered = 0;
      if (verdict.take !== 'whole' && verdict.take !== 'part') body.drop();
      return { ...verdict, body };
    } catch (error) {
      body.drop();
      if (!(error instanceof InputError && error.reason === 'refused')) throw error;
      await unlessAborted(this.signals, () => transport.renew(address, error));
      return this.ask(asked, extra);
    }
  }

  /**
   * @param {Asked | null} asked
   * @param {RequestInit} extra
   */
  async #send(asked, extra) {
    const { transport } = this;
    const { address, way } = transport;
    let hasStalled = false;
    const attempt = new Attempt(this.signals, way.timeoutMs * 2 ** this.stalls, () => {
      hasStalled = true;
      this.stalls++;
    });
    const headers = new Headers(address.init.headers);
    if (asked) headers.set('Range', `bytes=${asked.start}-${asked.end === Infinity ? '' : asked.end - 1}`);
    const init = { ...address.init, ...extra, headers, signal: attempt.signal };
    try {
      attempt.signal.throwIfAborted();
      const response = await attempt.during(Promise.resolve(way.fetch(address.url, init)));
      if (typeof response?.status !== 'number') throw new InputError('`fetch` returned no Response');
      return { response, address, attempt };
    } catch (error) {
      attempt.end();
      if (asked && !hasStalled && !codeOf(error)) this.unanswered++;
      throw error;
    }
  }

  /**
   * Wait until it is time to try again.
   *
   * @param {unknown} error of the last try
   * @param {number} [progress] bytes that it brought
   * @throws the error, if another try is pointless; the reason of a signal that has aborted
   */
  async again(error, progress = 0) {
    const { way, url } = this.transport;
    for (const signal of this.signals) if (signal?.aborted) throw signal.reason;
    const problem = asInputError(error, url);
    if (progress >= PROGRESS_BYTES) [this.failures, this.stalls] = [0, 0];
    if (!(problem instanceof InputError && problem.isTransient) || this.failures >= way.retries) throw problem;
    const backoff = Math.max(way.retryMs * 2 ** this.failures++, problem.retryAfterMs);
    const waitMs = Math.min(backoff, Math.max(RETRY_MS_MAX, way.retryMs));
    way.onRetry?.(problem, waitMs);
    await unlessAborted(this.signals, (one) => way.pause(waitMs, one, problem.reason === 'connection'));
  }
}

/**
 * Turn an error of the network into E_INPUT; keep those of the decoder, and aborts by others.
 *
 * @param {unknown} error
 * @param {string} url
 * @returns {unknown}
 */
export function asInputError(error, url) {
  const prefix = `${url}: `;
  if (error instanceof InputError && error.isTransient && !error.message.includes(prefix)) {
    const { reason, status, isTransient, retryAfterMs } = error;
    return new InputError(prefix + detailOf(error), { ...{ cause: error, reason, status, isTransient, retryAfterMs } });
  }
  if (error instanceof CsplatError || (error instanceof Error && error.name === 'AbortError')) return error;
  const cause = error instanceof Error ? error.cause : undefined;
  const code = codeOf(error);
  // Node names what its own checks refuse, such as an endless redirect, without the code that errors of sockets have.
  const isTransient = !(cause instanceof Error) || (code !== '' && code !== 'ERR_INVALID_URL');
  const why = cause instanceof Error ? ` (${cause.message || code})` : '';
  return new InputError(`${prefix}${error}${why}`, { cause: error, reason: 'connection', isTransient });
}

/**
 * Return the code that Node gives to errors of sockets; '' in browsers.
 *
 * @param {any} error
 * @returns {string}
 */
const codeOf = (error) => error?.cause?.code ?? '';

/** The message of an error without its code. @param {Error} error */
const detailOf = ({ message }) => message.replace(/^E_[A-Z0-9]+: /, '');
