// SPDX-License-Identifier: Apache-2.0
// Answers of servers, as they should be and as they are: each row of a table is read to its end, or refused with its reason.
import assert from 'node:assert/strict';
import { createReadStream } from 'node:fs';
import { createServer } from 'node:http';
import { dirname, join, relative } from 'node:path';
import { Readable } from 'node:stream';
import { test } from 'node:test';
import { fileURLToPath, pathToFileURL } from 'node:url';
import { brotliCompressSync, gzipSync, inflateRawSync } from 'node:zlib';

import { differ, judge, retryAfter } from '../answers.mjs';
import { CsplatReader, InputError, decode, readHeader } from '../decoder.mjs';
import { openScene } from '../engines/scene.mjs';
import { forged, hash, vector } from './helpers.mjs';

const file = vector('valid/rich');
const SIZE = file.length;
const URL_ = 'http://example.test/scene.csplat';
const { header } = await decode(file);
const [{ layers }] = header.tiles;
const damaged = (bytes) => Uint8Array.from(bytes, (byte, i) => (i === layers[0].offset + 20 ? byte ^ 1 : byte));
const coded = file.subarray(0, SIZE - 9);
const damagedIndex = Uint8Array.from(file, (byte, i) => (i === 80 ? byte ^ 1 : byte));
const changed = await anotherScene();

/** Return a valid file of the same size whose first layer and index differ. */
async function anotherScene() {
  const { offset, size } = layers[0];
  for (let at = offset + size - 1; ; at--) {
    const copy = forged(file, (bytes) => (bytes[at] ^= 1));
    if (await decode(copy).catch(() => null)) return copy;
  }
}

/** The answer of a good server to a request. */
function right([start, end], { of = file, upTo = end, from = start, headers = {}, ...rest } = {}) {
  const last = Math.min(upTo, of.length);
  const range = `bytes ${from}-${last - 1}/${of.length}`;
  return { status: 206, headers: { 'content-range': range, ...headers }, body: of.subarray(from, last), ...rest };
}
const whole = ({ of = file, headers = {}, ...rest } = {}) => ({ status: 200, headers, body: of, ...rest });
const status = (code, headers = {}) => ({ status: code, headers, body: new Uint8Array(0) });

/**
 * A fetch that answers as a script says: `answer(range, n)` of request n from 1 on; range null without Range. An answer is an
 * error to throw, or {status, headers, body, breaks, stalls}: `breaks` and `stalls` after that many bytes.
 */
function scripted(answer) {
  const requests = [];
  const fetch = async (url, { headers, signal, ...init }) => {
    const range = /^bytes=(\d+)-(\d*)$/.exec(new Headers(headers).get('range') ?? '');
    const asked = range && [Number(range[1]), range[2] === '' ? SIZE : Number(range[2]) + 1];
    requests.push({ url: String(url), asked, init, headers: new Headers(headers) });
    const given = await answer(asked, requests.length, String(url));
    if (given instanceof Error) throw given;
    if (given.stalls === -1) await stall(signal);
    const { body, breaks, stalls } = given;
    let hasBegun = false;
    const stream = new ReadableStream({
      async pull(controller) {
        const most = breaks ?? stalls ?? body.length;
        if (!hasBegun && most > 0) controller.enqueue(body.slice(0, most));
        else if (breaks !== undefined) controller.error(new TypeError('terminated'));
        else if (stalls !== undefined) await stall(signal);
        else controller.close();
        hasBegun = true;
      },
    });
    const response = new Response([204, 304].includes(given.status) ? null : stream, {
      ...{ status: given.status || 200, headers: given.headers },
    });
    return given.type
      ? Object.defineProperties(response, { type: { value: given.type }, status: { value: 0 } })
      : response;
  };
  return { fetch, requests };
}

const stall = (signal) =>
  new Promise((_, reject) => signal?.addEventListener('abort', () => reject(signal.reason), { once: true }));

// With an inflate of its own a reader starts no WebAssembly.
const FAST = { inflate: (coded) => inflateRawSync(coded), firstBytes: 128, retryMs: 0, timeoutMs: 10 };

/** Read every part of a file; returns a hash of the means. */
async function readAll(from, options) {
  const reader = await CsplatReader.open(from, options);
  await reader.describe();
  const means = [];
  for await (const tile of reader.readTiles()) means.push(...tile.means);
  return hash(Float32Array.from(means));
}
const RIGHT = hash((await decode(file)).means);

const lost = () => new TypeError('Failed to fetch');
/** Answers of request n alone, all others are right. */
const at = (n, answer) => (asked, i) => (i === n ? answer(asked) : right(asked));
/** A server that ignores Range. */
const all = (n, answer) => (asked, i) => (i === n ? answer(asked) : whole());

