// SPDX-License-Identifier: Apache-2.0
// Centre, size and kind (object or surroundings) of a scene, from samples of its splats. Unlike the bounding box of all
// splats, they do not depend on a few distant ones.

/**
 * @typedef {import('./vectors.mjs').Vec3} Vec3
 * @typedef {Pick<import('./types.d.ts').Bounds, 'samples' | 'weights'>} Samples means [S, 3], and alpha times area [S]
 *
 * An object is viewed from outside. Surroundings extend much farther than their dense middle and are viewed from within or
 * near it. A room is viewed from inside.
 * @typedef {'object' | 'surroundings' | 'room'} Kind
 *
 * @typedef {object} Frame
 * @property {Kind} kind
 * @property {Vec3} centre
 * @property {number} extent unit of distances, above 0: half the diagonal of an object or a room; for surroundings, the
 *   distance from the centre within which half of them lies
 * @property {Vec3} half half the sides of the box of 5 to 95 % of the scene
 */

const FAR_REACH = 4; // times the median distance from the centre; an object does not extend beyond this
const FAR_SHARE = 0.02; // maximum share of an object's surface beyond it
const WALL = 0.08; // share of the side of a box; depth of a wall
const WALL_CELLS = 6; // per side of a wall
const WALL_COVER = 0.9; // minimum share of a wall's cells with samples, including its corners
const INNER_SHARE = 0.15; // maximum share of a room that is away from its walls

/**
 * Return quantiles of weighted values.
 *
 * @param {ArrayLike<number>} values
 * @param {ArrayLike<number>} weights same length, not all 0
 * @param {number[]} shares 0 to 1, ascending
 * @returns {number[]}
 */
export function quantiles(values, weights, shares) {
  const order = Uint32Array.from(values, (_, i) => i).sort((a, b) => values[a] - values[b]);
  let total = 0;
  for (let i = 0; i < values.length; i++) total += weights[i];
  let sum = 0;
  let at = 0;
  return shares.map((share) => {
    while (at < order.length - 1 && sum + weights[order[at]] < share * total) sum += weights[order[at++]];
    return values[order[at]];
  });
}

/**
 * @param {Samples} samples
 * @param {Vec3} up the nearest axis points from the floor to the ceiling of a room
 * @returns {Frame} of extent 1 around 0 if there are no samples
 */
export function findFrame({ samples, weights }, up) {
  const count = weights.length;
  if (!count) return { kind: 'object', centre: [0, 0, 0], extent: 1, half: [0.5, 0.5, 0.5] };
  const even = evened(weights);
  const axes = [0, 1, 2].map((k) => Float32Array.from({ length: count }, (_, i) => samples[3 * i + k]));
  const [low, middle, high] = transposed(axes.map((values) => quantiles(values, even, [0.05, 0.5, 0.95])));
  const half = /** @type {Vec3} */ (low.map((value, k) => (high[k] - value) / 2));
  const distances = Float32Array.from({ length: count }, (_, i) =>
    Math.hypot(...middle.map((value, k) => samples[3 * i + k] - value)),
  );
  const [reach] = quantiles(distances, even, [0.5]);
  const size = Math.hypot(...half);
  const extent = size > 0 ? size : Math.sqrt(Math.max(...even)) || 1; // one splat, or several at one position
  if (reach > 0 && farShare(distances, weights, reach) > FAR_SHARE) {
    return { kind: 'surroundings', centre: middle, extent: reach, half };
  }
  const centre = /** @type {Vec3} */ (low.map((value, k) => (value + high[k]) / 2));
  const kind = isRoom(samples, even, up) ? 'room' : 'object';
  return { kind, centre, extent, half };
}

/**
 * Limit weights so that none dominates a scene: large splats of the sky are not more important than others.
 *
 * @param {ArrayLike<number>} weights
 * @returns {Float32Array}
 */
