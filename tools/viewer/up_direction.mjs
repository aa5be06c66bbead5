// SPDX-License-Identifier: Apache-2.0
// Up directions of scenes that do not specify theirs.

import { DEFAULT_AXES, directionOf } from '../../codec/js/first_view.mjs';
import { dot, length, sub, unit } from './vectors.mjs';

/** @typedef {import('./vectors.mjs').Vec3} Vec3 */

const SNAP = 0.94; // cosine of the angle within which the cameras' up direction snaps to an axis

/**
 * Return the up direction of photographs, which are usually taken with a level camera.
 *
 * @param {{viewmat: number[]}[]} cameras at least one
 * @returns {Vec3} snapped to a world axis if one is near
 */
export function upOfCameras(cameras) {
  let sum = /** @type {Vec3} */ ([0, 0, 0]);
  for (const { viewmat: m } of cameras) sum = sub(sum, [m[4], m[5], m[6]]);
  if (length(sum) < 0.1 * cameras.length) return directionOf(DEFAULT_AXES, 'U');
  const up = unit(sum);
  const sizes = up.map(Math.abs);
  const most = sizes.indexOf(Math.max(...sizes));
  if (sizes[most] < SNAP) return up;
  return /** @type {Vec3} */ ([0, 1, 2].map((k) => (k === most ? Math.sign(up[k]) : 0)));
}

/**
 * Return candidate up directions of a scene, likely ones first: those of COLMAP and PLY, then those of modelling programs.
 *
 * @param {Vec3} first the current up direction
 * @returns {Vec3[]} the six axes, preceded by `first` if it is not one of them
 */
export function waysUp(first) {
  /** @type {Vec3[]} */
  const all = [first, [0, -1, 0], [0, 0, 1], [0, 1, 0], [0, 0, -1], [1, 0, 0], [-1, 0, 0]];
  return all.filter((up, i) => all.findIndex((other) => dot(up, other) > 0.999) === i);
}
