// SPDX-License-Identifier: Apache-2.0
// The interactive camera: position, pivot, and lens fitted to the canvas. Independent of the DOM.

import { fitCamera, fitScale } from './camera_maths.mjs';
import {
  add,
  cross,
  dot,
  length,
  lookAlong,
  mix,
  scale,
  slerp,
  sub,
  toBasis,
  toQuat,
  turnBasis,
  unit,
} from './vectors.mjs';

/**
 * @typedef {import('./vectors.mjs').Vec3} Vec3
 * @typedef {import('./vectors.mjs').Basis} Basis
 *
 * A lens as in a camera file: focal lengths and principal point of a picture of W by H pixels.
 * @typedef {{fx: number, fy: number, cx: number, cy: number, W: number, H: number}} Lens
 *
 * @typedef {object} Pose
 * @property {Basis} basis right, down, forward
 * @property {Vec3} eye position of the camera
 * @property {number} distance distance to the pivot, straight ahead; above 0
 * @property {Vec3} up up direction of the world
 * @property {Lens} lens
 * @property {number} near distance of the near plane
 * @property {number[]} [viewmat] exact matrix of a file, 16 numbers by rows, until the camera moves
 *
 * @typedef {{viewmat: number[], fx: number, fy: number, cx: number, cy: number, near: number}} EngineCamera
 *
 * What users may do: everything, orbit a pivot that stays, or nothing; distance to the pivot, scene units; angle at the pivot
 * between up and the camera, radians; angle around up from the first view, above 0 to the right of it, radians.
 * @typedef {Record<'distance' | 'polar' | 'azimuth', [number, number]> & {kind: 'free' | 'orbit' | 'none'}} Limits
 */

const POLE = 0.02; // minimum angle between the line of sight and the vertical, radians
const NEAREST = 1e-4; // minimum distance to the pivot, extents
const FARTHEST = 60; // maximum distance to the pivot, extents
const NEAR_SHARE = 0.1; // maximum distance of the near plane, as a share of the distance to the pivot

/** Default field of view of the shorter side of the canvas, radians. */
export const FIELD_OF_VIEW = (55 * Math.PI) / 180;

/** @type {Limits} */
const NO_LIMITS = { kind: 'free', distance: [0, Infinity], polar: [0, Math.PI], azimuth: [-Math.PI, Math.PI] };

/** @returns {Lens} the default lens */
export function defaultLens() {
  const focal = 0.5 / Math.tan(FIELD_OF_VIEW / 2);
  return { fx: focal, fy: focal, cx: 0.5, cy: 0.5, W: 1, H: 1 };
}

/**
 * Return the scale at which the whole picture of a lens fits a canvas.
 *
 * @param {Lens} lens
 * @param {number} width
 * @param {number} height
 */
const fit = ({ W, H }, width, height) => fitScale({ width: W, height: H }, { width, height });

export class OrbitCamera {
  /**
   * @param {Pose} pose
   * @param {number} extent size of the scene, the unit of speeds and limits
   * @param {Limits} [limits]
   */
  constructor(pose, extent, limits = NO_LIMITS) {
    this.limits = limits;
    this.pose = pose;
    this.home = pose;
    this.front = pose; // its azimuth is 0
    this.extent = extent;
  }

  /** @returns {Vec3} centre of rotation */
  get pivot() {
    return pivotOf(this.pose);
  }

  /**
   * Return the camera for the engine.
   *
   * @param {number} width width of the drawing buffer, pixels
   * @param {number} height
   * @returns {EngineCamera}
   */
  camera(width, height) {
    const { basis, eye, lens, near, distance, viewmat } = this.pose;
    const { W, H, ...pinhole } = lens;
    const [right, down, forward] = basis;
    return {
      ...fitCamera(pinhole, { width: W, height: H }, { width, height }),
      viewmat: viewmat ?? [
        ...[...right, -dot(right, eye)],
        ...[...down, -dot(down, eye)],
        ...[...forward, -dot(forward, eye)],
        ...[0, 0, 0, 1],
      ],
      near: viewmat ? near : Math.min(near, NEAR_SHARE * distance),
    };
  }

  /**
   * Orbit the pivot; the scene follows the pointer.
   *
   * @param {number} right radians
   * @param {number} down radians
   */
  orbit(right, down) {
    const { pivot } = this;
    const basis = this.#turned(right, down);
    this.#change({ basis, eye: sub(pivot, scale(basis[2], this.pose.distance)) });
  }

  /**
   * Turn the camera in place.
   *
   * @param {number} right radians
   * @param {number} down radians
   */
  look(right, down) {
    this.#change({ basis: this.#turned(right, down) });
  }

  /**
   * Move parallel to the picture, so that points at the distance of the pivot follow the pointer.
   *
   * @param {number} right movement of the pointer, pixels
   * @param {number} down movement of the pointer, pixels
   * @param {number} width width of the canvas in the same pixels
   * @param {number} height
   */
  pan(right, down, width, height) {
    const { basis, eye, lens, distance } = this.pose;
    const k = fit(lens, width, height);
    const aside = scale(basis[0], (-right * distance) / (lens.fx * k));
    const below = scale(basis[1], (-down * distance) / (lens.fy * k));
    this.#change({ eye: add(eye, add(aside, below)) });
  }