export function evened(weights) {
  const positive = Float32Array.from(weights)
    .filter((weight) => weight > 0)
    .sort();
  if (!positive.length) return new Float32Array(weights.length).fill(1);
  const most = positive[positive.length >> 1];
  return Float32Array.from(weights, (weight) => Math.min(weight, most));
}

/**
 * Return the share of the surface that is far from the centre.
 *
 * @param {Float32Array} distances
 * @param {ArrayLike<number>} weights
 * @param {number} reach
 */
function farShare(distances, weights, reach) {
  const most = (0.5 * reach) ** 2; // one floater does not make a scene surroundings
  let all = 0;
  let far = 0;
  for (let i = 0; i < distances.length; i++) {
    const weight = Math.min(weights[i], most);
    all += weight;
    if (distances[i] > FAR_REACH * reach) far += weight;
  }
  return all > 0 ? far / all : 0;
}

/**
 * Return true for a room seen from inside: closed above, below and on at least three sides, and almost hollow. Objects
 * rarely have a bottom and rarely fill the corners of their box.
 *
 * @param {ArrayLike<number>} samples
 * @param {Float32Array} even
 * @param {Vec3} up
 */
function isRoom(samples, even, up) {
  const bounds = [0, 1, 2].map((k) =>
    quantiles(
      Float32Array.from(even, (_, i) => samples[3 * i + k]),
      even,
      [0.01, 0.99],
    ),
  );
  const walls = [0, 1, 2].map((axis) => [0, 1].map((side) => wallCover(samples, bounds, axis, side)));
  const sizes = up.map(Math.abs);
  const vertical = sizes.indexOf(Math.max(...sizes));
  if (Math.min(...walls[vertical]) < WALL_COVER) return false;
  const sides = walls.flatMap((pair, axis) => (axis === vertical ? [] : pair));
  return sides.filter((cover) => cover >= WALL_COVER).length >= 3 && innerShare(samples, even, bounds) < INNER_SHARE;
}

/**
 * Return the share of one side of a box that has samples close to it, 0 to 1.
 *
 * @param {ArrayLike<number>} samples
 * @param {number[][]} bounds low and high of each axis
 * @param {number} axis
 * @param {number} side 0 for the lower side, 1 for the upper
 */
function wallCover(samples, bounds, axis, side) {
  const [u, v] = [0, 1, 2].filter((k) => k !== axis);
  const cells = new Uint8Array(WALL_CELLS ** 2);
  const place = (/** @type {number} */ value, /** @type {number} */ k) =>
    (value - bounds[k][0]) / (bounds[k][1] - bounds[k][0] || 1);
  const cell = (/** @type {number} */ t) => Math.min(WALL_CELLS - 1, Math.max(0, Math.floor(t * WALL_CELLS)));
  for (let i = 0; i < samples.length; i += 3) {
    if (Math.abs(place(samples[i + axis], axis) - side) > WALL) continue;
    cells[cell(place(samples[i + u], u)) * WALL_CELLS + cell(place(samples[i + v], v))] = 1;
  }
  return cells.reduce((sum, one) => sum + one, 0) / cells.length;
}

/**
 * Return the share of a scene in the inner half of its box, along each axis.
 *
 * @param {ArrayLike<number>} samples
 * @param {Float32Array} even
 * @param {number[][]} bounds
 */
function innerShare(samples, even, bounds) {
  let inner = 0;
  let all = 0;
  for (let i = 0; i < even.length; i++) {
    all += even[i];
    const inside = bounds.every(([low, high], k) => {
      const t = (samples[3 * i + k] - low) / (high - low || 1);
      return t > 0.25 && t < 0.75;
    });
    if (inside) inner += even[i];
  }
  return inner / (all || 1);
}

/**
 * @param {number[][]} rows three of three
 * @returns {[Vec3, Vec3, Vec3]}
 */
const transposed = (rows) =>
  /** @type {[Vec3, Vec3, Vec3]} */ ([0, 1, 2].map((k) => /** @type {unknown} */ (rows.map((row) => row[k]))));