// name, script, what is read ('read') or refused: the reason, and words of the message
const TABLE = [
  ['right answers', (asked) => right(asked), 'read'],
  ['at most 100 bytes of each range', ([a, b]) => right([a, Math.min(b, a + 100)]), 'read'],
  ['at most 300 bytes, chunked', ([a, b]) => right([a, Math.min(b, a + 300)]), 'read'],
  ['one byte of each range, whole without Range', (r) => (r ? right([r[0], r[0] + 1]) : whole()), 'read'],
  [
    'no byte of each range, whole without Range',
    (r) => (r ? { ...right(r), body: file.slice(0, 0) } : whole()),
    'connection',
    /ended after 0 of/,
  ],
  ['more than the range', ([a]) => right([a, SIZE]), 'read'],
  ['no Content-Range', (asked) => ({ ...right(asked), headers: {} }), 'read'],
  ['no Content-Range, at most 200 bytes', ([a, b]) => ({ ...right([a, Math.min(b, a + 200)]), headers: {} }), 'read'],
  [
    'size of the file unknown',
    ([a, b]) => right([a, b], { headers: { 'content-range': `bytes ${a}-${Math.min(b, SIZE) - 1}/*` } }),
    'read',
  ],
  [
    'Content-Range with other spelling',
    ([a, b]) => right([a, b], { headers: { 'content-range': `Bytes  ${a}-${Math.min(b, SIZE) - 1}/${SIZE}` } }),
    'read',
  ],
  [
    'nonsense as Content-Range',
    at(2, (r) => right(r, { headers: { 'content-range': 'bytes 9-2/5' } })),
    'server',
    /Content-Range/,
  ],
  ['another start', at(2, (r) => right(r, { from: 3 })), 'server', /instead of from/],
  [
    'multipart/byteranges',
    at(1, (r) => right(r, { headers: { 'content-type': 'multipart/byteranges; boundary=x' } })),
    'server',
    /multipart/,
  ],
  [
    'coded parts, whole without Range',
    (r) => (r ? right(r, { headers: { 'content-encoding': 'gzip' } }) : whole()),
    'read',
  ],
  [
    'coded parts from the second answer on',
    (r, n) =>
      r === null ? whole() : n > 1 ? right(r, { of: coded, headers: { 'content-encoding': 'br' } }) : right(r),
    'read',
  ],
  ['identity as coding', (r) => right(r, { headers: { 'content-encoding': 'identity' } }), 'read'],
  [
    'Range fails, as coded bodies in Chromium',
    (r) => (r ? lost() : whole({ headers: { 'content-encoding': 'gzip' } })),
    'read',
  ],
  ['Range fails, and the coding is hidden', (r) => (r ? lost() : whole()), 'read'],
  ['Range fails from the third request on', (r, n) => (r && n > 2 ? lost() : r ? right(r) : whole()), 'read'],
  ['the first connection fails', at(1, lost), 'read'],
  ['the second connection fails', at(2, lost), 'read'],
  ['every connection fails', lost, 'connection', /Failed to fetch/],
  [
    'fetch throws at once',
    () => {
      throw new TypeError('no');
    },
    'connection',
    /no/,
  ],
  [
    '416 within a file that is shorter than the range',
    ([a, b]) => (b > SIZE ? status(416, { 'content-range': `bytes */${SIZE}` }) : right([a, b])),
    'read',
    null,
    { firstBytes: 1 << 16 },
  ],
  [
    '416 without Content-Range',
    (r) => (r === null ? whole() : r[1] > SIZE ? status(416) : right(r)),
    'read',
    null,
    { firstBytes: 1 << 16 },
  ],
  [
    '416 although the range is within',
    (r) => (r ? status(416, { 'content-range': `bytes */${SIZE}` }) : whole()),
    'read',
  ],
  ['416 of an empty file', () => status(416, { 'content-range': 'bytes */0' }), 'E_TRUNCATED'],
  ...[408, 425, 429, 500, 502, 503, 504, 520].flatMap((code) =>
    [1, 2].map((n) => [`${code} once, at request ${n}`, at(n, () => status(code)), 'read']),
  ),
  ['503 for ever', () => status(503, { 'retry-after': '0' }), 'busy', /HTTP status 503/],
  ['501', () => status(501), 'server', /501/],
  ['Retry-After is nonsense', at(1, () => status(429, { 'retry-after': 'soon' })), 'read'],
  ['the first answer breaks off', at(1, (r) => right(r, { breaks: 50 })), 'read'],
  ['the second answer breaks off', at(2, (r) => right(r, { breaks: 30 })), 'read'],
  ['an answer breaks off without a byte', at(2, (r) => right(r, { breaks: 0 })), 'read'],
  ['a proxy ends the first answer early', at(1, (r) => ({ ...right(r), body: file.slice(0, 70) })), 'read'],
  ['a proxy ends the second answer early', at(2, (r) => ({ ...right(r), body: file.slice(r[0], r[0] + 10) })), 'read'],
  [
    'every answer ends early, after a byte',
    (r) => ({ ...right(r), body: file.slice(r[0], r[0] + 1) }),
    'connection',
    /ended after 1 of/,
  ],
  ['nothing arrives before the headers', at(1, (r) => right(r, { stalls: -1 })), 'read'],
  ['nothing arrives after the headers', at(2, (r) => right(r, { stalls: 0 })), 'read'],
  ['an answer stops in the middle', at(2, (r) => right(r, { stalls: 30 })), 'read'],
  ['nothing arrives at all', (r) => right(r, { stalls: 0 }), 'connection', /nothing arrived for/, { retries: 1 }],
  ['no ranges', () => whole(), 'read'],
  ['no ranges, breaks off', all(1, () => whole({ breaks: 500 })), 'read'],
  ['no ranges, breaks off within the header', all(1, () => whole({ breaks: 20 })), 'read'],
  ['no ranges, ends early', all(1, () => whole({ of: file.subarray(0, 500) })), 'read'],
  ['no ranges, stops', all(1, () => whole({ stalls: 400 })), 'read'],
  ['no ranges, breaks off, continued by a range', (r, n) => (n === 1 ? whole({ breaks: 500 }) : right(r)), 'read'],
  ['no ranges, breaks off for ever', () => whole({ breaks: 500 }), 'connection', /terminated/],
  ['no ranges, ends always at the same byte', () => whole({ of: file.subarray(0, 500) }), 'E_TRUNCATED'],
  [
    'no ranges, ends as announced',
    () => whole({ of: file.subarray(0, 500), headers: { 'content-length': '500' } }),
    'E_TRUNCATED',
  ],
  [
    'no ranges, then 503 and 429',
    (_, n) => (n === 1 ? whole({ breaks: 500 }) : n < 4 ? status(n === 2 ? 503 : 429) : whole()),
    'read',
  ],
  [
    'no ranges, replaced while it is read',
    (_, n) => (n === 1 ? whole({ breaks: 1500 }) : whole({ of: changed })),
    'replaced',
  ],
  ['200 at a later request', at(3, () => whole()), 'read'],
  [
    '200 at a later request, which breaks off',
    (r, n) => (n === 3 ? whole({ breaks: 200 }) : n === 4 ? whole() : right(r)),
    'read',
  ],
  [
    'a part as 200',
    at(2, ([a, b]) => ({ ...whole({ of: file.subarray(a, b) }), headers: { 'content-length': `${b - a}` } })),
    'server',
    /status 200/,
  ],
  ['a part as 200, chunked', at(2, ([a, b]) => whole({ of: file.subarray(a, b) })), 'server', /status 200/],
  ['the first part as 200', at(1, ([a, b]) => whole({ of: file.subarray(a, b) })), 'server', /status 200/],
  ['weak and strong ETags', (r, n) => right(r, { headers: { etag: n % 2 ? 'W/"a"' : '"a"' } }), 'read'],
  ['an ETag that is missing later', (r, n) => right(r, { headers: n > 1 ? {} : { etag: '"a"' } }), 'read'],
  ['another ETag in each answer', (r, n) => right(r, { headers: { etag: `"${n}"` } }), 'read'],
  [
    'replaced, another ETag',
    (r, n) => right(r, { of: n > 2 ? damaged(file) : file, headers: { etag: n > 2 ? '"b"' : '"a"' } }),
    'replaced',
  ],
  [
    'replaced, another Last-Modified',
    (r, n) => right(r, { of: n > 2 ? damaged(file) : file, headers: { 'last-modified': n > 2 ? 'b' : 'a' } }),
    'replaced',
  ],
  [
    'replaced, same size, no ETag',
    (r, n) => right(r, { of: n > 2 ? changed : file }),
    'replaced',
    /replaced on the server/,
  ],
  [
    'replaced between header and index by one with the same header',
    (r, n) => right(r, { of: n > 1 ? changed : file, headers: { etag: n > 1 ? '"b"' : '"a"' } }),
    'read',
    null,
    { firstBytes: 64 },
  ],
  [
    'replaced by a larger file',
    (r, n) => right(r, { of: n > 2 ? Uint8Array.of(...file, 0) : file }),
    'replaced',
    /bytes instead of/,
  ],
  [
    'replaced by a smaller file',
    (r, n) => right(r, { of: n > 2 ? file.subarray(0, SIZE - 1) : file }),
    'replaced',
    /bytes instead of/,
  ],
  [
    'replaced by a much smaller file',
    (r, n) => (n > 2 ? status(416, { 'content-range': 'bytes */100' }) : right(r)),
    'replaced',
  ],
  [
    'replaced, 200 for If-Range',
    (r, n) => (n > 2 ? whole({ of: damaged(file), headers: { etag: '"b"' } }) : right(r, { headers: { etag: '"a"' } })),
    'replaced',
  ],
  [
    'replaced between header and index',
    (r, n) => right(r, { of: n > 1 ? damagedIndex : file, headers: { etag: n > 1 ? '"b"' : '"a"' } }),
    'replaced',
    null,
    { firstBytes: 64 },
  ],
  [
    'replaced, 200 with another scene',
    (r, n) => (n > 2 ? whole({ of: vector('valid/codebook_shape') }) : right(r)),
    'replaced',
  ],
  ['damaged on the server', (r) => right(r, { of: damaged(file) }), 'E_CRC'],
  ['damaged, no ranges', () => whole({ of: damaged(file) }), 'E_CRC'],
  ['204', at(1, () => status(204)), 'server', /204/],
  ['304', at(2, () => status(304)), 'server', /304/],
  ['404', at(1, () => status(404)), 'refused', /404/],
  ['403 at the third request', at(3, () => status(403)), 'refused', /403/],
  ['an opaque answer', at(1, () => ({ ...whole(), type: 'opaque' })), 'server', /hides/],
  ['a web page', () => whole({ of: new TextEncoder().encode(`<!doctype html>${' '.repeat(99)}`) }), 'E_MAGIC'],
];

