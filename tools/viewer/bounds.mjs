// SPDX-License-Identifier: Apache-2.0
// Bounds of a scene: from the boxes of its tiles first, then from samples of its splats when layer 0 has arrived.

/**
 * @typedef {import('../../codec/js/decoder.d.ts').Header} Header
 * @typedef {import('./types.d.ts').Bounds} Bounds
 * @typedef {[number, number, number]} Point
 */

/** Approximate number of splats sampled from a scene. */
export const SAMPLE_COUNT = 20_000;

/** Share of the visible weight within the radius. */
const SHARE = 0.9;

/** Log-scales are clamped to this magnitude. */
const LOG_SCALE_LIMIT = 60;

/**
 * Return bounds from the boxes of tiles.
 *
 * @param {Header} header
 * @returns {Bounds}
 */
export function coarseBounds({ tiles }) {
  const samples = new Float32Array(6 * tiles.length);
  const weights = new Float32Array(2 * tiles.length);
  tiles.forEach(({ min, max, splatCount }, i) => {
    samples.set(min, 6 * i);
    samples.set(max, 6 * i + 3);
    weights.fill(splatCount, 2 * i, 2 * i + 2);
  });
  return { ...boundsOf(samples, weights), ...box(tiles), coarse: true };
}

/**
 * Return bounds from samples of splats.
 *
 * @param {Header} header
 * @param {Float32Array} samples [S, 3]
 * @param {Float32Array} weights [S]
 * @returns {Bounds}
 */
export function fineBounds({ tiles }, samples, weights) {
  return { ...boundsOf(samples, weights), ...box(tiles), coarse: false };
}

/**
 * Return the visibility weight of a splat: roughly the square root of alpha times the area of its ellipse.
 *
 * @param {number} alpha
 * @param {number} a larger log-scale; `b` is the second largest
 * @param {number} b
 */
export function showing(alpha, a, b) {
  const area = Math.min(LOG_SCALE_LIMIT, Math.max(-LOG_SCALE_LIMIT, a + b));
  return Math.sqrt(alpha * Math.exp(area));
}

/** @param {{min: number[], max: number[]}[]} tiles */
function box(tiles) {
  /** @type {Point} */
  const boxMin = [0, 0, 0];
  /** @type {Point} */
  const boxMax = [0, 0, 0];
  for (let axis = 0; axis < 3 && tiles.length; axis++) {
    boxMin[axis] = tiles.reduce((least, { min }) => Math.min(least, min[axis]), Infinity);
    boxMax[axis] = tiles.reduce((most, { max }) => Math.max(most, max[axis]), -Infinity);
  }
  return { boxMin, boxMax };
}

/**
 * @param {Float32Array} samples
 * @param {Float32Array} weights
 */
function boundsOf(samples, weights) {
  const count = weights.length;
  /** @type {Point} */
  const centre = [0, 0, 0];
  const values = new Float64Array(count);
  for (let axis = 0; axis < 3; axis++) {
    for (let i = 0; i < count; i++) values[i] = samples[3 * i + axis];
    centre[axis] = weightedQuantile(values, weights, 0.5);
  }
  for (let i = 0; i < count; i++) {
    values[i] = Math.hypot(samples[3 * i] - centre[0], samples[3 * i + 1] - centre[1], samples[3 * i + 2] - centre[2]);
  }
  return { centre, radius: weightedQuantile(values, weights, SHARE), samples, weights };
}

/**
 * Return the smallest value that at least a share of the weight does not exceed; 0 without values.
 *
 * @param {Float64Array} values
 * @param {Float32Array} weights not negative
 * @param {number} share
 */
export function weightedQuantile(values, weights, share) {
  const order = Uint32Array.from(values, (_, i) => i).sort((a, b) => values[a] - values[b]);
  const total = weights.reduce((sum, weight) => sum + weight, 0);
  let sum = 0;
  for (const i of order) {
    sum += weights[i];
    if (sum >= share * total) return values[i];
  }
  return 0;
}