  /**
   * Zoom towards or away from the pivot; the point under the pointer stays in place.
   *
   * @param {number} factor factor of the distance, below 1 to zoom in
   * @param {{x: number, y: number, width: number, height: number}} [at] pointer on the canvas
   */
  zoom(factor, at) {
    const { basis, eye, lens, distance } = this.pose;
    const [least, most] = this.limits.distance;
    const nearest = Math.max(NEAREST * this.extent, least);
    const wanted = Math.min(Math.max(distance * factor, nearest), FARTHEST * this.extent, most);
    const step = distance - wanted;
    let ray = basis[2];
    if (at) {
      const k = fit(lens, at.width, at.height);
      const camera = this.camera(at.width, at.height);
      const aside = scale(basis[0], (at.x - camera.cx) / (lens.fx * k));
      ray = add(ray, add(aside, scale(basis[1], (at.y - camera.cy) / (lens.fy * k))));
    }
    this.#change({ distance: wanted, eye: add(eye, scale(ray, step)) });
  }

  /**
   * Move through the scene together with the pivot.
   *
   * @param {Vec3} by right, down and forward, scene units
   */
  fly(by) {
    const { basis, eye } = this.pose;
    const moved = add(eye, add(scale(basis[0], by[0]), add(scale(basis[1], by[1]), scale(basis[2], by[2]))));
    this.#change({ eye: moved });
  }

  /** @returns {number} speed of flying at the current position, scene units per second */
  get speed() {
    return 0.7 * Math.min(Math.max(this.pose.distance, 0.2 * this.extent), 2 * this.extent);
  }

  /**
   * Return a pose at the same position with another pivot.
   *
   * @param {Vec3} point
   * @returns {Pose}
   */
  towards(point) {
    const { eye, up } = this.pose;
    const line = sub(point, eye);
    return { ...this.pose, basis: lookAlong(line, up), distance: length(line), viewmat: undefined };
  }

  /**
   * Return the nearest pose within the limits.
   *
   * @param {Pose} pose
   * @returns {Pose}
   */
  limited(pose) {
    const rig = new OrbitCamera(pose, this.extent, this.limits);
    rig.orbit(0, 0);
    rig.zoom(1);
    return rig.pose;
  }

  /**
   * Return a pose with another up direction: the scene turns around the pivot.
   *
   * @param {Vec3} up
   * @returns {Pose}
   */
  turnedUp(up) {
    const { pose, pivot } = this;
    const axis = cross(pose.up, up);
    const angle = Math.atan2(length(axis), dot(pose.up, up));
    const around = length(axis) > 1e-9 ? unit(axis) : pose.basis[2]; // if upside down, around the line of sight
    const basis = turnBasis(pose.basis, around, angle);
    return { ...pose, basis, up, eye: sub(pivot, scale(basis[2], pose.distance)), viewmat: undefined };
  }

  /**
   * @param {number} right
   * @param {number} down
   * @returns {Basis}
   */
  #turned(right, down) {
    const { up } = this.pose;
    const [least, most] = this.limits.azimuth;
    const basis = this.#pitched(this.pose.basis, down);
    if (most - least >= 2 * Math.PI) return turnBasis(basis, up, -right);
    const aside = cross(up, this.#pitched(this.front.basis, 0)[2]);
    const azimuth = Math.atan2(dot(basis[2], aside), dot(basis[2], cross(aside, up)));
    const turns = Math.round((azimuth - (least + most) / 2) / (2 * Math.PI)); // away from the middle of the limits
    const from = azimuth - 2 * Math.PI * turns;
    return turnBasis(basis, up, Math.min(Math.max(from - right, least), most) - from);
  }

  /**
   * Pitch a basis within the limits, off the vertical.
   *
   * @param {Basis} basis
   * @param {number} down
   * @returns {Basis}
   */
  #pitched(basis, down) {
    const slope = Math.acos(Math.min(1, Math.max(-1, dot(basis[2], this.pose.up)))); // 0: straight up
    const [least, most] = this.limits.polar.map((angle) => Math.PI - angle).reverse();
    const wanted = Math.min(Math.max(slope + down, POLE, least), Math.PI - POLE, most);
    // An initial view that is rolled has a tilted horizon, and pitches around the horizontal axis of its picture.
    return turnBasis(basis, basis[0], slope - wanted);
  }

  /** @param {Partial<Pose>} change */
  #change(change) {
    this.pose = { ...this.pose, viewmat: undefined, ...change };
  }
}

/**
 * @param {Pose} pose
 * @returns {Vec3}
 */
export const pivotOf = ({ eye, basis, distance }) => add(eye, scale(basis[2], distance));

/**
 * Interpolate between two poses, around the pivot rather than along a straight line.
 *
 * @param {Pose} from
 * @param {Pose} to
 * @param {number} t 0 to 1
 * @returns {Pose}
 */
export function between(from, to, t) {
  if (t >= 1) return to;
  const basis = toBasis(slerp(toQuat(from.basis), toQuat(to.basis), t));
  const distance = from.distance ** (1 - t) * to.distance ** t;
  const pivot = mix(pivotOf(from), pivotOf(to), t);
  return { ...to, basis, distance, eye: sub(pivot, scale(basis[2], distance)), viewmat: undefined };
}