test('each answer of a server is read, or refused with its reason', async () => {
  const wrong = [];
  for (const [name, answer, expected, words = null, options = {}] of TABLE) {
    const { fetch, requests } = scripted(answer);
    const received = [];
    const onProgress = (bytes) => received.push(bytes);
    const found = await readAll(URL_, { fetch, onProgress, ...FAST, ...options }).catch((error) => error);
    const isRight = found === RIGHT;
    const kind = isRight ? 'read' : (found.reason ?? found.code ?? found);
    const isTold = !words || words.test(found.message);
    const once = received.every((bytes, i) => bytes > (received[i - 1] ?? 0)) && (received.at(-1) ?? 0) <= SIZE;
    if (kind !== expected || !isTold || (isRight && !once) || requests.length > 60)
      wrong.push(`${name}: ${kind} instead of ${expected}, ${requests.length} requests, ${received}: ${found.stack}`);
  }
  assert.deepEqual(wrong, []);
});

test('a load into an engine survives what a reader survives', async () => {
  const target = { name: 'test', engine: 'RUB', mirrors: true, shDegree: 3 };
  for (const progressive of [false, true]) {
    const { fetch } = scripted((asked, n) =>
      n % 2 ? right(asked, { breaks: 20 }) : n % 4 ? right(asked) : status(503),
    );
    const scene = await openScene(URL_, { fetch, progressive, workers: 1, ...FAST }, target);
    let count = 0;
    for await (const tile of scene.tiles()) count += tile.count;
    for (let band = 1; progressive && band <= scene.degree; band++)
      for await (const one of scene.bands(band)) assert.ok(one);
    assert.equal(count, header.splatCount);
    scene.release();
  }
});

