// SPDX-License-Identifier: Apache-2.0
// All tests of the decoder and the viewer in one process, which compiles the decoder once and takes half the time of one
// process per file: `node codec/js/test/all.mjs`, or with a report of each test `node --test-reporter=spec …`.
import { readdirSync } from 'node:fs';

for (const folder of [new URL('./', import.meta.url), new URL('../../../tools/viewer/test/', import.meta.url)]) {
  for (const name of readdirSync(folder).sort()) {
    if (name.endsWith('.test.mjs')) await import(new URL(name, folder).href);
  }
}
