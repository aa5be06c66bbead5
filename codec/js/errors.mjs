// SPDX-License-Identifier: Apache-2.0
// The errors of a decoder (spec section 12, error codes). Invalid bytes cause no other errors in this package.

import { ERROR_INPUT, ERROR_LIMIT, ERROR_UNSUPPORTED } from './spec.mjs';

/** @typedef {import('./decoder.d.ts').ErrorCode} ErrorCode */

/**
 * Base of all errors of this package.
 *
 * `code` is one of the codes of the spec, `offset` the position of the error in the file and `clause` the id of the
 * violated requirement. Both are null if they do not apply.
 */
export class CsplatError extends Error {
  /**
   * @param {ErrorCode} code
   * @param {string} detail what was found and what was expected
   * @param {{offset?: number | null, clause?: string | null, cause?: unknown}} [place]
   */
  constructor(code, detail, { offset = null, clause = null, cause } = {}) {
    const where = (offset === null ? '' : ` at byte ${offset}`) + (clause === null ? '' : ` (${clause})`);
    super(`${code}${where}: ${detail}`, cause === undefined ? undefined : { cause });
    this.name = new.target.name;
    this.code = code;
    this.offset = offset;
    this.clause = clause;
  }
}

/** The bytes violate a requirement of the format. */
export class FormatError extends CsplatError {}

/** The file requires something that this decoder or this platform does not support. */
export class UnsupportedError extends CsplatError {}

/** The file exceeds the caller's budget. */
export class LimitError extends CsplatError {}

/**
 * The caller's arguments are invalid, or the file cannot be fetched.
 *
 * `reason` is null for arguments and otherwise names what failed, see decoder.d.ts; `status` is the HTTP status, if it did.
 */
export class InputError extends CsplatError {
  /**
   * @param {string} detail
   * @param {{cause?: unknown, reason?: import('./decoder.d.ts').FetchReason | null, status?: number | null,
   *   isTransient?: boolean, retryAfterMs?: number}} [facts] `isTransient`: the same request may succeed later;
   *   `retryAfterMs`: the wait that the server requests
   */
  constructor(detail, { cause, reason = null, status = null, isTransient = false, retryAfterMs = 0 } = {}) {
    super(ERROR_INPUT, detail, { cause });
    this.reason = reason;
    this.status = status;
    this.isTransient = isTransient;
    this.retryAfterMs = retryAfterMs;
  }

  /** Whether the server has another file at this address than at first. */
  get isReplaced() {
    return this.reason === 'replaced';
  }
}

/**
 * Return the error for a file, of the class that belongs to its code.
 *
 * @param {ErrorCode} code
 * @param {number} offset offset in the file
 * @param {string} clause id of the requirement
 * @param {string} detail
 * @param {unknown} [cause]
 * @returns {CsplatError}
 */
export function fault(code, offset, clause, detail, cause) {
  const place = { offset, clause, cause };
  if (code === ERROR_UNSUPPORTED) return new UnsupportedError(code, detail, place);
  if (code === ERROR_LIMIT) return new LimitError(code, detail, place);
  return new FormatError(code, detail, place);
}

/**
 * Call `make`, which allocates. If the platform cannot allocate, throw a LimitError.
 *
 * @template T
 * @param {() => T} make
 * @returns {T}
 */
export function allocate(make) {
  try {
    return make();
  } catch (error) {
    throw new LimitError(ERROR_LIMIT, 'the platform cannot hold arrays of this size', { cause: error });
  }
}