test('waits before retries double, follow Retry-After, and end at 30 s', async () => {
  const cases = [
    [
      [503, 503, 503],
      ['', '', ''],
      [500, 1000, 2000],
    ],
    [
      [429, 503],
      ['7', '0'],
      [7000, 1000],
    ],
    [[503], ['86400'], [30_000]],
    [[503], [new Date(Date.now() + 9500).toUTCString()], [8000]],
    [[503], ['soon'], [500]],
  ];
  for (const [codes, after, expected] of cases) {
    const { fetch } = scripted((asked, n) => {
      const known = after[n - 1] ? { 'retry-after': after[n - 1] } : {};
      return n <= codes.length ? status(codes[n - 1], known) : right(asked);
    });
    const waits = [];
    // The clock runs a thousand times as fast.
    const own = globalThis.setTimeout;
    globalThis.setTimeout = (work, ms, ...rest) => own(work, ms / 1000, ...rest);
    try {
      await CsplatReader.open(URL_, { fetch, timeoutMs: Infinity, onRetry: (error, ms) => waits.push(ms) });
    } finally {
      globalThis.setTimeout = own;
    }
    assert.equal(waits.length, expected.length);
    for (const [i, ms] of expected.entries())
      assert.ok(waits[i] >= ms && waits[i] <= ms + 2000 * (ms === 8000), `${waits}`);
  }
});

