// SPDX-License-Identifier: Apache-2.0
// The point of a scene under a pixel, from samples of its splats.

/**
 * @typedef {Pick<import('./types.d.ts').Bounds, 'samples' | 'weights'>} Samples means [S, 3], and their weights [S]
 * @typedef {import('./orbit_camera.mjs').EngineCamera} EngineCamera
 * @typedef {import('./vectors.mjs').Vec3} Vec3
 */

const PICK_RADII = [6, 14, 30, 60]; // pixels around the pointer, increased until there are enough samples
const PICK_ENOUGH = 12; // minimum number of samples, so that the point is not on the background
const PICK_SHARE = 0.25; // quantile of the depths around the pointer that is picked

/**
 * Return the point of a scene under the pointer.
 *
 * @param {Samples} scene
 * @param {EngineCamera} camera
 * @param {number} x pixels
 * @param {number} y pixels
 * @returns {Vec3 | null} a point on the ray through the pixel; null if there is none
 */
export function pick(scene, camera, x, y) {
  for (const radius of PICK_RADII) {
    const last = radius === PICK_RADII[PICK_RADII.length - 1];
    const depth = depthAround(scene, camera, x, y, radius, last ? 1 : PICK_ENOUGH);
    if (depth === null) continue;
    const { viewmat: m, fx, fy, cx, cy } = camera;
    const inCamera = [((x - cx) / fx) * depth - m[3], ((y - cy) / fy) * depth - m[7], depth - m[11]];
    const [a, b, c] = inCamera;
    return [m[0] * a + m[4] * b + m[8] * c, m[1] * a + m[5] * b + m[9] * c, m[2] * a + m[6] * b + m[10] * c];
  }
  return null;
}

/**
 * Return the depth of the nearest surface around a pixel, ignoring floaters.
 *
 * @param {Samples} scene
 * @param {EngineCamera} camera
 * @param {number} x
 * @param {number} y
 * @param {number} radius pixels
 * @param {number} enough minimum number of samples
 * @returns {number | null} scene units along the line of sight
 */
function depthAround({ samples, weights }, { viewmat: m, fx, fy, cx, cy, near }, x, y, radius, enough) {
  /** @type {{z: number, weight: number}[]} */
  const found = [];
  let total = 0;
  for (let i = 0; i < weights.length; i++) {
    const [px, py, pz] = [samples[3 * i], samples[3 * i + 1], samples[3 * i + 2]];
    const z = m[8] * px + m[9] * py + m[10] * pz + m[11];
    if (z <= near) continue;
    const dx = (fx * (m[0] * px + m[1] * py + m[2] * pz + m[3])) / z + cx - x;
    const dy = (fy * (m[4] * px + m[5] * py + m[6] * pz + m[7])) / z + cy - y;
    if (dx * dx + dy * dy > radius * radius) continue;
    const weight = Math.min((weights[i] * fx * fy) / (z * z), Math.PI * radius * radius);
    found.push({ z, weight });
    total += weight;
  }
  if (found.length < enough) return null;
  found.sort((a, b) => a.z - b.z);
  let sum = 0;
  for (const { z, weight } of found) {
    sum += weight;
    if (sum >= PICK_SHARE * total) return z;
  }
  return found[found.length - 1].z;
}
