// SPDX-License-Identifier: Apache-2.0
// Raw DEFLATE (RFC 1951) with the platform's implementation. This module ensures COD-2 and COD-4: the stream ends within
// the last byte and gives exactly the declared size, and no more output than that is ever produced. zlib, and thus every
// platform, checks COD-5 to COD-8.

import { InputError, UnsupportedError } from './errors.mjs';
import { ERROR_UNSUPPORTED } from './spec.mjs';

/** @typedef {(coded: Uint8Array<ArrayBuffer>, size: number) => Uint8Array | Promise<Uint8Array>} Inflate */

const CHUNK_BYTES = 1 << 20; // maximum output of one step of zlib
const FEED_BYTES = 1 << 14; // input of one step of a DecompressionStream, which inflates to at most 16 MiB

const MESSAGE_MAX = 200; // characters of an error of the platform or of the caller

/** The clause of each zlib error, by the last word of its message; COD-2 otherwise. Browsers use the same words. */
const CLAUSES = new Map([
  ['symbols', 'COD-5'], // too many length or distance symbols
  ['set', 'COD-6'], // invalid code lengths set, invalid literal/lengths set, invalid distances set
  ['repeat', 'COD-7'], // invalid bit length repeat
  ['end-of-block', 'COD-7'], // invalid code -- missing end-of-block
  ['code', 'COD-8'], // invalid literal/length code, invalid distance code
  ['back', 'COD-8'], // invalid distance too far back
]);

/** Coded bytes that are not a valid stream. The caller knows their offset in the file. */
export class InflateError extends Error {
  /**
   * @param {string} message
   * @param {number} [at] offset in the coded bytes
   * @param {string} [clause]
   */
  constructor(message, at = 0, clause = 'COD-2') {
    super(message);
    this.at = at;
    this.clause = clause;
  }
}

/** @param {unknown} error error from the platform, or whatever a caller's inflate throws */
function refused(error) {
  if (error instanceof InflateError) return error;
  const { message } = /** @type {{message?: unknown}} */ (error ?? {});
  const text = typeof message === 'string' ? message : typeof error === 'string' ? error : `it threw ${typeof error}`;
  const [last] = /[\w-]*(?=\W*$)/.exec(text) ?? [''];
  const refusal = new InflateError(text.replace(/\s+/g, ' ').slice(0, MESSAGE_MAX), 0, CLAUSES.get(last));
  refusal.cause = error;
  return refusal;
}

/**
 * Wrap an inflate of the caller: what it throws means a damaged stream, and what it returns is checked.
 *
 * @param {Inflate} inflate
 * @returns {Inflate}
 */
export function checkedInflate(inflate) {
  if (typeof inflate !== 'function') throw new InputError('options.inflate is not a function');
  return async (coded, size) => {
    let bytes;
    try {
      bytes = await inflate(coded, size);
    } catch (error) {
      throw refused(error);
    }
    // Not instanceof: the caller's bytes may come from another realm, such as a frame or a test environment.
    if (Object.prototype.toString.call(bytes) !== '[object Uint8Array]')
      throw new InputError('options.inflate returned no Uint8Array');
    if (bytes.length !== size)
      throw new InputError(`options.inflate returned ${bytes.length} bytes instead of ${size}`);
    return bytes;
  };
}

/** @type {Promise<Inflate> | null} */
let chosen = null;

/**
 * Return the fastest inflate of this platform: node:zlib in Node (several times faster than its DecompressionStream),
 * otherwise DecompressionStream.
 *
 * @returns {Promise<Inflate>}
 */
export function platformInflate() {
  const { process } = /** @type {{process?: {versions?: {node?: string}}}} */ (globalThis);
  return (chosen ??= process?.versions?.node === undefined ? streamInflate() : zlibInflate());
}

/** @returns {Promise<Inflate>} */
export async function zlibInflate() {
  const name = 'node:zlib'; // hides it from bundlers for browsers
  const zlib = await import(/* webpackIgnore: true */ /* @vite-ignore */ name);
  // Some versions of zlib in Node do not report how much they read. The probe is an empty block of ten bits, and a byte.
  if (zlib.inflateRawSync(Uint8Array.of(3, 0, 0), { info: true }).engine?.bytesWritten !== 2) return streamInflate();
  return (coded, size) => {
    let result;
    try {
      const chunkSize = Math.max(64, Math.min(size + 1, CHUNK_BYTES));
      result = zlib.inflateRawSync(coded, { info: true, maxOutputLength: size, chunkSize });
    } catch (error) {
      throw refused(error);
    }
    const { buffer, engine } = result;
    if (buffer.length !== size) throw new InflateError(`inflated to ${buffer.length} bytes instead of ${size}`);
    const used = engine.bytesWritten; // bytes of input that zlib consumed
    if (used !== coded.length) throw new InflateError(`${coded.length - used} bytes follow the final block`, used);
    return buffer;
  };
}

/** @returns {Promise<Inflate>} */
export async function streamInflate() {
  try {
    new DecompressionStream('deflate-raw');
  } catch (cause) {
    throw new UnsupportedError(ERROR_UNSUPPORTED, "this platform has no DecompressionStream('deflate-raw')", { cause });
  }
  // The standard requires an error for bytes after the end; Node 20 reports none. The probe is an empty block and a byte.
  const probe = Uint8Array.of(1, 0, 0, 255, 255, 0);
  const strict = await drain(probe, 0).then(
    () => false,
    () => true,
  );
  return async (coded, size) => {
    const bytes = await drain(coded, size);
    // A stream that ends within its last byte is incomplete without that byte.
    const early =
      !strict &&
      coded.length > 1 &&
      (await drain(coded.subarray(0, -1), size).then(
        () => true,
        () => false,
      ));
    if (early) throw new InflateError('bytes follow the final block');
    return bytes;
  };
}

/**
 * @param {Uint8Array<ArrayBuffer>} coded
 * @param {number} size
 */
async function drain(coded, size) {
  const stream = new DecompressionStream('deflate-raw');
  const feeding = feed(stream.writable.getWriter(), coded);
  feeding.catch(() => {}); // the reader gets the same error
  const reader = stream.readable.getReader();
  const bytes = new Uint8Array(size);
  let filled = 0;
  try {
    for (let part = await reader.read(); !part.done; part = await reader.read()) {
      if (part.value.length > size - filled) throw new InflateError(`inflates to more than ${size} bytes`);
      bytes.set(part.value, filled);
      filled += part.value.length;
    }
    await feeding;
  } catch (error) {
    reader.cancel().catch(() => {});
    throw error instanceof InflateError ? error : refused(error);
  }
  if (filled !== size) throw new InflateError(`inflated to ${filled} bytes instead of ${size}`);
  return bytes;
}

/**
 * @param {WritableStreamDefaultWriter<BufferSource>} writer
 * @param {Uint8Array<ArrayBuffer>} coded
 */
async function feed(writer, coded) {
  for (let at = 0; at < coded.length; at += FEED_BYTES) {
    await writer.ready;
    await writer.write(coded.subarray(at, at + FEED_BYTES));
  }
  await writer.close();
}
