// Run browser.html in headless Chromium: `node codec/js/test/browser.mjs [/usr/bin/chromium]`.
import { spawn } from 'node:child_process';
import { mkdtempSync, readFileSync, rmSync } from 'node:fs';
import { createServer } from 'node:http';
import { tmpdir } from 'node:os';
import { extname, join, normalize } from 'node:path';
import { fileURLToPath } from 'node:url';

const ROOT = fileURLToPath(new URL('../../../', import.meta.url));
const TYPES = { '.html': 'text/html', '.mjs': 'text/javascript', '.json': 'application/json' };
const LIMIT_MS = 120_000;

const profile = mkdtempSync(join(tmpdir(), 'csplat-chromium-'));
const server = createServer((request, response) => {
  if (request.url === '/result') return void collect(request).then(finish);
  const path = normalize(new URL(request.url, 'http://localhost').pathname);
  try {
    const body = readFileSync(join(ROOT, path));
    response.writeHead(200, { 'content-type': TYPES[extname(path)] ?? 'application/octet-stream' }).end(body);
  } catch {
    response.writeHead(404).end();
  }
});
await new Promise((ready) => server.listen(0, '127.0.0.1', ready));

const browser = spawn(
  process.argv[2] ?? 'chromium',
  [
    '--headless',
    '--no-sandbox',
    '--disable-gpu',
    '--disable-dev-shm-usage',
    '--disable-background-networking',
    '--disable-component-update',
    '--disable-sync',
    '--no-first-run',
    `--user-data-dir=${profile}`,
    `http://127.0.0.1:${server.address().port}/codec/js/test/browser.html`,
  ],
  { stdio: 'ignore' },
);
browser.on('error', (problem) => finish({ count: 0, failures: [`chromium: ${problem.message}`] }));
setTimeout(() => finish({ count: 0, failures: [`no result after ${LIMIT_MS / 1000} s`] }), LIMIT_MS).unref();

async function collect(request) {
  const parts = [];
  for await (const part of request) parts.push(part);
  return JSON.parse(Buffer.concat(parts).toString());
}

function finish({ count, failures }) {
  browser.removeAllListeners('error');
  browser.once('exit', async () => {
    await discard(profile);
    process.exit(failures.length || !count ? 1 : 0);
  });
  for (const failure of failures) console.error(failure);
  console.log(`chromium: ${count - failures.length} of ${count} vectors as expected`);
  if (!browser.kill()) browser.emit('exit');
}

// Chromium's helpers outlive it by a moment and write on into its profile; what cannot go decides no test.
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
