// SPDX-License-Identifier: Apache-2.0
// node --expose-gc node.mjs MODULE EXPORT FILE: prints "ready", then decodes once for each input line.

import { readFileSync } from 'node:fs';
import { createInterface } from 'node:readline';
import { pathToFileURL } from 'node:url';

import { once } from './timing.mjs';

const [module, name, file] = process.argv.slice(2);
const decode = await (await import(pathToFileURL(module)))[name]();
const bytes = new Uint8Array(readFileSync(file));
globalThis.gc();
console.log('ready');
for await (const _ of createInterface(process.stdin)) console.log((await once(decode, bytes)).join(' '));
