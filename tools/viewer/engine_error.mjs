// What the engine rejects with.

/** @typedef {import('./types.d.ts').ErrorReport} ErrorReport */

/** There is no WebGL 2. */
export const E_WEBGL2 = 'E_WEBGL2';
/** The browser has taken the GPU away; the engine goes on by itself when it is given back. */
export const E_CONTEXT = 'E_CONTEXT';
/** Another scene was opened, or the engine closed, before everything was decoded. */
export const E_REPLACED = 'E_REPLACED';
/** The worker did not start, or broke. */
export const E_WORKER = 'E_WORKER';
/** The file cannot be read; as the format's. */
export const E_INPUT = 'E_INPUT';
/** More splats than the GPU has room for; as the format's. */
export const E_LIMIT = 'E_LIMIT';

/** An error of the engine (see above) or of the file, with the format's code, byte and clause. */
export class EngineError extends Error {
  /** @param {Omit<ErrorReport, 'fatal'>} report */
  constructor({ code, message, offset, clause }) {
    super(message);
    this.name = 'EngineError';
    this.code = code;
    this.offset = offset;
    this.clause = clause;
  }

  /** @returns {ErrorReport} */
  report() {
    const { code, message, offset, clause } = this;
    return {
      code,
      message,
      ...(offset !== undefined && { offset }),
      ...(clause !== undefined && { clause }),
      fatal: true,
    };
  }
}
