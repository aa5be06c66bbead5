// SPDX-License-Identifier: Apache-2.0
// Lookups in the registry.

import * as spec from './spec.mjs';

/** Highest level of detail: the largest u8. */
export const LEVEL_MAX = 255;

/** Name of the highest resource level. */
export const HIGHEST_LEVEL = spec.RESOURCE_LEVEL_NAMES[spec.RESOURCE_LEVEL_C];

/**
 * Return the name of a registry entry.
 *
 * @template {string} T
 * @param {Record<number, T>} names
 * @param {number} id
 * @returns {T | undefined} undefined for reserved and unlisted ids
 */
export const nameOf = (names, id) => (Object.hasOwn(names, id) ? names[id] : undefined);

/**
 * Return what a header states about drawing that no renderer here does, in words; '' if there is nothing.
 *
 * @param {import('./decoder.d.ts').Header} header
 */
export function drawnOtherwise({ projection, colourSpace }) {
  const words = [];
  if (projection !== spec.PROJECTION_PERSPECTIVE) words.push(`the projection ${projection} is drawn in perspective`);
  if (colourSpace !== spec.COLOUR_SPACE_SRGB_REC709_DISPLAY) {
    words.push(`colours of ${nameOf(spec.COLOUR_SPACE_NAMES, colourSpace) ?? colourSpace} are drawn as sRGB`);
  }
  return words.join(', ');
}

/**
 * Return the flags that the registry assigns to a chunk type.
 *
 * @param {string} type a known type
 */
export function registeredFlags(type) {
  /** @type {readonly string[]} */
  const names = spec.CHUNK_FLAGS[/** @type {keyof typeof spec.CHUNK_FLAGS} */ (type)];
  let flags = 0;
  for (const bit of [spec.CHUNK_FLAG_CRITICAL, spec.CHUNK_FLAG_SAFE_TO_COPY]) {
    if (names.includes(nameOf(spec.CHUNK_FLAG_NAMES, bit) ?? '')) flags |= bit;
  }
  return flags;
}
