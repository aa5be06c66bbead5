// Throughput of the JavaScript decoder.
//
//   node tools/benchmarks/csplat_bench/viewer/js_decode.mjs [--repeat 5] [--inflate stream] [--python .venv/bin/python] FILE.csplat ...
//
// Each file is decoded whole from memory, all checks included: once to warm up, then `repeat` times. Times are medians.
// With --python the same is done with csplat.decode in that interpreter, after the JavaScript.

import { execFileSync } from 'node:child_process';
import { readFileSync } from 'node:fs';
import { cpus } from 'node:os';
import { basename } from 'node:path';
import { parseArgs } from 'node:util';

import { decode } from '../../../../codec/js/decoder.mjs';
import { streamInflate } from '../../../../codec/js/inflate.mjs';

const { values, positionals: files } = parseArgs({
  allowPositionals: true,
  options: {
    repeat: { type: 'string', default: '5' },
    inflate: { type: 'string', default: 'zlib' },
    python: { type: 'string' },
    json: { type: 'boolean' },
  },
});
if (files.length === 0) {
  console.error('usage: js_decode.mjs [--repeat 5] [--inflate zlib|stream] [--python PYTHON] [--json] FILE.csplat ...');
  process.exit(2);
}
const options = values.inflate === 'stream' ? { inflate: await streamInflate() } : {};

/** @param {string} file */
async function measure(file) {
  const bytes = readFileSync(file);
  const seconds = [];
  let scene = await decode(bytes, options);
  for (let i = 0; i < Number(values.repeat); i++) {
    const start = performance.now();
    scene = await decode(bytes, options);
    seconds.push((performance.now() - start) / 1000);
  }
  seconds.sort((a, b) => a - b);
  const median = seconds[seconds.length >> 1];
  return { file: basename(file), splats: scene.count, shDegree: scene.shDegree, bytes: bytes.length, seconds: median };
}

const PYTHON = `
import statistics, sys, time
import csplat
data, seconds = open(sys.argv[1], "rb").read(), []
for _ in range(1 + int(sys.argv[2])):
    start = time.perf_counter()
    csplat.decode(data)
    seconds.append(time.perf_counter() - start)
print(statistics.median(seconds[1:]))
`;

/** Seconds that csplat.decode takes. @param {string} file */
const measurePython = (file) =>
  Number(execFileSync(values.python, ['-c', PYTHON, file, values.repeat], { encoding: 'utf8' }));

const rows = [];
for (const file of files) {
  const row = await measure(file);
  rows.push(values.python ? { ...row, pythonSeconds: measurePython(file) } : row);
}
if (values.json) {
  console.log(JSON.stringify(rows));
} else {
  console.log(`${cpus()[0].model}, Node ${process.versions.node}, ${values.inflate}, median of ${values.repeat}\n`);
  const head = [
    'file',
    'splats',
    'SH',
    'MB',
    'ms',
    'M splats/s',
    ...(values.python ? ['Python ms', 'M splats/s'] : []),
  ];
  console.log(`| ${head.join(' | ')} |\n|---|${'---:|'.repeat(head.length - 1)}`);
  for (const { file, splats, shDegree, bytes, seconds, pythonSeconds } of rows) {
    const speed = (/** @type {number} */ time) => [(1000 * time).toFixed(0), (splats / time / 1e6).toFixed(2)];
    const cells = [
      file,
      splats,
      shDegree,
      (bytes / 1e6).toFixed(2),
      ...speed(seconds),
      ...(pythonSeconds ? speed(pythonSeconds) : []),
    ];
    console.log(`| ${cells.join(' | ')} |`);
  }
}