test('retries can be chosen, also later', async () => {
  for (const retries of [0, 1, 3]) {
    const { fetch, requests } = scripted(() => status(503));
    await assert.rejects(CsplatReader.open(URL_, { fetch, ...FAST, retries }), {
      reason: 'busy',
      isTransient: true,
      status: 503,
    });
    assert.equal(requests.length, retries + 1);
  }
  const { fetch } = scripted((asked, n) => (n > 2 && n < 20 ? status(503) : right(asked)));
  const reader = await CsplatReader.open(URL_, { fetch, ...FAST });
  reader.retries = Infinity;
  assert.ok((await reader.readTile(0)).count > 0);
  for (const options of [{ retries: -1 }, { retries: '3' }, { retryMs: NaN }, { timeoutMs: null }]) {
    await assert.rejects(CsplatReader.open(URL_, options), { code: 'E_INPUT', reason: null });
  }
});

const REASONS = [
  new Error('the user left'),
  'a string',
  null,
  0,
  new DOMException('x', 'DataCloneError'),
  new InputError('y'),
  undefined,
];

test('an abort rejects with its reason, whenever it happens', async () => {
  const stalled = { timeoutMs: Infinity, firstBytes: 128 };
  const phases = {
    before: () => right([0, 128]),
    'before the headers': (asked) => right(asked, { stalls: -1 }),
    'after the headers': (asked) => right(asked, { stalls: 0 }),
    'in the body': (asked) => right(asked, { stalls: 50 }),
    'in the body of the whole file': () => whole({ stalls: 300 }),
    'in a wait': () => status(503, { 'retry-after': '20' }),
    'in the hook': () => status(403),
  };
  for (const [phase, answer] of Object.entries(phases)) {
    for (const reason of phase === 'in the body' ? REASONS : REASONS.slice(0, 2)) {
      const options = { ...stalled, renew: () => new Promise(() => {}) };
      const controller = new AbortController();
      if (phase === 'before') controller.abort(reason);
      const { signal } = controller;
      const seen = scripted(answer);
      const open = CsplatReader.open(URL_, { ...options, fetch: seen.fetch, signal });
      const load = openScene(
        URL_,
        { ...options, fetch: scripted(answer).fetch, signal },
        { name: 't', engine: 'RUB', mirrors: true, shDegree: 3 },
      );
      const later = scripted((asked, n) => (n > 2 ? answer(asked) : right(asked)));
      const reader = await CsplatReader.open(URL_, { ...options, fetch: later.fetch });
      const read = reader.readTile(0, { signal });
      const all = (async () => {
        for await (const _ of reader.readTiles({ workers: 1, signal }));
      })();
      const own = CsplatReader.open(URL_, {
        ...options,
        fetch: (url, init) => new Promise(() => {}),
        request: { signal },
      });
      const work = [open, load, read, all, own].map((one) =>
        one.then(
          () => 'done',
          (error) => ({ error }),
        ),
      );
      await new Promise((resolve) => setTimeout(resolve, 3));
      controller.abort(reason);
      reader.source.close(); // ends retries for nobody
      for (const done of work) assert.strictEqual((await done).error, signal.reason, `${phase}, ${String(reason)}`);
      if (reason !== undefined) assert.strictEqual(signal.reason, reason);
    }
  }
});

test('bytes that arrive while the thread is busy are no stall', async () => {
  const { fetch, requests } = scripted(async (asked) => {
    await new Promise((resolve) => setTimeout(resolve, 5));
    return right(asked);
  });
  const open = CsplatReader.open(URL_, { ...FAST, fetch, retries: 0 });
  await new Promise((resolve) => setTimeout(resolve, 1));
  for (const end = performance.now() + 40; performance.now() < end;);
  assert.ok((await open).header.splatCount > 0);
  assert.ok(requests.length <= 2);
});

test('who cancels a shared request cancels it for nobody else', async () => {
  const { fetch } = scripted((asked, n) => (n === 3 ? right(asked, { stalls: 5 }) : right(asked)));
  const reader = await CsplatReader.open(URL_, { ...FAST, fetch, timeoutMs: Infinity });
  const controller = new AbortController();
  reader.prefetch([{ tile: 0, layer: 0 }], { signal: controller.signal });
  const read = reader.readLayer(0, 0);
  await new Promise((resolve) => setTimeout(resolve, 3));
  controller.abort();
  assert.ok((await read).count > 0);

  const second = scripted((asked, n) => (n === 3 ? whole({ stalls: 900 }) : n > 3 ? whole() : right(asked)));
  const other = await CsplatReader.open(URL_, { ...FAST, fetch: second.fetch });
  const aborted = new AbortController();
  other.prefetch([{ tile: 0, layer: 0 }], { signal: aborted.signal });
  await new Promise((resolve) => setTimeout(resolve, 3));
  aborted.abort();
  assert.ok((await other.readTile(1)).count > 0);
});

