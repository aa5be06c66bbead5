// SPDX-License-Identifier: Apache-2.0
// Coarse renders of samples of a scene: how much detail a view shows, and the depth under a pixel.

/**
 * @typedef {import('./bounding_frame.mjs').Samples} Samples
 * @typedef {import('./orbit_camera.mjs').EngineCamera} EngineCamera
 * @typedef {import('./vectors.mjs').Vec3} Vec3
 */

const COLUMNS = 32; // width of a coarse render
const ROWS = 24;
const FINE = 4; // pixels in a picture of width 640; splats up to this size count fully
const PICK_RADII = [6, 14, 30, 60]; // pixels around the pointer, increased until there are enough samples
const PICK_ENOUGH = 12; // minimum number of samples, so that the point is not on the background
const PICK_SHARE = 0.25; // quantile of the depths around the pointer that is picked

/**
 * Take every Nth sample, to compare many views quickly.
 *
 * @param {Samples} samples
 * @param {number} most maximum number of samples
 * @returns {Samples}
 */
export function thinned({ samples, weights }, most) {
  const step = Math.max(1, Math.ceil(weights.length / most));
  const count = Math.floor((weights.length + step - 1) / step);
  const thin = { samples: new Float32Array(3 * count), weights: new Float32Array(count) };
  for (let i = 0; i < count; i++) {
    thin.samples.set(samples.subarray(3 * step * i, 3 * step * i + 3), 3 * i);
    thin.weights[i] = weights[step * i];
  }
  return thin;
}

/**
 * Return the share of a picture, 0 to 1, that shows fine splats with nothing in front of them. Views unlike those of the
 * photographs show large, smeared splats, or are occluded by something close.
 *
 * @param {Samples} scene
 * @param {number} standsFor number of splats that a sample represents
 * @param {EngineCamera} camera camera of a picture of COLUMNS by ROWS pixels
 * @param {number} nearest samples nearer than this occlude without showing detail, scene units
 */
export function detail({ samples, weights }, standsFor, { viewmat: m, fx, fy, cx, cy, near }, nearest) {
  const count = weights.length;
  const cells = new Uint16Array(count);
  const depths = new Float32Array(count);
  const order = new Uint32Array(count);
  let inside = 0;
  for (let i = 0, at = 0; i < count; i++, at += 3) {
    const [x, y, z] = [samples[at], samples[at + 1], samples[at + 2]];
    const depth = m[8] * x + m[9] * y + m[10] * z + m[11];
    if (depth <= near) continue;
    const column = Math.floor((fx * (m[0] * x + m[1] * y + m[2] * z + m[3])) / depth + cx);
    const row = Math.floor((fy * (m[4] * x + m[5] * y + m[6] * z + m[7])) / depth + cy);
    if (column < 0 || column >= COLUMNS || row < 0 || row >= ROWS) continue;
    cells[i] = row * COLUMNS + column;
    depths[i] = depth;
    order[inside++] = i;
  }
  const before = new Float32Array(COLUMNS * ROWS);
  let sum = 0;
  for (const i of order.subarray(0, inside).sort((a, b) => depths[a] - depths[b])) {
    const area = (weights[i] * fx * fy) / depths[i] ** 2; // in cells
    const size = (640 / COLUMNS) * Math.sqrt(area);
    const fine = depths[i] >= nearest ? FINE / Math.max(size, FINE) : 0;
    // a large splat occludes all the cells that it covers: a wall may consist of a few
    const side = Math.max(1, Math.round(Math.sqrt(area)));
    const top = Math.floor(cells[i] / COLUMNS) - (side >> 1);
    const left = (cells[i] % COLUMNS) - (side >> 1);
    for (let y = Math.max(0, top); y < Math.min(ROWS, top + side); y++) {
      for (let x = Math.max(0, left); x < Math.min(COLUMNS, left + side); x++) {
        const cell = y * COLUMNS + x;
        const hidden = Math.exp(-before[cell]);
        before[cell] += (area * standsFor) / side ** 2;
        sum += (hidden - Math.exp(-before[cell])) * fine;
      }
    }
  }
  return sum / (COLUMNS * ROWS);
}

/** Size of the coarse renders. */
export const ROUGH = { width: COLUMNS, height: ROWS };

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
