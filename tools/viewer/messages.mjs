// SPDX-License-Identifier: Apache-2.0
// Error messages for users who do not know the format.

/**
 * @typedef {{code: string, message: string, offset?: number | null, clause?: string | null, reason?: string | null,
 *   status?: number | null}} Problem
 * @typedef {{title: string, advice: string, facts: string}} Message
 */

const AGAIN = 'Reload the page, or download or copy the file again. If that does not help, it has to be created again.';
const NEWER = 'A newer version of this viewer may support it.';
const BROKEN = {
  title: 'This file is invalid.',
  advice: `It is damaged, or the program that wrote it has a bug. ${AGAIN}`,
};
const DAMAGED = { title: 'This file is damaged: some of its bytes have changed.', advice: AGAIN };

/** @type {Record<string, {title: string, advice: string}>} */
const WORDS = {
  E_MAGIC: { title: 'This is not a .csplat file.', advice: 'To convert a PLY, use the command “csplat encode”.' },
  E_VERSION: { title: 'This file was written in another version of the format.', advice: NEWER },
  E_TRUNCATED: { title: 'This file is incomplete: its end is missing.', advice: AGAIN },
  E_TRAILING: { title: 'This file has extra data after its end.', advice: AGAIN },
  E_CRC: DAMAGED,
  E_CODER: DAMAGED,
  E_RESERVED: BROKEN,
  E_VALUE: BROKEN,
  E_INDEX: BROKEN,
  E_STREAM: BROKEN,
  E_RANGE: BROKEN,
  E_CODEBOOK: BROKEN,
  E_BOX: BROKEN,
  E_JSON: BROKEN,
  E_UNSUPPORTED: { title: 'This file uses a feature that this viewer does not support.', advice: NEWER },
  E_LIMIT: { title: 'This scene is too large for this viewer.', advice: 'Use a scene with fewer splats.' },
  E_INPUT: { title: 'The file could not be read.', advice: 'Check the address and the connection, then try again.' },
  E_WEBGL2: {
    title: 'This browser cannot draw the scene: it has no WebGL 2.',
    advice: 'Use a current version of Chrome, Edge, Firefox or Safari, and check that hardware acceleration is on.',
  },
  E_CONTEXT: {
    title: 'The browser has lost access to the graphics card.',
    advice: 'If the picture does not return, reload the page and close other pages that use the graphics card.',
  },
  E_WORKER: {
    title: 'Part of this page could not start.',
    advice: 'Reload the page, in a current version of Chrome, Edge, Firefox or Safari.',
  },
};

/** Words for files that cannot be fetched, by what failed. @type {Record<string, {title: string, advice: string}>} */
const FETCHING = {
  connection: {
    title: 'The file could not be read.',
    advice:
      'Check the address and the connection, then try again. A file on another server needs its permission (Access-Control-Allow-Origin).',
  },
  refused: {
    title: 'The file could not be read.',
    advice: 'Check the address. A link that was valid once may have expired: reload the page.',
  },
  busy: { title: 'The server cannot send the file now.', advice: 'It is busy or out of order. Try again later.' },
  server: {
    title: 'The server does not send the file as it should.',
    advice: 'The file may be sound. The details below help whoever runs the server.',
  },
  replaced: { title: 'The file was replaced on the server.', advice: 'Reload the page to see the new one.' },
  local: {
    title: 'A page opened from disk cannot load files.',
    advice:
      'Put viewer and scene into one page with “csplat export-html”, or open the page from a local server, such as that of “csplat view”.',
  },
};

/** Words for statuses of HTTP. @type {Record<number, {title: string, advice: string}>} */
const STATUSES = {
  401: { title: 'The server does not give access to the file.', advice: 'Sign in again, then reload the page.' },
  403: {
    title: 'The server does not give access to the file.',
    advice: 'The link may have expired, or access is not allowed. Reload the page.',
  },
  404: { title: 'The file could not be read.', advice: 'There is no file at this address. Check the address.' },
  410: { title: 'The file could not be read.', advice: 'There is no file at this address any more.' },
};

/**
 * Explain an error.
 *
 * @param {Problem} problem
 * @param {string} [name] name of the file
 * @returns {Message} a title for all users, advice, and the details for a bug report
 */
export function explain({ code, message, offset, clause, reason, status }, name = '') {
  let words = STATUSES[status ?? 0] ??
    FETCHING[reason ?? ''] ??
    WORDS[code] ?? { title: 'Something went wrong.', advice: 'Reload the page.' };
  if (code === 'E_MAGIC' && /\.ply$/i.test(name)) {
    words = {
      title: 'This is a PLY, not a .csplat file.',
      advice: `“csplat encode” compresses it; “csplat view ${name}” shows it.`,
    };
  }
  const place = typeof offset === 'number' ? ` at byte ${offset.toLocaleString('en')}` : '';
  const rule = clause ? ` (${clause})` : '';
  const detail = message.replace(/^E_[A-Z0-9_]+( at byte \d+)?( \([A-Z0-9-]+\))?: /, '');
  return { ...words, facts: `${code}${place}${rule}: ${detail}` };
}
