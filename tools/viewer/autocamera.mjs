// SPDX-License-Identifier: Apache-2.0
// The initial view: from a camera of the file, or from an automatic camera.

import { evened, findFrame, quantiles } from './bounding_frame.mjs';
import { OrbitCamera, defaultLens } from './orbit_camera.mjs';
import { ROUGH, detail, pick, thinned } from './rough_view.mjs';
import { across, add, cross, dot, length, lookAlong, scale, sub, turn, unit } from './vectors.mjs';

/**
 * @typedef {import('./bounding_frame.mjs').Frame} Frame
 * @typedef {import('./bounding_frame.mjs').Samples} Samples
 * @typedef {import('./orbit_camera.mjs').Lens} Lens
 * @typedef {import('./orbit_camera.mjs').Pose} Pose
 * @typedef {import('./vectors.mjs').Basis} Basis
 * @typedef {import('./vectors.mjs').Vec3} Vec3
 */

/** Near plane of cameras that specify none, scene units. */
export const DEFAULT_NEAR = 0.2;

/** Axes of scenes that specify none. */
export const DEFAULT_AXES = 'RDF';

const NEAR_SHARE = 0.05; // near plane in extents, at most DEFAULT_NEAR
const FIT_SHARE = 0.995; // share of an object's samples inside each side of the initial view
const FIT_STEPS = 4;
const MARGIN = 1.08;
const ELEVATION = 0.3; // radians above the horizon, for views of an object
const AZIMUTHS = 12; // number of directions tried
const ROOM_ELEVATION = 0.12;
const ASIDE = 0.4; // radians away from the front, where an object looks less flat
const BESIDE = 0.8; // weight of the detail of other sides, compared with the front
const SURROUNDINGS = { elevations: [0.05, 0.25, 0.6], distances: [1.3, 0.8, 0.5] };
const NEARER = 0.9; // weight of the detail of a view, compared with the next farther one
const HIDING = 0.4; // extents; samples nearer to a camera in surroundings only occlude
const JUDGED = 3000; // maximum number of samples used to compare views
const SNAP = 0.94; // cosine of the angle within which the cameras' up direction snaps to an axis
const ROTATION_TOLERANCE = 1e-2; // maximum of the entries of R Rᵀ − 1; camera files have few digits

/** Letters of directions, as used in files, and their opposites. */
const OPPOSITE = /** @type {Record<string, string>} */ ({ R: 'L', L: 'R', U: 'D', D: 'U', F: 'B', B: 'F' });

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
 * Parse a camera of a camera file or of the chunk CAMS.
 *
 * @param {unknown} entry {K, viewmat, W, H, near}
 * @returns {{viewmat: number[], lens: Lens, near: number}}
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
  const rows = [0, 4, 8].map((at) => /** @type {Vec3} */ (m.slice(at, at + 3)));
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
 * Return the pose of a camera from a camera file. Its pivot is on the surface it looks at.
 *
 * @param {ReturnType<typeof readCamera>} camera
 * @param {Samples} samples
 * @param {Frame} frame
 * @param {Vec3} up
 * @returns {Pose}
 */
export function cameraPose({ viewmat: m, lens, near }, samples, frame, up) {
  const basis = /** @type {Basis} */ ([0, 4, 8].map((at) => m.slice(at, at + 3)));
  const eye = /** @type {Vec3} */ ([0, 1, 2].map((k) => -(m[k] * m[3] + m[4 + k] * m[7] + m[8 + k] * m[11])));
  const seen = pick(samples, { viewmat: m, ...lens, near }, lens.W / 2, lens.H / 2);
  const depths = [seen, frame.centre].map((point) => (point ? dot(sub(point, eye), basis[2]) : 0));
  const distance = depths.find((depth) => depth > 0.05 * frame.extent) ?? frame.extent;
  return { basis, eye, distance, up, lens, near, viewmat: m };
}

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

/**
 * Find a pose that shows the scene.
 *
 * @param {Samples} samples
 * @param {number} splatCount number of splats in the scene
 * @param {{up: Vec3, front: Vec3, isFrontKnown: boolean}} ways `front` is the viewing direction of a view from the front;
 *   if it is not known, views of other sides may show more
 * @returns {{pose: Pose, frame: Frame}}
 */
