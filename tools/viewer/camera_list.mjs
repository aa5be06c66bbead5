// SPDX-License-Identifier: Apache-2.0
// The cameras of a scene, from its file and the page's address: their list, the initial one, and the up direction.

import { DEFAULT_AXES, ballOf, directionOf, eyeOf, firstView, readCamera } from '../../codec/js/first_view.mjs';
import { defaultLens } from './orbit_camera.mjs';
import { pick } from './pick.mjs';
import { upOfCameras, waysUp } from './up_direction.mjs';
import { dot, sub, unitDirection } from './vectors.mjs';

/**
 * @typedef {import('./controls.mjs').Controls} Controls
 * @typedef {import('./orbit_camera.mjs').Pose} Pose
 * @typedef {import('./orbit_camera.mjs').OrbitCamera} OrbitCamera
 * @typedef {import('./types.d.ts').Bounds} Bounds
 * @typedef {import('./types.d.ts').Description} Description
 * @typedef {import('./types.d.ts').Header} Header
 * @typedef {import('./vectors.mjs').Basis} Basis
 * @typedef {import('./vectors.mjs').Vec3} Vec3
 * @typedef {import('../../codec/js/first_view.mjs').FileCamera} FileCamera
 * @typedef {FileCamera & {image: string}} Camera
 */

const SAME = 0.999; // cosine of the angle within which directions count as equal

/** @returns {Pose} placeholder until a scene is loaded */
export function emptyPose() {
  return {
    basis: [
      [1, 0, 0],
      [0, 1, 0],
      [0, 0, 1],
    ],
    eye: [0, 0, -3],
    distance: 3,
    up: directionOf(DEFAULT_AXES, 'U'),
    lens: defaultLens(),
    near: 0.01,
  };
}

/** Metadata of a file that specifies none. */
const noFacts = () => {
  return {
    /** @type {Vec3 | null} */
    up: null,
    axes: '',
    /** @type {Camera[]} */
    cameras: [],
    /** @type {Camera | null} first view in the metadata */
    start: null,
    /** @type {Vec3 | null} background of the training: red, green, blue, 0 to 1 */
    background: null,
    title: '',
    licence: '',
  };
};

export class CameraList {
  /**
   * @param {OrbitCamera} rig
   * @param {Controls} controls
   * @param {{up: Vec3 | null, axes: string | null}} wanted override the file's
   */
  constructor(rig, controls, wanted) {
    this.rig = rig;
    this.controls = controls;
    this.wanted = wanted;
    /** @type {Camera[]} from the address, for any scene */
    this.wantedCameras = [];
    this.first = 0;
    this.facts = noFacts();
    /** @type {Bounds | null} */
    this.bounds = null;
    /** What the header tells: a ball around most splats, and the first view. */
    this.ball = ballOf({ tiles: [] });
    /** @type {import('../../codec/js/first_view.mjs').FirstView | null} */
    this.firstCamera = null;
    this.shown = 0;
    this.up = directionOf(DEFAULT_AXES, 'U');
  }

  /** Forget the previous scene. */
  begin() {
    this.facts = noFacts();
    this.bounds = null;
    this.controls.touched = false;
  }

  /** Place the camera for a new version of the scene, unless the user has moved it. */
  placeAgain() {
    this.bounds = null;
  }

  /** The cameras to step through. */
  get cameras() {
    return this.wantedCameras.length ? this.wantedCameras : this.facts.cameras;
  }

  /**
   * Use the cameras in the address.
   *
   * @param {unknown[] | null} entries cameras of a camera file; null for those of the scene
   * @param {number} first index of the initial camera
   */
  useCameras(entries, first) {
    const cameras = (entries ?? []).map(named);
    if (entries && first >= cameras.length)
      throw new RangeError(`number ${first} of ${cameras.length}, counted from 0`);
    this.wantedCameras = cameras;
    this.first = entries ? first : 0;
  }

  /**
   * @param {Header} header
   * @param {Description} description
   */
  read(header, { metadata, cameras }) {
    const { axes } = header;
    this.facts = {
      up: unitDirection(metadata?.up),
      axes,
      cameras: (cameras ?? []).flatMap(sound),
      start: [metadata?.view].flatMap(sound)[0] ?? null,
      background: colour(/** @type {any} */ (metadata?.training)?.background),
      title: typeof metadata?.title === 'string' ? metadata.title : '',
      licence: typeof metadata?.licence === 'string' ? metadata.licence : '',
    };
    this.up = this.#firstUp();
    this.shown = this.first;
    this.ball = ballOf(header);
    const axesOf = { ...header, axes: this.wanted.axes ?? axes };
    this.firstCamera = firstView(axesOf, { metadata: metadata ?? null, cameras }, this.up);
  }

  /** Whether the up direction is known from the file or the cameras of its photographs. */
  get knowsUp() {
    return this.#namedUp() !== null;
  }

  /** @returns {Vec3 | null} up direction in the file, regardless of its cameras */
  get saidUp() {
    const { up, axes } = this.facts;
    return up ?? (axes ? directionOf(axes, 'U') : null);
  }

