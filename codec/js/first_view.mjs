// SPDX-License-Identifier: Apache-2.0
// The first view of a scene, for the viewer and the adapters for engines: the one in the file, or else an estimate from the
// boxes of its tiles. Header and metadata suffice, so it is known before any splat, and never changes while a scene loads.

/**
 * @typedef {import('./decoder.d.ts').Header} Header
 * @typedef {[number, number, number]} Vec3
 *
 * @typedef {object} FileCamera a camera of a camera file, of CAMS or of the key `view` of META
 * @property {number[]} viewmat 16 numbers, by rows: world to camera, x right, y down, z forward
 * @property {{fx: number, fy: number, cx: number, cy: number, W: number, H: number}} lens of a picture of W by H pixels
 * @property {number} near distance of the near plane, scene units
 *
 * @typedef {FileCamera & {from: string, isFound: boolean}} FirstView `from`: `training`, `estimate`, `author`, or '' if the file
 *   does not tell; `isFound`: true if the file has it, false for an estimate from boxes
 */

/** Axes of scenes that specify none. */
export const DEFAULT_AXES = 'RDF';

/** Near plane of cameras that specify none, scene units. */
const DEFAULT_NEAR = 0.2;
const NEAR_SHARE = 0.05; // near plane of an estimate in radii, at most DEFAULT_NEAR
const ROTATION_TOLERANCE = 1e-2; // maximum of the entries of R Rᵀ − 1; camera files have few digits
const HALF_FIELD = (25 * Math.PI) / 180; // of view of an estimate, radians; its picture is square
const ASIDE = 0.4; // radians away from the front, where an object looks less flat
const ELEVATION = 0.35; // radians above the horizon
const MARGIN = 1.05; // of an estimate's picture, divided by the boxes in it
const MOST = 0.9; // fraction of the splats that an estimate shows whole: some tiles hold far outliers

/** Letters of directions, as used in files, and their opposites. */
const OPPOSITE = /** @type {Record<string, string>} */ ({ R: 'L', L: 'R', U: 'D', D: 'U', F: 'B', B: 'F' });

/** @type {(a: ArrayLike<number>, b: ArrayLike<number>) => number} */
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
/** @type {(a: ArrayLike<number>, b: ArrayLike<number>) => Vec3} */
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
/** @type {(a: ArrayLike<number>) => Vec3} */
const unit = (a) => {
  const size = Math.hypot(a[0], a[1], a[2]) || 1;
  return [a[0] / size, a[1] / size, a[2] / size];
};

/**
 * Return the first view of a scene.
 *
 * @param {Header} header
 * @param {{metadata: Record<string, unknown> | null, cameras?: unknown}} description
 * @param {ArrayLike<number>} up the up direction, of length 1, for an estimate
 * @returns {FirstView}
 */
export function firstView(header, { metadata, cameras }, up) {
  const view = /** @type {any} */ (metadata?.view);
  for (const entry of [view, Array.isArray(cameras) ? cameras[0] : null]) {
    try {
      return { ...readCamera(entry), from: entry === view ? String(view.from ?? '') : 'training', isFound: true };
    } catch {} // an invalid view does not keep the scene from being shown
  }
  return { ...estimated(header, up), from: 'estimate', isFound: false };
}

/**
 * Return the position of a camera, and the point that it orbits if no surface is known: on its line of sight, as far away as
 * the middle of the scene.
 *
 * @param {FileCamera} camera
 * @param {{centre: ArrayLike<number>, radius: number}} ball
 * @returns {{eye: Vec3, distance: number}}
 */
export function eyeOf({ viewmat: m }, { centre, radius }) {
  const eye = /** @type {Vec3} */ ([0, 1, 2].map((k) => -(m[k] * m[3] + m[4 + k] * m[7] + m[8 + k] * m[11])));
  const depth = dot([m[8], m[9], m[10]], centre) + m[11];
  return { eye, distance: depth > 0.05 * radius ? depth : radius };
}

/**
 * Return a ball around most splats, from the boxes of tiles alone.
 *
 * @param {Pick<Header, 'tiles'>} header
 * @returns {{centre: Vec3, radius: number}} of radius 1 around 0 without splats; a radius above 0
 */
export function ballOf({ tiles }) {
  if (tiles.length === 0) return { centre: [0, 0, 0], radius: 1 };
  const counts = tiles.flatMap(({ splatCount }) => [splatCount, splatCount]);
  const centre = /** @type {Vec3} */ (
    [0, 1, 2].map((axis) => middle(tiles.flatMap(({ min, max }) => [min[axis], max[axis]]), counts))
  ); // prettier-ignore
  const corners = tiles.map(({ min, max }) => Math.hypot(...centre.map((c, k) => Math.max(c - min[k], max[k] - c))));
  const radius = quantile(corners, tiles.map(({ splatCount }) => splatCount), MOST); // prettier-ignore
  return { centre, radius: radius > 0 ? radius : 1 };
}

/**
 * Parse a camera of a camera file or of the chunk CAMS.
 *
 * @param {unknown} entry {K, viewmat, W, H, near}
 * @returns {FileCamera}
 */