export function automaticPose(samples, splatCount, { up, front, isFrontKnown }) {
  const frame = findFrame(samples, up);
  const ahead = unit(sub(front, scale(up, dot(front, up))));
  const near = Math.min(DEFAULT_NEAR, NEAR_SHARE * frame.extent);
  /** @type {(direction: Vec3, distance: number, centre?: Vec3) => Pose} */
  const from = (direction, distance, centre = frame.centre) => {
    const basis = lookAlong(direction, up);
    return { basis, distance, eye: sub(centre, scale(basis[2], distance)), up, lens: defaultLens(), near };
  };
  const few = thinned(samples, JUDGED);
  const views = candidates(frame, (elevation) => around(ahead, up, elevation));
  if (frame.kind === 'object' && isFrontKnown) views.length = 1;
  const standsFor = splatCount / few.weights.length;
  const hiding = frame.kind === 'object' ? 0 : HIDING * frame.extent;
  let [best] = views;
  let most = -1;
  for (const view of views.length > 1 ? views : []) {
    const camera = new OrbitCamera(from(view.direction, view.distance), frame.extent).camera(ROUGH.width, ROUGH.height);
    const score = view.weight * detail(few, standsFor, camera, hiding);
    if (score > most) [best, most] = [view, score];
  }
  const { direction } = best;
  if (frame.kind !== 'object') return { pose: from(direction, best.distance), frame };
  const { centre, distance } = fitted(few, frame, lookAlong(direction, up));
  return { pose: from(direction, distance, centre), frame };
}

/**
 * Return candidates for the initial view, preferred ones first.
 *
 * @param {Frame} frame
 * @param {(elevation: number) => Vec3[]} around returns viewing directions, the front first
 * @returns {{direction: Vec3, distance: number, weight: number}[]} distances from the centre of the frame
 */
function candidates({ kind, extent, half }, around) {
  if (kind === 'object') {
    return around(ELEVATION).map((direction, i) => ({ direction, distance: 2.2 * extent, weight: i ? BESIDE : 1 }));
  }
  if (kind === 'room') {
    return around(ROOM_ELEVATION).map((direction) => {
      const reach = Math.min(...half.map((side, k) => side / (Math.abs(direction[k]) || 1e-9)));
      return { direction, distance: 0.5 * reach, weight: 1 };
    });
  }
  return SURROUNDINGS.distances.flatMap((distance, nearer) =>
    SURROUNDINGS.elevations.flatMap((elevation) =>
      around(elevation).map((direction) => ({ direction, distance: distance * extent, weight: NEARER ** nearer })),
    ),
  );
}

/**
 * Return viewing directions all around, starting slightly to the side of the front.
 *
 * @param {Vec3} ahead horizontal
 * @param {Vec3} up
 * @param {number} elevation radians
 */
function around(ahead, up, elevation) {
  const step = (2 * Math.PI) / AZIMUTHS;
  return Array.from({ length: AZIMUTHS }, (_, i) => tilted(ahead, up, ASIDE + step * i, elevation));
}

/**
 * Return a direction turned to the right around the scene, and downwards.
 *
 * @param {Vec3} ahead horizontal
 * @param {Vec3} up
 * @param {number} azimuth radians
 * @param {number} elevation radians, of the camera above its target
 */
function tilted(ahead, up, azimuth, elevation) {
  const level = turn(ahead, up, azimuth);
  return add(scale(level, Math.cos(elevation)), scale(up, -Math.sin(elevation)));
}

/**
 * Find the nearest position from which an object fits a square picture.
 *
 * @param {Samples} scene a small number of samples
 * @param {Frame} frame
 * @param {Basis} basis
 * @returns {{centre: Vec3, distance: number}} the target, and the distance from it
 */
function fitted(scene, { centre, extent }, [right, down, forward]) {
  const { samples, weights } = scene;
  const even = evened(weights);
  const wanted = 0.5 / defaultLens().fx / MARGIN;
  let distance = 2.2 * extent;
  if (!weights.length) return { centre, distance };
  for (let i = 0; i < FIT_STEPS; i++) {
    const points = Array.from(even, (_, k) => sub([samples[3 * k], samples[3 * k + 1], samples[3 * k + 2]], centre));
    const depths = points.map((point) => Math.max(dot(point, forward) + distance, 0.1 * distance));
    const sides = [right, down].map((axis) =>
      quantiles(
        points.map((point, k) => dot(point, axis) / depths[k]),
        even,
        [1 - FIT_SHARE, FIT_SHARE],
      ),
    );
    const [aside, below] = sides.map(([low, high]) => ((low + high) / 2) * distance);
    centre = add(centre, add(scale(right, aside), scale(down, below)));
    const size = Math.max(...sides.map(([low, high]) => (high - low) / 2));
    distance = Math.min(Math.max(distance * (size / wanted), 0.5 * extent), 4 * extent);
  }
  return { centre, distance };
}

/**
 * Return the direction towards the front for an up direction that the scene does not specify.
 *
 * @param {string} axes
 * @param {Vec3} up
 * @returns {Vec3}
 */
export function frontFor(axes, up) {
  const front = directionOf(axes, 'F');
  return Math.abs(dot(front, up)) < 0.9 ? front : across(up);
}
