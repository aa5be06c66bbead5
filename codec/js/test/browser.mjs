// SPDX-License-Identifier: Apache-2.0
// Run browser.html under two policies, in headless Chromium: `node codec/js/test/browser.mjs`; in other engines:
// `node codec/js/test/browser.mjs firefox-esr`, `xvfb-run -a node … /usr/lib/x86_64-linux-gnu/webkit2gtk-4.1/MiniBrowser`.
import { spawn } from 'node:child_process';
import { mkdtempSync, readFileSync, rmSync } from 'node:fs';
import { createServer } from 'node:http';
import { tmpdir } from 'node:os';
import { basename, extname, join, normalize } from 'node:path';
import { fileURLToPath } from 'node:url';

const ROOT = fileURLToPath(new URL('../../../', import.meta.url));
const PAGE = 'codec/js/test/browser.html';
const TYPES = { '.html': 'text/html', '.mjs': 'text/javascript', '.json': 'application/json' };
const LIMIT_MS = 120_000;

/** Content-Security-Policies, whether WebAssembly runs under them, and how many of two workers start. */
const PAGES = [
  { name: 'WebAssembly', policy: '', compiled: true, workers: 2 },
  { name: 'JavaScript', policy: "script-src 'self' 'unsafe-inline'; worker-src 'none'", compiled: false, workers: 0 },
];
const CHROMIUM = [
  '--headless',
  '--no-sandbox',
  '--disable-gpu',
  '--disable-dev-shm-usage',
  '--disable-background-networking',
  '--disable-component-update',
  '--disable-sync',
  '--no-first-run',
];

const program = process.argv[2] ?? 'chromium';
const engine = basename(program);
const profile = mkdtempSync(join(tmpdir(), 'csplat-browser-'));
const pages = [...PAGES];
let right = true;
const server = createServer(async (request, response) => {
  const [page] = pages;
  if (request.url === '/result') return report(response, page, await received(request));
  if (request.url === '/expected') return response.end(JSON.stringify(page));
  const path = normalize(new URL(request.url, 'http://localhost').pathname);
  try {
    const body = readFileSync(join(ROOT, path));
    const headers = { 'content-type': TYPES[extname(path)] ?? 'application/octet-stream', 'cache-control': 'no-store' };
    return response.writeHead(200, { ...headers, 'content-security-policy': page.policy }).end(body);
  } catch {
    return response.writeHead(404).end();
  }
});
await new Promise((ready) => server.listen(0, '127.0.0.1', ready));

const url = `http://127.0.0.1:${server.address().port}/${PAGE}`;
const words = engine.startsWith('firefox')
  ? ['--headless', '--no-remote', '--profile', profile, url]
  : engine === 'MiniBrowser'
    ? [url]
    : [...CHROMIUM, `--user-data-dir=${profile}`, url];
const browser = spawn(program, words, {
  stdio: 'ignore',
  env: { ...process.env, WEBKIT_DISABLE_SANDBOX_THIS_IS_DANGEROUS: '1' },
});
browser.on('error', (problem) => fail(problem.message));
setTimeout(() => fail(`no result after ${LIMIT_MS / 1000} s`), LIMIT_MS).unref();

async function received(request) {
  const parts = [];
  for await (const part of request) parts.push(part);
  return JSON.parse(Buffer.concat(parts).toString());
}

function report(response, { name }, { count, failures }) {
  for (const failure of failures) console.error(failure);
  console.log(`${engine}, ${name}: ${count} vectors, ${failures.length} failures`);
  right &&= count > 0 && failures.length === 0;
  pages.shift();
  response.end(JSON.stringify({ more: pages.length > 0 }));
  if (pages.length === 0) finish();
}

function fail(message) {
  console.error(`${engine}: ${message}`);
  right = false;
  finish();
}

function finish() {
  browser.removeAllListeners('error');
  browser.once('exit', async () => {
    await discard(profile);
    process.exit(right ? 0 : 1);
  });
  if (!browser.kill()) browser.emit('exit');
}

// A browser's helper processes may outlive it and write to its profile. A folder that cannot be removed fails no test.
async function discard(folder) {
  for (let attempt = 0; attempt < 20; attempt++) {
    try {
      return rmSync(folder, { recursive: true, force: true });
    } catch {
      await new Promise((later) => setTimeout(later, 250));
    }
  }
  console.error(`${folder} could not be removed`);
}
