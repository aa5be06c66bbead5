// What a decoder throws (spec section 12, error codes). Nothing else leaves this package for bytes that are at fault.

import { ERROR_INPUT, ERROR_LIMIT, ERROR_UNSUPPORTED } from './spec.mjs';

/** @typedef {import('./decoder.d.ts').ErrorCode} ErrorCode */

/**
 * Base of all errors of this package.
 *
 * `code` is one of the codes of the spec, `offset` the byte of the file that is to blame and `clause` the id of the
 * broken requirement, both null where there is none.
 */
export class CsplatError extends Error {
  /**
   * @param {ErrorCode} code
   * @param {string} detail what was found and what was wanted
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

/** The bytes break a requirement of the format. */
export class FormatError extends CsplatError {}

/** The file, or this platform, asks for something that this decoder does not have. */
export class UnsupportedError extends CsplatError {}

/** The file is beyond the caller's budget. */
export class LimitError extends CsplatError {}

/** The caller's arguments, or the way to the file, are at fault. */
export class InputError extends CsplatError {
  /**
   * @param {string} detail
   * @param {unknown} [cause]
   */
  constructor(detail, cause) {
    super(ERROR_INPUT, detail, { cause });
  }
}

/**
 * The error for a file, of the class that its code asks for.
 *
 * @param {ErrorCode} code
 * @param {number} offset byte of the file
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
 * Allocate. A platform that cannot is a budget too small.
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