test('a part is read before the rest of its request is here', { timeout: 10_000 }, async () => {
  const end = layers[0].offset + layers[0].size;
  const { fetch } = scripted((asked, n) => right(asked, n === 3 ? { stalls: end - asked[0] } : {}));
  const reader = await CsplatReader.open(URL_, { ...FAST, fetch, timeoutMs: Infinity });
  const controller = new AbortController();
  const wanted = header.tiles.map(({ index }) => ({ tile: index, layer: 0 }));
  reader.prefetch(wanted, { signal: controller.signal });
  assert.equal((await reader.readLayer(0, 0)).count, header.tiles[0].splatCount);
  controller.abort();
});

test('a refused address is renewed', async () => {
  const answer = (code) => (asked, n, url) => (url.includes('old') || n % 4 === 0 ? status(code) : right(asked));
  const renewals = {
    'a string': (n) => `http://example.test/new${n}.csplat?a=%2F+b`,
    'a relative address': (n) => `new${n}.csplat`,
    'a URL, later': async (n) => new URL(`http://example.test/new${n}`),
    'a Request': (n) => new Request(`http://example.test/new${n}`, { headers: { 'x-key': 'k' } }),
    'headers alone': () => ({ url: 'http://example.test/new', headers: { 'x-key': 'k' }, credentials: 'include' }),
  };
  for (const [i, [name, renewal]] of Object.entries(renewals).entries()) {
    for (const code of [[401, 403, 404, 410][i % 4]]) {
      const { fetch, requests } = scripted(answer(code));
      const asked = [];
      const renew = (refusal) => asked.push(refusal) && renewal(asked.length);
      const found = await readAll('http://example.test/old', { ...FAST, fetch, renew });
      assert.equal(found, RIGHT, name);
      assert.deepEqual(
        [asked[0].url, asked[0].status, /HTTP status/.test(asked[0].message)],
        ['http://example.test/old', code, true],
      );
      assert.ok(asked.length > 1);
      if (/Request|headers/.test(name)) assert.equal(requests.at(-1).headers.get('x-key'), 'k');
    }
  }
  const gaveUp = { null: () => null, nothing: async () => {}, 'the same address': () => 'http://example.test/old' };
  for (const [name, renew] of Object.entries(gaveUp)) {
    const { fetch, requests } = scripted(answer(403));
    await assert.rejects(
      CsplatReader.open('http://example.test/old', { ...FAST, fetch, renew }),
      { status: 403, reason: 'refused' },
      name,
    );
    assert.ok(requests.length <= 2);
  }
  const cause = new Error('signed out');
  const renew = () => Promise.reject(cause);
  await assert.rejects(
    CsplatReader.open('http://example.test/old', { ...FAST, fetch: scripted(answer(403)).fetch, renew }),
    { cause, status: 403 },
  );
  // Several requests that are refused together ask once.
  let count = 0;
  const { fetch } = scripted((asked, n, url) => (n > 2 && url === URL_ ? status(403) : right(asked)));
  const reader = await CsplatReader.open(URL_, { ...FAST, fetch, renew: async () => `${URL_}?${++count}` });
  await Promise.all(header.tiles.map(({ index }) => reader.readTile(index)));
  assert.equal(count, 1);
});

test('options of requests reach each of them', async () => {
  const { fetch, requests } = scripted((asked) => right(asked));
  const request = { headers: { authorization: 'Bearer x' }, credentials: 'include', cache: 'no-cache' };
  await readAll(URL_, { ...FAST, fetch, request });
  for (const { init, headers } of requests) {
    assert.deepEqual([init.credentials, init.cache, headers.get('authorization')], ['include', 'no-cache', 'Bearer x']);
    assert.match(headers.get('range'), /^bytes=/);
  }
});

test('blob: and data: addresses are fetched once, and whole', async () => {
  const url = URL.createObjectURL(new Blob([file]));
  const reader = await CsplatReader.open(url);
  URL.revokeObjectURL(url);
  assert.ok((await reader.readTile(1)).count > 0);
  await assert.rejects(CsplatReader.open(url), { reason: 'refused', isTransient: false, message: /revoked/ });
  const received = [];
  const data = `data:model/vnd.csplat;base64,${Buffer.from(file).toString('base64')}`;
  assert.equal(await readAll(data, { onProgress: (bytes) => received.push(bytes) }), RIGHT);
  assert.deepEqual(received, [SIZE]);
  await assert.rejects(CsplatReader.open('data:;base64,%'), { reason: 'refused' });
  const reason = new Error('x');
  await assert.rejects(CsplatReader.open(data, { signal: AbortSignal.abort(reason) }), reason);
});

