// SPDX-License-Identifier: Apache-2.0
// The cameras of a scene, from its file and the page's address: their list, the initial one, and the up direction.

import {
  DEFAULT_AXES,
  automaticPose,
  cameraPose,
  directionOf,
  frontFor,
  readCamera,
  upOfCameras,
  waysUp,
} from './autocamera.mjs';
import { findFrame } from './bounding_frame.mjs';
import { defaultLens } from './orbit_camera.mjs';
import { pick } from './rough_view.mjs';
import { dot, unitDirection } from './vectors.mjs';

/**
 * @typedef {import('./controls.mjs').Controls} Controls
 * @typedef {import('./orbit_camera.mjs').Pose} Pose
 * @typedef {import('./orbit_camera.mjs').OrbitCamera} OrbitCamera
 * @typedef {import('./types.d.ts').Bounds} Bounds
 * @typedef {import('./types.d.ts').Description} Description
 * @typedef {import('./types.d.ts').Header} Header
 * @typedef {import('./vectors.mjs').Vec3} Vec3
 * @typedef {ReturnType<typeof readCamera> & {image: string}} Camera
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
    /** @type {Camera | null} initial camera in the metadata */
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
   * @param {{up: Vec3 | null, axes: string | null, seems: Vec3 | null}} wanted override the file's; `seems` is the up
   *   direction of the first scene if nothing specifies it
   */
  constructor(rig, controls, wanted) {
    this.rig = rig;
    this.controls = controls;
    this.wanted = wanted;
    /** @type {Vec3 | null} */
    this.seems = null;
    /** @type {Camera[]} from the address, for any scene */
    this.wantedCameras = [];
    this.first = 0;
    this.facts = noFacts();
    /** @type {Bounds | null} */
    this.bounds = null;
    this.splatCount = 0;
    this.shown = 0;
    this.up = directionOf(DEFAULT_AXES, 'U');
    /** Whether the camera still waits to be placed. */
    this.waits = true;
  }

  /** Forget the previous scene. */
  begin() {
    this.facts = noFacts();
    this.seems = this.wanted.seems;
    this.wanted = { ...this.wanted, seems: null };
    this.bounds = null;
    this.waits = true;
    this.controls.touched = false;
  }

  /** Place the camera for a new version of the scene, unless the user has moved it. */
  placeAgain() {
    this.bounds = null;
    this.waits = true;
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
  read({ axes }, { metadata, cameras }) {
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
  }

  /** Whether the up direction is known from the file or the cameras of its photographs, or estimated. */
  get knowsUp() {
    return (this.#namedUp() ?? this.seems) !== null;
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

  #firstUp() {
    return this.#namedUp() ?? this.seems ?? directionOf(DEFAULT_AXES, 'U');
  }

  /**
   * Place the camera for the initial view: once roughly, once finally, never after the user has moved it.
   *
   * @param {Bounds} bounds
   * @param {number} splatCount
   * @param {boolean} atOnce without animation, if nothing is visible yet
   * @returns {boolean} whether it was moved
   */
  place(bounds, splatCount, atOnce) {
    if (!this.waits || bounds === this.bounds) return false;
    this.bounds = bounds;
    this.splatCount = splatCount;
    this.waits = bounds.coarse;
    const pose = this.#firstPose(bounds, splatCount);
    this.rig.home = pose;
    if (this.controls.touched) return false;
    this.controls.glide(pose, atOnce || pose.viewmat !== undefined);
    return true;
  }

  /** Show the initial view at once, if the scene has been placed. */
  showFirst() {
    if (!this.bounds) return;
    this.shown = this.first;
    this.rig.home = this.#firstPose(this.bounds, this.splatCount);
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
    this.controls.glide(cameraPose(camera, bounds, findFrame(bounds, this.up), this.up));
    return `Camera ${this.shown + 1} of ${cameras.length}${camera.image ? `: ${camera.image}` : ''}`;
  }

  /**
   * Turn the scene to the next up direction and show its front.
   *
   * @param {Bounds} bounds
   * @param {number} splatCount
   * @returns {{up: Vec3, isSaid: boolean}} the up direction, and whether it is the one in the file
   */
  turnUpright(bounds, splatCount) {
    const all = waysUp(this.#firstUp());
    this.up = all[(all.findIndex((up) => dot(up, this.up) > SAME) + 1) % all.length];
    const pose = this.#automatic(bounds, splatCount, this.up);
    this.rig.home = pose;
    this.controls.touched = true;
    this.controls.glide(pose);
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

  /**
   * @param {Bounds} bounds
   * @param {number} splatCount
   * @returns {Pose}
   */
  #firstPose(bounds, splatCount) {
    const frame = findFrame(bounds, this.up);
    this.rig.extent = frame.extent;
    const camera = this.wantedCameras[this.first] ?? this.facts.start ?? this.cameras[0];
    if (camera) return cameraPose(camera, bounds, frame, this.up);
    return this.#automatic(bounds, splatCount, this.up);
  }

  /**
   * @param {Bounds} bounds
   * @param {number} splatCount
   * @param {Vec3} up
   */
  #automatic(bounds, splatCount, up) {
    const named = this.wanted.axes ?? this.facts.axes;
    const axes = named && dot(directionOf(named, 'U'), up) > Math.SQRT1_2 ? named : ''; // the front is unknown for another up direction
    const front = frontFor(axes || DEFAULT_AXES, up);
    const { pose, frame } = automaticPose(bounds, splatCount, { up, front, isFrontKnown: axes !== '' });
    this.rig.extent = frame.extent;
    return this.rig.limited(pose);
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
