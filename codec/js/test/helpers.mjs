// SPDX-License-Identifier: Apache-2.0
// Helpers of the tests: the conformance vectors, hashes, repaired checksums, a server.

import { createHash } from 'node:crypto';
import { readFileSync } from 'node:fs';
import { createServer } from 'node:http';
import { CRC_SIZE, crc32 } from '../checksums.mjs';
import { CsplatError, readHeader } from '../decoder.mjs';
import { streamInflate } from '../inflate.mjs';
import { DIRECTORY_RECORD_OFFSETS, HEADER_OFFSETS, HEADER_SIZE, LAYER_RECORD_OFFSETS } from '../spec.mjs';
import { allTiles } from '../tile_records.mjs';

const VECTORS = new URL('../../../conformance/csplat_conformance/vectors/', import.meta.url);

export const manifest = JSON.parse(readFileSync(new URL('manifest.json', VECTORS), 'utf8')).vectors;

/** @param {string} name such as `valid/rich` */
export const vector = (name) => new Uint8Array(readFileSync(new URL(`${name}.csplat`, VECTORS)));

/** The reason to skip tests of DecompressionStream, or false. */
export const noStream = await streamInflate().then(
  () => false,
  (error) => error.message,
);

/**
 * Check all vectors of a list, even if some fail.
 *
 * @template {{name: string}} T
 * @param {T[]} vectors
 * @param {(vector: T) => Promise<void>} check
 * @returns {Promise<Record<string, string>>} the errors of the vectors that failed, by name
 */
export async function failures(vectors, check) {
  /** @type {Record<string, string>} */
  const failed = {};
  for (const one of vectors) {
    await check(one).catch((error) => {
      failed[one.name] = error.stack;
    });
  }
  return failed;
}

/** SHA-256 of an array's bytes, in hexadecimal. @param {ArrayBufferView} array */
export const hash = (array) =>
  createHash('sha256')
    .update(new Uint8Array(array.buffer, array.byteOffset, array.byteLength))
    .digest('hex');

/**
 * Return the error that a decode is refused with.
 *
 * @param {() => unknown} run
 * @returns {Promise<CsplatError>} any other exception fails the test
 */
export async function refusal(run) {
  try {
    await run();
  } catch (error) {
    if (error instanceof CsplatError) return error;
    throw error;
  }
  throw new Error('not refused');
}

/**
 * Return a copy of a file with some bytes changed and all checksums repaired.
 *
 * @param {Uint8Array} file a valid file
 * @param {(bytes: Uint8Array, view: DataView) => void} change
 */
export function forged(file, change) {
  const header = readHeader(file);
  const { directory, indexSize } = header;
  const bytes = file.slice();
  const view = new DataView(bytes.buffer);
  change(bytes, view);
  const seal = (start, end, at = end) => view.setUint32(at, crc32(bytes.subarray(start, end)), true);
  seal(0, HEADER_OFFSETS.header_crc);
  const [toCrc, layerToCrc] = [DIRECTORY_RECORD_OFFSETS, LAYER_RECORD_OFFSETS].map(({ crc, offset }) => crc - offset);
  for (const { offset, size, offsetField } of directory) seal(offset, offset + size, offsetField + toCrc);
  for (const { offset, size, offsetField } of allTiles(header).flatMap((tile) => tile.layers))
    seal(offset, offset + size, offsetField + layerToCrc);
  seal(HEADER_SIZE, HEADER_SIZE + indexSize - CRC_SIZE);
  return bytes;
}

/**
 * Serve a file until the test ends.
 *
 * @param {import('node:test').TestContext} test
 * @param {Uint8Array} file
 * @param {{ranges?: boolean, sent?: Uint8Array}} [options] `sent` is sent as a whole in place of the file
 * @returns {Promise<{url: string, requests: string[]}>} `requests` collects the requested ranges
 */
export async function serve(test, file, { ranges = true, sent = file } = {}) {
  const requests = [];
  const server = createServer((request, response) => {
    const range = /^bytes=(\d+)-(\d+)$/.exec(request.headers.range ?? '');
    requests.push(request.headers.range ?? 'all');
    if (request.url !== '/scene.csplat') return response.writeHead(404).end('no');
    if (!ranges || !range) return response.writeHead(200).end(sent);
    const [start, end] = [Number(range[1]), Math.min(Number(range[2]) + 1, file.length)];
    if (start >= file.length) return response.writeHead(416).end();
    response.writeHead(206, { 'Content-Range': `bytes ${start}-${end - 1}/${file.length}`, ETag: '"1"' });
    return response.end(file.subarray(start, end));
  });
  await new Promise((resolve) => server.listen(0, '127.0.0.1', resolve));
  test.after(() => {
    server.closeAllConnections();
    server.close();
  });
  return { url: `http://127.0.0.1:${server.address().port}/scene.csplat`, requests };
}
