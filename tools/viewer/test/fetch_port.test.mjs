// SPDX-License-Identifier: Apache-2.0
// Functions of the page that the worker calls.
import assert from 'node:assert/strict';
import { test } from 'node:test';

import { CsplatReader } from '../../../codec/js/decoder.mjs';
import { hash, vector } from '../../../codec/js/test/helpers.mjs';
import { answer, pageFunctions, sendable } from '../fetch_port.mjs';

const file = vector('valid/rich');

/** Functions of a worker that ask a page with these options; everything between them is a message. */
function between(options) {
  const questions = [];
  const functions = pageFunctions((question, port) => {
    const { port1, port2 } = new MessageChannel();
    port1.onmessage = ({ data }) => {
      port1.close();
      questions.push(data.question);
      void answer(data.question, data.port, options);
    };
    port2.postMessage({ question, port }, [port]);
  });
  return { ...functions, questions };
}

/** Answers ranges in parts of 50 bytes. */
const ranges = async (url, { headers, signal }) => {
  const [, start, last] = /bytes=(\d+)-(\d+)/.exec(new Headers(headers).get('range'));
  const body = file.subarray(Number(start), Number(last) + 1);
  let at = 0;
  const stream = new ReadableStream({
    pull(controller) {
      if (at < body.length) controller.enqueue(body.slice(at, (at += 50)));
      else controller.close();
    },
  });
  signal.throwIfAborted();
  const range = `bytes ${start}-${Number(start) + body.length - 1}/${file.length}`;
  return new Response(stream, { status: 206, headers: { 'content-range': range, etag: '"a"' } });
};

test("a file is read by the page's fetch and renewed by its hook", async () => {
  const seen = [];
  const fetch = async (url, init) => {
    seen.push([url, new Headers(init.headers).get('x-key'), init.credentials]);
    return url.includes('old') ? new Response('', { status: 403 }) : ranges(url, init);
  };
  const renew = async ({ url, status }) => ({
    url: new URL(`/new?${status}`, url),
    headers: new Headers({ 'x-key': 'k' }),
  });
  const { questions, ...functions } = between({ fetch, renew });
  const request = { headers: { 'x-key': 'j' }, credentials: 'include' };
  const options = { ...functions, request, firstBytes: 100 };
  const reader = await CsplatReader.open('http://example.test/old', options);
  const direct = await CsplatReader.open(file);
  assert.equal(hash((await reader.readTile(0)).means), hash((await direct.readTile(0)).means));
  assert.deepEqual(seen[0], ['http://example.test/old', 'j', 'include']);
  assert.deepEqual(seen[1], ['http://example.test/new?403', 'k', 'include']);
  assert.equal(questions.filter((one) => 'renew' in one).length, 1);
});

test('failures, refusals to renew and aborts pass', async () => {
  const broken = between({ fetch: () => Promise.reject(new TypeError('Failed to fetch')) });
  await assert.rejects(CsplatReader.open('http://example.test/a', { ...broken, retryMs: 0, retries: 1 }), {
    reason: 'connection',
    message: /Failed to fetch/,
  });
  const refused = between({ fetch: async () => new Response('', { status: 403 }), renew: () => null });
  await assert.rejects(CsplatReader.open('http://example.test/a', refused), { status: 403 });
  const thrown = between({ fetch: async () => new Response('', { status: 403 }), renew: () => Promise.reject('no') });
  await assert.rejects(CsplatReader.open('http://example.test/a', thrown), { status: 403, message: /failed: .*no/ });
  let ended;
  const hanging = between({
    fetch: (url, { signal }) => new Promise(() => (ended = new Promise((done) => (signal.onabort = done)))),
  });
  const controller = new AbortController();
  const reason = new Error('the user left');
  const open = CsplatReader.open('http://example.test/a', { ...hanging, signal: controller.signal });
  while (!ended) await new Promise((resolve) => setTimeout(resolve, 1));
  controller.abort(reason);
  await assert.rejects(open, reason);
  await ended; // the page's request, too
});

test('fields that cannot be sent are left out', () => {
  const { signal } = new AbortController();
  const sent = sendable({ headers: { a: 'b' }, credentials: 'include', signal, window: null, dispatcher: () => {} });
  assert.deepEqual(structuredClone(sent), { headers: [['a', 'b']], credentials: 'include' });
  assert.deepEqual(sendable(), {});
});