test('views are sources; what is none is refused', async () => {
  const pool = new Uint8Array(SIZE + 9);
  pool.set(file, 5);
  const shared = new Uint8Array(new SharedArrayBuffer(SIZE));
  shared.set(file);
  for (const from of [file, Buffer.from(file), pool.subarray(5, SIZE + 5), new DataView(file.slice().buffer), shared]) {
    assert.equal(await readAll(from), RIGHT);
  }
  for (const from of [null, undefined, 7, {}]) {
    for (const read of [decode, CsplatReader.open]) await assert.rejects(read(from), { code: 'E_INPUT' });
  }
  await assert.rejects(decode(createReadStream(ON_DISK)), { code: 'E_INPUT', message: /Readable\.toWeb/ });
});

const ON_DISK = fileURLToPath(
  new URL('../../../conformance/csplat_conformance/vectors/valid/rich.csplat', import.meta.url),
);
const folder = dirname(ON_DISK);

/** A stream of the file in parts of some bytes. */
const streamed = (size = 100, of = file) =>
  new ReadableStream({
    start(controller) {
      for (let at = 0; at < of.length; at += size) controller.enqueue(of.slice(at, at + size));
      controller.close();
    },
  });

const SOURCES = {
  Response: () => new Response(file),
  'Response as it arrives': () => new Response(streamed()),
  ReadableStream: () => streamed(7),
  'stream of Node': () => Readable.toWeb(createReadStream(ON_DISK)),
  Blob: () => new Blob([file]),
  path: () => ON_DISK,
  'relative path': () => relative(process.cwd(), ON_DISK),
  'file: URL': () => pathToFileURL(ON_DISK),
  'its text': () => pathToFileURL(ON_DISK).href,
  Uint8Array: () => file,
};

for (const [kind, make] of Object.entries(SOURCES)) {
  test(`a file can be a ${kind}: progress, abort`, async () => {
    const received = [];
    assert.equal(await readAll(make(), { onProgress: (bytes) => received.push(bytes) }), RIGHT);
    assert.ok(received.every((bytes, i) => bytes > (received[i - 1] ?? 0)));
    if (kind !== 'Uint8Array') assert.ok(received.at(-1) > 0 && received.at(-1) <= SIZE);
    const done = [];
    const scene = await decode(make(), { onProgress: (...progress) => done.push(progress) });
    assert.equal(hash(scene.means), hash((await decode(file)).means));
    assert.deepEqual(done.at(-1), [scene.count, scene.count]);
    const reason = new Error('enough');
    const signal = AbortSignal.abort(reason);
    await assert.rejects(decode(make(), { signal }), reason);
    await assert.rejects(CsplatReader.open(make(), { signal }), reason);
    const life = new AbortController();
    const reader = await CsplatReader.open(make(), { signal: life.signal });
    life.abort(reason);
    await assert.rejects(reader.readTile(1), reason);
  });
}

test('an address can be decoded whole, with one request', async () => {
  const { fetch, requests } = scripted((asked) => (asked ? right(asked) : whole()));
  assert.ok((await decode(URL_, { fetch })).count > 0);
  assert.deepEqual(
    requests.map(({ asked }) => asked),
    [null],
  );
});

test('an abort cancels the stream', async () => {
  let cancelled = false;
  const stop = new AbortController();
  const held = new ReadableStream({
    start: (controller) => controller.enqueue(file.slice(0, 40)),
    cancel: () => (cancelled = true),
  });
  const decoding = decode(held, { signal: stop.signal });
  setTimeout(() => stop.abort(new Error('enough')), 20);
  await assert.rejects(decoding, /enough/);
  await new Promise((resolve) => setTimeout(resolve, 5));
  assert.equal(cancelled, true);
});

const UNUSABLE = {
  'absent file': [() => join(folder, 'absent.csplat'), 'E_INPUT', /absent\.csplat.*cannot be read: ENOENT/],
  'absent file: URL': [() => pathToFileURL(join(folder, 'absent.csplat')), 'E_INPUT', /ENOENT/],
  folder: [() => folder, 'E_INPUT', /cannot be read/],
  'invalid file: URL': [() => 'file://host/a.csplat', 'E_INPUT', /cannot be read/],
  status: [() => new Response('none', { status: 404 }), 'E_INPUT', /404/],
  'web page': [() => new Response('<!doctype html><title>a page</title>'), 'E_MAGIC', /web page/],
  'read Response': [readResponse, 'E_INPUT', /the response: its bytes are read elsewhere/],
  'locked stream': [() => locked(streamed()), 'E_INPUT', /the stream: its bytes are read elsewhere/],
  'text stream': [
    () => new Response('a').body.pipeThrough(new TextDecoderStream()),
    'E_INPUT',
    /neither an ArrayBuffer/,
  ],
  'broken stream': [() => broken(new Error('lost')), 'E_INPUT', /the stream: Error: lost/],
  'empty Response': [() => new Response(null), 'E_TRUNCATED', /./],
  'cut stream': [() => streamed(99, file.subarray(0, -30)), 'E_TRUNCATED', /./],
  'cut header': [() => streamed(9, file.subarray(0, 20)), 'E_TRUNCATED', /./],
  'long stream': [() => streamed(99, new Uint8Array([...file, 0])), 'E_TRAILING', /./],
};

