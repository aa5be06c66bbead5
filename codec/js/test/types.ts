// SPDX-License-Identifier: Apache-2.0
// Checks that decoder.mjs matches decoder.d.ts. Compiled, never run.

import * as implementation from '../decoder.mjs';
import type * as declared from '../decoder.d.ts';

export const functions: Pick<typeof declared, 'decode' | 'readHeader'> = implementation;
export const open: (...given: Parameters<typeof declared.CsplatReader.open>) => Promise<declared.CsplatReader> =
  implementation.CsplatReader.open;
export const error: declared.CsplatError = new implementation.CsplatError('E_CRC', 'found another');
export const isError: boolean =
  new implementation.LimitError('E_LIMIT', 'too large') instanceof implementation.CsplatError;
