// SPDX-License-Identifier: Apache-2.0
// The chunks that describe a scene: META, CAMS, OPTS (spec 5.4) and SERR (5.5).

import { fault } from './errors.mjs';
import { Payload } from './payload.mjs';
import { nameOf } from './registry.mjs';
import * as spec from './spec.mjs';
import { readJson } from './streams.mjs';

const { ERROR_JSON, ERROR_RESERVED, ERROR_VALUE, DECLARED_ERRORS_HEAD_OFFSETS: AT_HEAD } = spec;
const AT = spec.DECLARED_ERROR_RECORD_OFFSETS;

/**
 * @typedef {import('./decoder.d.ts').DirectoryRecord} DirectoryRecord
 * @typedef {import('./decoder.d.ts').Description} Description
 * @typedef {import('./decoder.d.ts').DeclaredErrors} DeclaredErrors
 * @typedef {import('./inflate.mjs').Inflate} Inflate
 */

/** @type {() => Description} */
export const emptyDescription = () => ({ metadata: null, cameras: null, options: null, declaredErrors: null });

/**
 * Read an ancillary chunk of a known type and store its value in `into`.
 *
 * @param {Description} into
 * @param {DirectoryRecord} record
 * @param {Uint8Array<ArrayBuffer>} bytes payload
 * @param {{splatCount: number, jsonBytes: number, inflate: Inflate}} scene
 */
export async function describe(into, record, bytes, { splatCount, jsonBytes, inflate }) {
  const { type } = record;
  const base = record.offset + spec.CHUNK_HEADER_SIZE;
  if (type === spec.CHUNK_DECLARED_ERRORS) {
    into.declaredErrors = readDeclaredErrors(new Payload(bytes, base, 'SER-3'), splatCount);
    return;
  }
  const { value, offset } = await readJson(new Payload(bytes, base, 'JSN-2'), jsonBytes, inflate);
  if (type === spec.CHUNK_CAMERAS) {
    if (!Array.isArray(value) || !value.every(isObject))
      throw fault(ERROR_JSON, offset, 'JSN-1', 'CAMS is not an array of objects');
    into.cameras = value;
  } else {
    if (!isObject(value)) throw fault(ERROR_JSON, offset, 'JSN-1', `${type} is not an object`);
    into[type === spec.CHUNK_METADATA ? 'metadata' : 'options'] = value;
  }
}

/**
 * @param {unknown} value
 * @returns {value is Record<string, unknown>}
 */
const isObject = (value) => typeof value === 'object' && value !== null && !Array.isArray(value);

/**
 * @param {Payload} payload
 * @param {number} splatCount
 * @returns {DeclaredErrors}
 */
function readDeclaredErrors(payload, splatCount) {
  const { fields: head, offset } = payload.read(
    spec.unpackDeclaredErrorsHead,
    spec.DECLARED_ERRORS_HEAD_SIZE,
    {},
    'the head of SERR',
  );
  const { source_count: source, pruned_count: pruned } = head;
  // SER-4 compares integers, not integers modulo 2^64.
  if (source - pruned !== BigInt(splatCount)) {
    throw fault(ERROR_VALUE, offset, 'SER-4', `${source} splats minus ${pruned}, the file has ${splatCount}`);
  }
  if (head.error_flags & ~spec.ERROR_FLAG_REFITTED) {
    throw fault(
      ERROR_RESERVED,
      offset + AT_HEAD.error_flags,
      'RES-1',
      `flags ${head.error_flags} of the declared errors`,
    );
  }
  /** @type {DeclaredErrors} */
  const declared = {
    sourceCount: Number(source),
    prunedCount: Number(pruned),
    sourceShDegree: head.source_sh_degree,
    refitted: (head.error_flags & spec.ERROR_FLAG_REFITTED) !== 0,
    errors: {},
  };
  let last = 0;
  for (let i = 0; i < head.record_count; i++) last = readDeclaredError(payload, last, declared);
  payload.finish();
  return declared;
}

/**
 * @param {Payload} payload
 * @param {number} last measure of the previous record
 * @param {DeclaredErrors} declared
 * @returns {number} measure of this record
 */
function readDeclaredError(payload, last, declared) {
  const { fields, offset } = payload.read(
    spec.unpackDeclaredErrorRecord,
    spec.DECLARED_ERROR_RECORD_SIZE,
    spec.DECLARED_ERROR_RECORD_RESERVED,
    'a declared error',
  );
  const { measure, max, rms } = fields;
  const name = nameOf(spec.MEASURE_NAMES, measure);
  if (name === undefined || measure <= last)
    throw fault(ERROR_VALUE, offset, 'SER-1', `measure ${measure} after ${last}`);
  const components = Math.sqrt(measureComponents(measure));
  const room = 1 + 2 ** -20; // SER-2: the product from left to right
  const isBound = (/** @type {number} */ value) => value >= 0 && Number.isFinite(value);
  if (!(isBound(max) && isBound(rms) && rms <= max * components * room)) {
    throw fault(ERROR_VALUE, offset + AT.max, 'SER-2', `${name}: maximum ${max}, rms ${rms}`);
  }
  declared.errors[name] = { max, rms };
  return measure;
}

/**
 * Number of components of a measure (spec 5.5): 3 (2l + 1) for SH band l, 1 for the others.
 *
 * @param {number} measure
 */
const measureComponents = (measure) => (measure < spec.MEASURE_SH0 ? 1 : 3 * (2 * (measure - spec.MEASURE_SH0) + 1));
