// SPDX-License-Identifier: Apache-2.0
// Reads a file as a page does whose workers fail: node failing_workers.mjs FILE WAY MOMENT TASK. Prints what came of it.
import { readFileSync } from 'node:fs';
import { Worker as Thread } from 'node:worker_threads';

const [, , path, way, moment, task] = process.argv;
const file = new Uint8Array(readFileSync(path));
const { log } = console;
const end = process.exit.bind(process);
let workers = 0;

/** A worker of a page, which is missing, forbidden or ends. */
class Failing extends EventTarget {
  constructor() {
    super();
    workers += 1;
    if (way === 'construction') throw new DOMException('forbidden', 'SecurityError');
    if (way === 'script') setTimeout(() => this.dispatchEvent(new Event('error')), 5);
    this.answers = 0;
  }

  postMessage(request) {
    const failure = {
      'first request': ['error', 0],
      'first answer': ['messageerror', 0],
      'second request': ['error', 1],
    }[way];
    if (way === 'third request' || (failure && this.answers < failure[1])) this.#pass(request);
    else if (failure) setTimeout(() => this.dispatchEvent(new Event(failure[0])), 1);
  }

  /** Answer by a thread; fail at the third request. */
  #pass(request) {
    this.thread ??= new Thread(new URL('../csplat-worker.mjs', import.meta.url)).on('message', (data) => {
      this.answers += 1;
      this.dispatchEvent(new MessageEvent('message', { data }));
    });
    if (this.answers < 2) this.thread.postMessage(request);
    else setTimeout(() => this.dispatchEvent(new Event('error')), 1);
  }

  terminate() {
    this.thread?.terminate();
  }
}

globalThis.Worker = Failing;
globalThis.process = undefined; // as in a page
const wait = globalThis.setTimeout;
globalThis.setTimeout = (use, ms, ...rest) => wait(use, way === 'silence' && ms > 1e4 ? 20 : ms, ...rest); // does not wait 15 s

const { CsplatReader, readHeader } = await import('../decoder.mjs');
const { LayerWorkers } = await import('../workers.mjs');
const first = Math.min(...readHeader(file).tiles.flatMap(({ layers }) => layers.map(({ offset }) => offset)));
const requested = new Map();
const source = {
  size: file.length,
  async read(offset, size) {
    for (let at = offset; at < offset + size; at++) requested.set(at, (requested.get(at) ?? 0) + 1);
    if (moment === 'before the tiles' && offset >= first) await new Promise((go) => wait(go, 60));
    return file.slice(offset, offset + size);
  },
};
const reader = await CsplatReader.open(source);
let splats = 0;
if (task === 'tiles') {
  for await (const { means } of reader.readTiles({ workers: 2, shDegree: 0 })) splats += means.length / 3;
} else {
  const layers = new LayerWorkers(reader);
  for (const tile of reader.header.tiles) splats += (await layers.read(tile, 0)).opacities ? tile.splatCount : 0;
  layers.close();
}
const chunks = reader.header.tiles.map(({ layers }) => requested.get(layers[0].offset));
log(splats === reader.header.splatCount ? 'all splats' : `${splats} splats`, Math.max(...chunks), workers);
end(0);
