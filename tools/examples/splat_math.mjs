// SPDX-License-Identifier: Apache-2.0
// What a renderer of its own needs: covariances, colours, axes. Arrays are those that `decode` of csplat-decoder returns.

/** @returns {Float32Array} [count, 6]: xx, xy, xz, yy, yz, zz */
export function covariances({ count, quats, scales }) {
  const out = new Float32Array(6 * count);
  for (let i = 0; i < count; i++) {
    const [w, x, y, z] = quats.subarray(4 * i, 4 * i + 4);
    const [a, b, c] = scales.subarray(3 * i, 3 * i + 3).map((scale) => Math.exp(2 * scale));
    const rows = [
      [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
      [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
      [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ];
    const of = (p, q) => a * rows[p][0] * rows[q][0] + b * rows[p][1] * rows[q][1] + c * rows[p][2] * rows[q][2];
    out.set([of(0, 0), of(0, 1), of(0, 2), of(1, 1), of(1, 2), of(2, 2)], 6 * i);
  }
  return out;
}

/** Colour of splat i seen in the direction [x, y, z] of unit length, camera to splat. */
export function colour({ sh0, shN, shDegree }, i, [x, y, z]) {
  const [xx, yy, zz] = [x * x, y * y, z * z];
  const basis = [
    ...[-0.4886025119029199 * y, 0.4886025119029199 * z, -0.4886025119029199 * x],
    ...[1.0925484305920792 * x * y, -1.0925484305920792 * y * z, 0.31539156525252005 * (2 * zz - xx - yy)],
    ...[-1.0925484305920792 * x * z, 0.5462742152960396 * (xx - yy)],
    ...[-0.5900435899266435 * y * (3 * xx - yy), 2.890611442640554 * x * y * z],
    ...[-0.4570457994644658 * y * (4 * zz - xx - yy), 0.3731763325901154 * z * (2 * zz - 3 * xx - 3 * yy)],
    ...[-0.4570457994644658 * x * (4 * zz - xx - yy), 1.445305721320277 * z * (xx - yy)],
    -0.5900435899266435 * x * (xx - 3 * yy),
    ...[2.5033429417967046 * x * y * (xx - yy), -1.7701307697799304 * y * z * (3 * xx - yy)],
    ...[0.9461746957575601 * x * y * (7 * zz - 1), -0.6690465435572892 * y * z * (7 * zz - 3)],
    ...[0.10578554691520431 * (zz * (35 * zz - 30) + 3), -0.6690465435572892 * x * z * (7 * zz - 3)],
    ...[0.47308734787878004 * (xx - yy) * (7 * zz - 1), -1.7701307697799304 * x * z * (xx - 3 * yy)],
    0.6258357354491761 * (xx * (xx - 3 * yy) - yy * (3 * xx - yy)),
  ];
  const terms = (shDegree + 1) ** 2 - 1; // coefficients of splat i: shN[(i · terms + term) · 3 + channel]
  return [0, 1, 2].map((channel) => {
    let sum = 0.5 + 0.28209479177387814 * sh0[3 * i + channel];
    for (let term = 0; term < terms; term++) sum += basis[term] * shN[3 * (i * terms + term) + channel];
    return Math.max(0, sum);
  });
}

/** 3 × 3, from the scene's axes to x right, y up, z back. Its determinant is −1 where the scene is left-handed. */
export function toThree(axes) {
  const letters = axes || 'RDF';
  const row = (positive, negative) => [...letters].map((one) => Number(one === positive) - Number(one === negative));
  return [row('R', 'L'), row('U', 'D'), row('B', 'F')];
}