async function readResponse() {
  const response = new Response(file);
  await response.arrayBuffer();
  return response;
}

function locked(stream) {
  stream.getReader();
  return stream;
}

const broken = (error) =>
  new ReadableStream({
    start(controller) {
      controller.enqueue(file.slice(0, 50));
    },
    pull: (controller) => controller.error(error),
  });

for (const [kind, [make, code, message]] of Object.entries(UNUSABLE)) {
  test(`a file that is a ${kind} is refused`, async () => {
    await assert.rejects(decode(await make()), { code, message });
    await assert.rejects(readAll(await make()), { code, message });
  });
}

/** Serve with a function until the test ends. */
async function served(t, answer) {
  let n = 0;
  const server = createServer((request, response) => {
    const range = /^bytes=(\d+)-(\d*)$/.exec(request.headers.range ?? '');
    answer(
      response,
      range && [Number(range[1]), Math.min(SIZE, range[2] === '' ? SIZE : Number(range[2]) + 1)],
      ++n,
      request,
    );
  });
  await new Promise((resolve) => server.listen(0, '127.0.0.1', resolve));
  t.after(() => {
    server.closeAllConnections();
    server.close();
  });
  return { url: `http://127.0.0.1:${server.address().port}/scene.csplat`, count: () => n };
}

test("coded bodies, resets and endless redirects with the platform's own fetch", async (t) => {
  const part = (s, [a, b], headers = {}) =>
    s.writeHead(206, { 'content-range': `bytes ${a}-${b - 1}/${SIZE}`, ...headers });
  const bodies = { gzip: gzipSync(file), br: brotliCompressSync(file) };
  for (const [coding, body] of Object.entries(bodies)) {
    const { url } = await served(t, (s) => s.writeHead(200, { 'content-encoding': coding }).end(body));
    assert.equal(await readAll(url, FAST), RIGHT);
    const parts = await served(t, (s, r) => {
      if (!r) return s.writeHead(200, { 'content-encoding': coding }).end(body);
      part(s, [r[0], Math.min(r[1], body.length)], { 'content-encoding': coding }).end(body.subarray(...r));
    });
    assert.equal(await readAll(parts.url, FAST), RIGHT);
  }
  for (const breaking of [1, 2]) {
    const { url } = await served(t, (s, r, n) => {
      if (n !== breaking) return part(s, r).end(file.subarray(...r));
      part(s, r, { 'content-length': r[1] - r[0] }).write(file.subarray(r[0], r[0] + 20), () => s.destroy());
    });
    assert.equal(await readAll(url, FAST), RIGHT);
  }
  const reset = await served(t, (s, r, n) => (n < 3 ? s.destroy() : part(s, r).end(file.subarray(...r))));
  assert.equal(await readAll(reset.url, { ...FAST, timeoutMs: 1000 }), RIGHT);
  const loop = await served(t, (s) => s.writeHead(302, { location: '/scene.csplat' }).end());
  await assert.rejects(readAll(loop.url, { ...FAST, timeoutMs: 5000 }), {
    reason: 'connection',
    isTransient: false,
    message: /redirect/,
  });
});

test('pieces of the table', () => {
  const now = Date.parse('2026-01-01T00:00:00Z');
  const after = (text) => retryAfter(text, now);
  assert.deepEqual(
    ['3', '0', 'Thu, 01 Jan 2026 00:00:04 GMT', 'Thu, 01 Jan 2025 00:00:00 GMT', 'x', '-5', '', null].map(after),
    [3000, 0, 4000, 0, 0, 0, 0, 0],
  );
  const tags = (one, other) => differ(new Headers(one), new Headers(other));
  assert.ok(!tags({ etag: 'W/"a"' }, { etag: '"a"' }));
  assert.ok(!tags({ etag: '"a"' }, {}));
  assert.ok(!tags({ etag: '"a"', 'last-modified': 'x' }, { etag: 'W/"a"', 'last-modified': 'y' }));
  assert.ok(tags({ etag: '"a"' }, { etag: '"b"' }));
  assert.ok(tags({ 'last-modified': 'x' }, { 'last-modified': 'y' }));
  const { take, end } = judge(
    new Response('', { status: 206, headers: { 'content-range': 'bytes 5-9/20' } }),
    { start: 5, end: 8 },
    { url: '', size: 20 },
  );
  assert.deepEqual([take, end], ['part', 8]);
});
