// The first picture: from a camera of the file, or from one that finds the scene by itself.

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

/** Near plane where a camera does not say another, scene units. */
export const DEFAULT_NEAR = 0.2;

/** Axes that a scene is shown with where it does not name its own. */
export const DEFAULT_AXES = 'RDF';

const NEAR_SHARE = 0.05; // near plane in extents, DEFAULT_NEAR at most
const FIT_SHARE = 0.995; // of an object lies to the left of the right side of its first picture, and so on
const FIT_STEPS = 4;
const MARGIN = 1.08;
const ELEVATION = 0.3; // radians above the horizon, from which an object is seen
const AZIMUTHS = 12; // directions that are tried
const ROOM_ELEVATION = 0.12;
const ASIDE = 0.4; // radians beside the front, from where an object looks less flat
const BESIDE = 0.8; // the detail of another side counts this much less than that of the front
const SURROUNDINGS = { elevations: [0.05, 0.25, 0.6], distances: [1.3, 0.8, 0.5] };
const NEARER = 0.9; // the detail of a nearer view counts this much less than that of the next farther one
const HIDING = 0.4; // extents; what is nearer to a camera in surroundings only hides
const JUDGED = 3000; // samples that many views are judged by
const SNAP = 0.94; // cosine of the angle between the cameras' upward direction and an axis that is taken for it
const ROTATION_TOLERANCE = 1e-2; // of the entries of R Rᵀ − 1; camera files hold few digits

/** Names of directions, as they stand in a file, by what they are the opposite of. */
const OPPOSITE = /** @type {Record<string, string>} */ ({ R: 'L', L: 'R', U: 'D', D: 'U', F: 'B', B: 'F' });

/**
 * The direction in the world of a letter of `axes`.
 *
 * @param {string} axes three letters, directions of +x, +y, +z
 * @param {string} letter
 * @returns {Vec3}
 */
export function directionOf(axes, letter) {
  const k = [...axes].findIndex((one) => one === letter || one === OPPOSITE[letter]);
  if (k < 0) throw new RangeError(`axes are ${axes}, wanted one letter each of R or L, U or D, F or B`);
  const sign = axes[k] === letter ? 1 : -1;
  return /** @type {Vec3} */ ([0, 1, 2].map((i) => (i === k ? sign : 0)));
}

/**
 * A camera of a camera file, or of the chunk CAMS.
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
  if (!(W >= 1 && H >= 1 && k[0] > 0 && k[4] > 0)) throw new TypeError('a camera has no size or no focal length');
  const rows = [0, 4, 8].map((at) => /** @type {Vec3} */ (m.slice(at, at + 3)));
  const bent = rows.some((a, i) => rows.some((b, j) => Math.abs(dot(a, b) - Number(i === j)) > ROTATION_TOLERANCE));
  if (bent || dot(cross(rows[0], rows[1]), rows[2]) < 0) throw new TypeError('the viewmat of a camera is no rotation');
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
 * The pose of a camera file's camera. What it turns around is what it looks at.
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
 * Which way is up for people who took pictures: they hold their cameras level.
 *
 * @param {{viewmat: number[]}[]} cameras at least one
 * @returns {Vec3} the nearest axis of the world where one is near
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
 * Ways up that a scene may have, the likely ones first: COLMAP's and PLY's, then those of programs that model.
 *
 * @param {Vec3} first the present one
 * @returns {Vec3[]} all six axes, or seven
 */
export function waysUp(first) {
  /** @type {Vec3[]} */
  const all = [first, [0, -1, 0], [0, 0, 1], [0, 1, 0], [0, 0, -1], [1, 0, 0], [-1, 0, 0]];
  return all.filter((up, i) => all.findIndex((other) => dot(up, other) > 0.999) === i);
}

/**
 * A camera that finds the scene by itself.
 *
 * @param {Samples} samples
 * @param {number} splatCount of the scene
 * @param {{up: Vec3, front: Vec3, isFrontKnown: boolean}} ways `front` is where a person looks who sees the scene from
 *   its front; where that is not known, another side may show more
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
 * Views that the first picture may show, the preferred ones first.
 *
 * @param {Frame} frame
 * @param {(elevation: number) => Vec3[]} around directions to look in, the front first
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
 * Directions all around, from beside the front.
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
 * A direction turned to the right of the scene, and downwards.
 *
 * @param {Vec3} ahead horizontal
 * @param {Vec3} up
 * @param {number} azimuth radians
 * @param {number} elevation radians, of the camera above what it looks at
 */
function tilted(ahead, up, azimuth, elevation) {
  const level = turn(ahead, up, azimuth);
  return add(scale(level, Math.cos(elevation)), scale(up, -Math.sin(elevation)));
}

/**
 * Come so near, and step aside so far, that an object fills a square picture.
 *
 * @param {Samples} scene not too many of them
 * @param {Frame} frame
 * @param {Basis} basis
 * @returns {{centre: Vec3, distance: number}} what to look at, and from how far away
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
 * The way to the front for a direction upwards that the scene did not name.
 *
 * @param {string} axes
 * @param {Vec3} up
 * @returns {Vec3}
 */
export function frontFor(axes, up) {
  const front = directionOf(axes, 'F');
  return Math.abs(dot(front, up)) < 0.9 ? front : across(up);
}