export function readCamera(entry) {
  const { K, viewmat, W, H, near } = /** @type {Record<string, any>} */ (entry ?? {});
  const k = numbers(K, 3, 'K');
  const m = numbers(viewmat, 4, 'viewmat');
  if (m.slice(12).join() !== '0,0,0,1') {
    throw new TypeError(
      `the viewmat of a camera has the last row ${m.slice(12).join(' ')}, expected 0 0 0 1: transposed?`,
    );
  }
  if (!(W >= 1 && H >= 1 && k[0] > 0 && k[4] > 0)) throw new TypeError('a camera has no size or focal length');
  const rows = [0, 4, 8].map((at) => m.slice(at, at + 3));
  const bent = rows.some((a, i) => rows.some((b, j) => Math.abs(dot(a, b) - Number(i === j)) > ROTATION_TOLERANCE));
  if (bent || dot(cross(rows[0], rows[1]), rows[2]) < 0)
    throw new TypeError('the viewmat of a camera is not a rotation');
  const lens = { fx: k[0], fy: k[4], cx: k[2], cy: k[5], W: Number(W), H: Number(H) };
  return { viewmat: m, lens, near: near > 0 && Number.isFinite(near) ? Number(near) : DEFAULT_NEAR };
}

/**
 * @param {any} matrix
 * @param {number} size
 * @param {string} name
 * @returns {number[]} row by row
 */
function numbers(matrix, size, name) {
  const flat = Array.isArray(matrix) ? matrix.flat() : [];
  if (flat.length !== size * size || !flat.every((value) => Number.isFinite(value))) {
    throw new TypeError(`the ${name} of a camera is not ${size} × ${size} numbers`);
  }
  return flat.map(Number);
}

/**
 * Return the world direction of a letter of `axes`.
 *
 * @param {string} axes three letters, directions of +x, +y, +z
 * @param {string} letter
 * @returns {Vec3}
 */
export function directionOf(axes, letter) {
  const k = [...axes].findIndex((one) => one === letter || one === OPPOSITE[letter]);
  if (k < 0) throw new RangeError(`axes are ${axes}, expected one letter each of R or L, U or D, F or B`);
  const sign = axes[k] === letter ? 1 : -1;
  return /** @type {Vec3} */ ([0, 1, 2].map((i) => (i === k ? sign : 0)));
}

/**
 * Return a view from outside of the boxes with most splats, slightly beside their front and from above.
 *
 * @param {Header} header
 * @param {ArrayLike<number>} up
 * @returns {FileCamera}
 */
function estimated(header, up) {
  const { centre, radius } = ballOf(header);
  const front = directionOf(header.axes || DEFAULT_AXES, 'F');
  const level = Math.abs(dot(front, up)) < 0.9 ? front : directionOf(header.axes || DEFAULT_AXES, 'U');
  const right = unit(cross(level, up));
  const ahead = cross(up, right); // horizontal
  const [c, s] = [Math.cos(ELEVATION), Math.sin(ELEVATION)];
  const forward = [0, 1, 2].map((k) => c * (Math.cos(ASIDE) * ahead[k] - Math.sin(ASIDE) * right[k]) - s * up[k]);
  const across = unit(cross(forward, up));
  const rows = [across, cross(forward, across), forward];
  const distance = distanceOf(header, { centre, radius }, rows);
  const viewmat = [...rows.flatMap((row, i) => [...row, (i === 2 ? distance : 0) - dot(row, centre)]), 0, 0, 0, 1];
  const focal = 0.5 / Math.tan(HALF_FIELD);
  const lens = { fx: focal, fy: focal, cx: 0.5, cy: 0.5, W: 1, H: 1 };
  return { viewmat, lens, near: Math.min(DEFAULT_NEAR, NEAR_SHARE * radius) };
}

/**
 * Return the distance of a camera from the centre of a ball at which it sees all boxes within the ball.
 *
 * @param {Header} header
 * @param {{centre: Vec3, radius: number}} ball
 * @param {number[][]} rows right, down and forward
 */
function distanceOf({ tiles }, { centre, radius }, [right, down, forward]) {
  const slope = Math.tan(HALF_FIELD) / MARGIN;
  const reach = radius * (1 + Number.EPSILON * 8);
  let most = 0;
  for (const { min, max } of tiles) {
    for (let corner = 0; corner < 8; corner++) {
      const p = centre.map((c, k) => ((corner >> k) & 1 ? max[k] : min[k]) - c);
      const needed = Math.max(Math.abs(dot(right, p)), Math.abs(dot(down, p))) / slope - dot(forward, p);
      if (needed > most && Math.hypot(...p) <= reach) most = needed;
    }
  }
  return most || radius / slope;
}

/** @type {(values: number[], weights: number[]) => number} the weighted median: between both values that share it */
const middle = (values, weights) => (quantile(values, weights, 0.5) + quantile(values, weights, 0.5 + 1e-9)) / 2;

/**
 * Return the smallest value that at least a share of the weight does not exceed.
 *
 * @param {number[]} values at least one
 * @param {number[]} weights
 * @param {number} share
 */
function quantile(values, weights, share) {
  const order = values.map((_, i) => i).sort((a, b) => values[a] - values[b]);
  const wanted = share * weights.reduce((sum, weight) => sum + weight, 0);
  let sum = 0;
  return values[order.find((i) => (sum += weights[i]) >= wanted) ?? order[order.length - 1]];
}
