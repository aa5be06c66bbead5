// SPDX-License-Identifier: Apache-2.0
// Statistics of a scene and its frames.

/**
 * @typedef {import('./types.d.ts').Header} Header
 * @typedef {import('./types.d.ts').Stats} Stats
 */

/**
 * @param {import('./renderer.mjs').Capabilities} capabilities
 * @returns {Stats}
 */
export function emptyStats({ name, pictureFormat }) {
  return {
    splatCount: 0,
    splatsResident: 0,
    splatsDrawn: 0,
    fileSize: 0,
    received: 0,
    decodeMs: 0,
    sortMs: 0,
    cullMs: 0,
    frameMs: 0,
    fps: 0,
    gpuBytes: 0,
    workBytes: 0,
    gpuBytesPerSplat: 0,
    expandedBytesPerSplat: 0,
    firstPictureMs: 0,
    firstPictureBytes: 0,
    shDegree: 0,
    glRenderer: name,
    pictureFormat,
  };
}

/**
 * Return the bytes of a splat's attributes in binary32: means, quats, scales, alpha and colours.
 *
 * @param {number} shDegree
 */
export const expandedBytes = (shDegree) => 4 * (3 + 4 + 3 + 1 + 3 * (shDegree + 1) ** 2);

/**
 * Return the loaded share of what a view requires, 0 to 1.
 *
 * @param {import('./types.d.ts').Progress} progress
 */
export const loadedShare = ({ phase, received, missing }) => (phase === 'open' ? 0 : received / (received + missing));
