// SPDX-License-Identifier: Apache-2.0
// Errors of the engine.

/** @typedef {import('./types.d.ts').ErrorReport} ErrorReport */

/** WebGL 2 is not available. */
export const E_WEBGL2 = 'E_WEBGL2';
/** The browser has lost the GPU; the engine continues by itself when it is restored. */
export const E_CONTEXT = 'E_CONTEXT';
/** Another scene was opened, or the engine closed, before everything was decoded. */
export const E_SUPERSEDED = 'E_SUPERSEDED';
/** The worker did not start, or failed. */
export const E_WORKER = 'E_WORKER';
/** The file cannot be read; the same code as the format's. */
export const E_INPUT = 'E_INPUT';
/** More splats than fit on the GPU; the same code as the format's. */
export const E_LIMIT = 'E_LIMIT';

/** An error of the engine (see above) or of the file, with the format's code, offset and clause. */
export class EngineError extends Error {
  /** @param {Omit<ErrorReport, 'fatal'>} report */
  constructor({ code, message, offset, clause, reason, status }) {
    super(message);
    this.name = 'EngineError';
    this.code = code;
    this.offset = offset;
    this.clause = clause;
    this.reason = reason;
    this.status = status;
  }

  /** @returns {ErrorReport} */
  report() {
    const { code, message, offset, clause, reason, status } = this;
    return {
      code,
      message,
      ...(offset !== undefined && { offset }),
      ...(clause !== undefined && { clause }),
      ...(reason !== undefined && { reason }),
      ...(status !== undefined && { status }),
      fatal: true,
    };
  }
}
