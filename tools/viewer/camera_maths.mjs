// SPDX-License-Identifier: Apache-2.0
// Cameras for cull and shaders, with the conventions of the rasteriser (csplat_render/conventions.py).

/**
 * @typedef {import('./types.d.ts').Camera} Camera
 * @typedef {import('./types.d.ts').View} View
 */

export const DEFAULT_NEAR = 0.2;

const FLOAT_MAX = 3.4e38; // of binary32, rounded down

/** Added to both variances of the projected covariance, in square pixels. */
export const DILATION = 0.3;

/** Pixels that a splat covers with less than this alpha are skipped. */
export const ALPHA_MIN = 1 / 255;

/** Radius at which a splat of alpha 1 falls to ALPHA_MIN, in standard deviations. */
export const REACH_MAX = Math.sqrt(2 * Math.log(1 / ALPHA_MIN));

/** Camera of a canvas without a camera: only the background is drawn. */
export const NO_CAMERA = { viewmat: [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1], fx: 1, fy: 1, cx: 0, cy: 0 };

/**
 * Combine a camera with the size of its picture; all values are checked and copied.
 *
 * @param {Camera} camera
 * @param {number} width pixels
 * @param {number} height pixels
 * @returns {View}
 */
export function viewOf({ viewmat, fx, fy, cx, cy, near = DEFAULT_NEAR }, width, height) {
  const matrix = Array.from(viewmat, Number);
  if (matrix.length !== 16 || ![...matrix, fx, fy, cx, cy, near].every(Number.isFinite)) {
    throw new RangeError('a camera must have 16 finite numbers in viewmat and finite fx, fy, cx, cy and near');
  }
  if (!(fx > 0 && fy > 0 && near > 0)) throw new RangeError(`fx ${fx}, fy ${fy} and near ${near} must be positive`);
  return { viewmat: matrix, fx, fy, cx, cy, near, width, height };
}

/**
 * Convert a camera to another size of its picture, which shows all that the first one does.
 *
 * @template {{fx: number, fy: number, cx: number, cy: number}} T
 * @param {T} camera
 * @param {{width: number, height: number}} from pixels
 * @param {{width: number, height: number}} to
 * @returns {T}
 */
export function fitCamera(camera, from, to) {
  const k = fitScale(from, to);
  const cx = camera.cx * k + (to.width - from.width * k) / 2;
  const cy = camera.cy * k + (to.height - from.height * k) / 2;
  return { ...camera, fx: camera.fx * k, fy: camera.fy * k, cx, cy };
}

/**
 * Complete the size of a picture.
 *
 * @param {{width?: number, height?: number}} wanted pixels
 * @param {{width: number, height: number}} usual pixels; its shape is kept if one side is given
 */
export function completeSize({ width, height }, usual) {
  const across = width ?? Math.max(1, Math.round(((height ?? usual.height) * usual.width) / usual.height));
  return { width: across, height: height ?? Math.max(1, Math.round((across * usual.height) / usual.width)) };
}

/**
 * Return the scale at which a whole picture fits another size.
 *
 * @param {{width: number, height: number}} from
 * @param {{width: number, height: number}} to
 */
export const fitScale = (from, to) => Math.min(to.width / from.width, to.height / from.height);

/**
 * Transform a point from world to camera coordinates.
 *
 * @param {ArrayLike<number>} m viewmat
 * @param {ArrayLike<number>} p
 * @returns {[number, number, number]}
 */
export function toCamera(m, p) {
  return [
    m[0] * p[0] + m[1] * p[1] + m[2] * p[2] + m[3],
    m[4] * p[0] + m[5] * p[1] + m[6] * p[2] + m[7],
    m[8] * p[0] + m[9] * p[1] + m[10] * p[2] + m[11],
  ];
}

/**
 * Write the corners of tiles in camera coordinates, computed in binary64 to avoid jitter far from the origin, and their steps.
 *
 * @param {{corner: number[], step: number}[]} tiles
 * @param {ArrayLike<number>} viewmat
 * @param {Float32Array} out [4 × tiles]
 */
export function putCorners(tiles, viewmat, out) {
  for (const [tile, { corner, step }] of tiles.entries()) {
    const place = corner.map((n) => n * step);
    out.set([...toCamera(viewmat, place), Math.min(step, FLOAT_MAX)], 4 * tile);
  }
}

/**
 * Return the position of a camera: −Rᵀ t.
 *
 * @param {ArrayLike<number>} m viewmat
 * @returns {[number, number, number]}
 */
export function positionOf(m) {
  const back = (/** @type {number} */ k) => -(m[k] * m[3] + m[4 + k] * m[7] + m[8 + k] * m[11]);
  return [back(0), back(1), back(2)];
}
