// SPDX-License-Identifier: Apache-2.0
// Converts camera files of other programs to csplat's own form: cameras.json of INRIA, camera paths of nerfstudio,
// transforms.json. `csplat_render/camera_files.py` describes them and reads them in the same way.

const NEAR = 0.01; // scene units, as in nerfstudio's renderer

/** @typedef {Record<string, any>} Entry */

/**
 * Convert cameras of any of these forms to the form of camera files.
 *
 * @param {unknown} value content of a JSON file
 * @returns {unknown[]} entries {K, viewmat, W, H, near, image}; values of unknown form are returned unchanged
 */
export function ownCameras(value) {
  if (Array.isArray(value)) return value.map((entry) => (entry?.rotation ? ofInria(entry) : entry));
  const document = /** @type {Entry} */ (value ?? {});
  if (Array.isArray(document.camera_path)) {
    return document.camera_path.map((/** @type {Entry} */ entry) => ofNerfstudio(document, entry));
  }
  if (Array.isArray(document.frames)) {
    return document.frames.map((/** @type {Entry} */ frame) => ofTransforms(document, frame));
  }
  return [value];
}

/** @param {Entry} entry */
function ofInria({ rotation: R, position: p, fx, fy, width: W, height: H, img_name: image }) {
  if (!isMatrix(R, 3, 3) || !isMatrix([p], 1, 3))
    throw new TypeError('rotation and position of a camera must be numbers');
  const rows = [0, 1, 2].map((k) => {
    const axis = R.map((/** @type {number[]} */ row) => row[k]);
    return [...axis, -(axis[0] * p[0] + axis[1] * p[1] + axis[2] * p[2])];
  });
  return { K: intrinsics(fx, fy, W / 2, H / 2), viewmat: [...rows, [0, 0, 0, 1]], W, H, image };
}

/**
 * @param {Entry} path
 * @param {Entry} entry
 */
function ofNerfstudio({ camera_type: kind = 'perspective', render_width: W, render_height: H }, entry) {
  if (String(kind).toLowerCase() !== 'perspective') throw new TypeError(`camera_type is ${kind}, expected perspective`);
  const focal = (0.5 * H) / Math.tan((entry.fov * Math.PI) / 360);
  const matrix = Array.isArray(entry.camera_to_world) ? entry.camera_to_world.flat() : [];
  const rows = [0, 4, 8, 12].map((at) => matrix.slice(at, at + 4));
  return { K: intrinsics(focal, focal, W / 2, H / 2), viewmat: ofOpenGL(rows, 'camera_to_world'), W, H, near: NEAR };
}

/**
 * @param {Entry} document
 * @param {Entry} frame
 */
function ofTransforms(document, frame) {
  const { w: W, h: H, cx = W / 2, cy = H / 2, ...values } = { ...document, ...frame };
  const across = values.fl_x ?? (0.5 * W) / Math.tan(values.camera_angle_x / 2);
  const down = values.fl_y ?? (0.5 * H) / Math.tan(values.camera_angle_y / 2);
  const K = intrinsics(across || down, down || across, cx, cy);
  const viewmat = ofOpenGL(frame.transform_matrix, 'transform_matrix');
  return { K, viewmat, W, H, near: NEAR, image: frame.file_path };
}

/**
 * Convert camera to world with OpenGL axes to world to camera with OpenCV axes.
 *
 * @param {any} pose
 * @param {string} name
 */
function ofOpenGL(pose, name) {
  if (!isMatrix(pose, 3, 4) && !isMatrix(pose, 4, 4)) throw new TypeError(`${name} is not 4 × 4 numbers`);
  if (pose.length === 4 && pose[3].join() !== '0,0,0,1') {
    throw new TypeError(`${name} has the last row ${pose[3].join(' ')}, expected 0 0 0 1: is it transposed?`);
  }
  const scale = Math.hypot(pose[0][0], pose[1][0], pose[2][0]); // some exporters include the scale of the world
  const rows = [0, 1, 2].map((k) => {
    const sign = k === 0 ? 1 : -1;
    const axis = [0, 1, 2].map((row) => (sign * pose[row][k]) / scale);
    return [...axis, -(axis[0] * pose[0][3] + axis[1] * pose[1][3] + axis[2] * pose[2][3])];
  });
  return [...rows, [0, 0, 0, 1]];
}

/**
 * @param {number} fx
 * @param {number} fy
 * @param {number} cx
 * @param {number} cy
 */
const intrinsics = (fx, fy, cx, cy) => [
  [fx, 0, cx],
  [0, fy, cy],
  [0, 0, 1],
];

/**
 * @param {any} rows
 * @param {number} height
 * @param {number} width
 */
function isMatrix(rows, height, width) {
  const isRow = (/** @type {any} */ row) =>
    Array.isArray(row) && row.length === width && row.every((value) => Number.isFinite(value));
  return Array.isArray(rows) && rows.length === height && rows.every(isRow);
}