  /** @returns {Vec3 | null} */
  #namedUp() {
    const { up, axes } = this.wanted;
    if (up) return up;
    if (axes) return directionOf(axes, 'U');
    if (this.saidUp) return this.saidUp;
    const { start } = this.facts;
    const known = [...(start ? [start] : []), ...this.cameras];
    return known.length ? upOfCameras(known) : null;
  }

  /** Whether the scene has been turned to another up direction than the file's. */
  get isTurned() {
    return dot(this.up, this.#firstUp()) <= SAME;
  }

  #firstUp() {
    return this.#namedUp() ?? directionOf(DEFAULT_AXES, 'U');
  }

  /**
   * Place the camera for the first view when the header is here, never after the user has moved it. When samples of the splats
   * arrive, the view stays, and its pivot comes to lie on the surface.
   *
   * @param {Bounds} bounds
   * @returns {boolean} whether the camera was placed
   */
  place(bounds) {
    if (bounds === this.bounds) return false;
    const isPlaced = this.bounds !== null;
    this.bounds = bounds;
    if (isPlaced && this.controls.touched) return false;
    this.rig.extent = this.ball.radius;
    this.rig.home = this.#firstPose();
    if (!isPlaced) this.rig.front = this.rig.home;
    if (this.controls.touched) return false;
    if (isPlaced) this.rig.pose = this.rig.home;
    else this.controls.glide(this.rig.home, true);
    return !isPlaced;
  }

  /** Show the initial view at once, if the scene has been placed. */
  showFirst() {
    if (!this.bounds) return;
    this.shown = this.first;
    this.rig.home = this.#firstPose();
    this.controls.glide(this.rig.home, true);
  }

  /** Return to the initial view. */
  goHome() {
    this.shown = this.first;
    this.controls.glide(this.rig.home);
  }

  /**
   * Show the next camera of the file.
   *
   * @param {number} step 1, or −1 for the previous one
   * @returns {string} its name, empty if there are no others
   */
  otherCamera(step) {
    const { cameras, bounds } = this;
    if (!bounds || !cameras.length) return '';
    this.shown = (this.shown + step + cameras.length) % cameras.length;
    const camera = cameras[this.shown];
    this.controls.touched = true;
    this.controls.glide(this.#poseOf(camera));
    return `Camera ${this.shown + 1} of ${cameras.length}${camera.image ? `: ${camera.image}` : ''}`;
  }

  /**
   * Turn the scene to the next up direction.
   *
   * @returns {{up: Vec3, isSaid: boolean}} the up direction, and whether it is the one in the file
   */
  turnUpright() {
    const all = waysUp(this.#firstUp());
    this.up = all[(all.findIndex((up) => dot(up, this.up) > SAME) + 1) % all.length];
    this.rig.front = this.rig.home = this.rig.limited(this.rig.turnedUp(this.up));
    this.controls.touched = true;
    this.controls.glide(this.rig.home);
    return { up: this.up, isSaid: this.saidUp !== null && dot(this.saidUp, this.up) > SAME };
  }

  /**
   * Return a pose that orbits the point of the scene at a point of the canvas.
   *
   * @param {number} x CSS pixels
   * @param {number} y CSS pixels
   * @param {number} width
   * @param {number} height
   */
  pivotAt(x, y, width, height) {
    if (!this.bounds) return null;
    const point = pick(this.bounds, this.rig.camera(width, height), x, y);
    return point && this.rig.towards(point);
  }

  /** @returns {Pose} that of the address, of the file, or the estimate from the header, within the limits of the controls */
  #firstPose() {
    const wanted = this.wantedCameras[this.first];
    if (wanted) return this.#poseOf(wanted);
    const first = /** @type {import('../../codec/js/first_view.mjs').FirstView} */ (this.firstCamera);
    return first.isFound ? this.#poseOf(first) : this.rig.limited(this.#poseOf(first, null));
  }

  /**
   * Return the pose of a camera. Its pivot is on the surface that it looks at.
   *
   * @param {FileCamera} camera
   * @param {Bounds | null} bounds with samples of the surface; null: the pivot is as far away as the middle of the scene
   * @returns {Pose}
   */
  #poseOf(camera, bounds = this.bounds) {
    const { viewmat: m, lens, near } = camera;
    const { ball, up } = this;
    const basis = /** @type {Basis} */ ([0, 4, 8].map((at) => m.slice(at, at + 3)));
    const { eye, distance } = eyeOf(camera, ball);
    const seen = bounds && pick(bounds, { viewmat: m, ...lens, near }, lens.W / 2, lens.H / 2);
    const depth = seen ? dot(sub(seen, eye), basis[2]) : 0;
    return { basis, eye, distance: depth > 0.05 * ball.radius ? depth : distance, up, lens, near, viewmat: m };
  }
}

/**
 * @param {unknown} value
 * @returns {Vec3 | null}
 */
function colour(value) {
  const isShare = (/** @type {unknown} */ one) => typeof one === 'number' && one >= 0 && one <= 1;
  return Array.isArray(value) && value.length === 3 && value.every(isShare) ? /** @type {Vec3} */ (value) : null;
}

/**
 * @param {unknown} entry
 * @returns {Camera}
 */
function named(entry) {
  const image = /** @type {any} */ (entry)?.image;
  return { ...readCamera(entry), image: typeof image === 'string' ? image.slice(image.lastIndexOf('/') + 1) : '' };
}

/**
 * Return the camera of a file in a list, or an empty list if it is invalid: the scene is still shown.
 *
 * @param {unknown} entry
 * @returns {Camera[]}
 */
function sound(entry) {
  try {
    return [named(entry)];
  } catch {
    return [];
  }
}
