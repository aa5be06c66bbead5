// SPDX-License-Identifier: Apache-2.0
// All tests of the decoder, the encoder and the viewer in one process, which compiles the decoder once and takes half the time of one
// process per file: `node codec/js/test/all.mjs`, or with a report of each test `node --test-reporter=spec …`.
import { readdirSync } from 'node:fs';

for (const path of ['./', '../../js-encoder/test/', '../../../tools/viewer/test/']) {
  const folder = new URL(path, import.meta.url);
  for (const name of readdirSync(folder).sort()) {
    if (name.endsWith('.test.mjs')) await import(new URL(name, folder).href);
  }
}
