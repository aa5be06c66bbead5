// SPDX-License-Identifier: Apache-2.0
// Three-component vectors and rotations, for the page's cameras. All functions return new values.

/**
 * @typedef {[number, number, number]} Vec3
 * @typedef {[Vec3, Vec3, Vec3]} Basis rows: right, down and forward of a camera, in world coordinates
 * @typedef {[number, number, number, number]} Quat w x y z
 */

/** @type {(a: Vec3, b: Vec3) => Vec3} */
export const add = (a, b) => [a[0] + b[0], a[1] + b[1], a[2] + b[2]];

/** @type {(a: Vec3, b: Vec3) => Vec3} */
export const sub = (a, b) => [a[0] - b[0], a[1] - b[1], a[2] - b[2]];

/** @type {(a: Vec3, k: number) => Vec3} */
export const scale = (a, k) => [a[0] * k, a[1] * k, a[2] * k];

/** @type {(a: Vec3, b: Vec3) => number} */
export const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];

/** @type {(a: Vec3, b: Vec3) => Vec3} */
export const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];

/** @type {(a: Vec3) => number} */
export const length = (a) => Math.hypot(a[0], a[1], a[2]);

/** @type {(a: Vec3) => Vec3} */
export const unit = (a) => scale(a, 1 / (length(a) || 1));

/**
 * Normalise a direction from a file or address.
 *
 * @param {unknown} value
 * @returns {Vec3 | null} null if it is not three finite numbers, or all are 0
 */
export function unitDirection(value) {
  if (!Array.isArray(value) || value.length !== 3 || !value.every(Number.isFinite)) return null;
  const largest = Math.max(...value.map(Math.abs)); // squares of large values would be infinite
  return largest > 0 ? unit(/** @type {Vec3} */ (value.map((one) => one / largest))) : null;
}

/** @type {(a: Vec3, b: Vec3, t: number) => Vec3} */
export const mix = (a, b, t) => add(scale(a, 1 - t), scale(b, t));

/**
 * Rotate a vector around a unit axis (Rodrigues).
 *
 * @param {Vec3} v
 * @param {Vec3} axis
 * @param {number} angle radians, right-handed
 * @returns {Vec3}
 */
export function turn(v, axis, angle) {
  const c = Math.cos(angle);
  const s = Math.sin(angle);
  return add(add(scale(v, c), scale(cross(axis, v), s)), scale(axis, dot(axis, v) * (1 - c)));
}

/**
 * Rotate a whole basis and orthonormalise it.
 *
 * @param {Basis} basis
 * @param {Vec3} axis
 * @param {number} angle
 * @returns {Basis}
 */
export function turnBasis([right, , forward], axis, angle) {
  const ahead = unit(turn(forward, axis, angle));
  const down = unit(cross(ahead, turn(right, axis, angle)));
  return [cross(down, ahead), down, ahead];
}

/**
 * Return the basis of a camera that looks along a direction with `up` upwards in its picture.
 *
 * @param {Vec3} direction
 * @param {Vec3} up replaced by another direction if it is parallel to `direction`
 * @returns {Basis}
 */
export function lookAlong(direction, up) {
  const forward = unit(direction);
  let right = cross(forward, up);
  if (length(right) < 1e-6 * length(up)) right = cross(forward, across(forward));
  right = unit(right);
  return [right, cross(forward, right), forward];
}

/**
 * Return the world axis that is most perpendicular to a direction.
 *
 * @param {Vec3} direction
 * @returns {Vec3}
 */
export function across(direction) {
  const sizes = direction.map(Math.abs);
  const smallest = sizes.indexOf(Math.min(...sizes));
  return [Number(smallest === 0), Number(smallest === 1), Number(smallest === 2)];
}

/**
 * @param {Basis} basis
 * @returns {Quat} unit quaternion
 */
export function toQuat([[a, b, c], [d, e, f], [g, h, i]]) {
  const w = Math.max(0, 1 + a + e + i);
  const x = Math.max(0, 1 + a - e - i);
  const y = Math.max(0, 1 - a + e - i);
  const z = Math.max(0, 1 - a - e + i);
  const most = Math.max(w, x, y, z);
  /** @type {Quat} */
  let q = [w, h - f, c - g, d - b];
  if (most === x) q = [h - f, x, b + d, c + g];
  else if (most === y) q = [c - g, b + d, y, f + h];
  else if (most === z) q = [d - b, c + g, f + h, z];
  const size = Math.hypot(...q);
  return [q[0] / size, q[1] / size, q[2] / size, q[3] / size];
}

/**
 * @param {Quat} quat unit quaternion
 * @returns {Basis}
 */
export function toBasis([w, x, y, z]) {
  return [
    [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
    [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
    [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
  ];
}

/**
 * Interpolate between two rotations along the shorter way.
 *
 * @param {Quat} from
 * @param {Quat} to
 * @param {number} t 0 to 1
 * @returns {Quat}
 */
export function slerp(from, to, t) {
  let cosine = from[0] * to[0] + from[1] * to[1] + from[2] * to[2] + from[3] * to[3];
  const sign = cosine < 0 ? -1 : 1;
  cosine = Math.min(1, cosine * sign);
  const angle = Math.acos(cosine);
  const [p, q] = angle < 1e-4 ? [1 - t, t] : [Math.sin((1 - t) * angle), Math.sin(t * angle)];
  /** @type {(k: 0 | 1 | 2 | 3) => number} */
  const at = (k) => p * from[k] + q * sign * to[k];
  const size = Math.hypot(at(0), at(1), at(2), at(3));
  return [at(0) / size, at(1) / size, at(2) / size, at(3) / size];
}
