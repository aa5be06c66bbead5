// SPDX-License-Identifier: Apache-2.0
// The projection of a Gaussian, which the forward and the backward pass share; equations in projection.cpp.
#pragma once

#include "renderer.h"

namespace csplat {

struct Geometry {
  Doubles x, y, z;              // centre in camera coordinates
  Doubles tx, ty;               // x/z and y/z, clamped
  DoubleMask inside_x, inside_y;
  Doubles j0, j02, j1, j12;     // entries of the Jacobian other than 0
  Doubles p[3], q[3];           // rows of the Jacobian times the camera's rotation
  Doubles w, i, j, k, over;     // unit quaternion, 1 / length before
  Doubles r[9];                 // rotation matrix, row by row
  Doubles s[3], u[3], v[3];     // standard deviations, projected half-axes
  Doubles A, B, C;              // covariance on the image with dilation
  Doubles bare, det;            // its determinant without and with dilation
};

inline Doubles dot(const Doubles* a, const Doubles* b) { return fma(a[2], b[2], fma(a[1], b[1], a[0] * b[0])); }
inline Doubles dot(Doubles a0, Doubles a1, Doubles a2, const Doubles* b) {
  return fma(a2, b[2], fma(a1, b[1], a0 * b[0]));
}

// Transforms the centres of splats, without fused products, so that depths have the same bits as those of NumPy.
inline void project_centres(const float* values, const double* camera, Geometry& g) {
  const Doubles X = load_doubles(values), Y = load_doubles(values + kBlock), Z = load_doubles(values + 2 * kBlock);
  g.x = all(camera[0]) * X + all(camera[1]) * Y + all(camera[2]) * Z + all(camera[9]);
  g.y = all(camera[3]) * X + all(camera[4]) * Y + all(camera[5]) * Z + all(camera[10]);
  g.z = all(camera[6]) * X + all(camera[7]) * Y + all(camera[8]) * Z + all(camera[11]);
}

inline void project_jacobian(const double* camera, Geometry& g) {
  const Doubles over = all(1.0) / g.z, tx = g.x * over, ty = g.y * over;
  const Doubles left = all(camera[kBounds]), right = all(camera[kBounds + 1]);
  const Doubles top = all(camera[kBounds + 2]), bottom = all(camera[kBounds + 3]);
  g.inside_x = both(above(tx, left), above(right, tx));
  g.inside_y = both(above(ty, top), above(bottom, ty));
  g.tx = smaller(larger(tx, left), right);
  g.ty = smaller(larger(ty, top), bottom);
  g.j0 = all(camera[kFocal]) * over;
  g.j1 = all(camera[kFocal + 1]) * over;
  g.j02 = -(g.j0 * g.tx);
  g.j12 = -(g.j1 * g.ty);
  for (int n = 0; n < 3; n++) {
    g.p[n] = fma(g.j02, all(camera[6 + n]), g.j0 * all(camera[n]));
    g.q[n] = fma(g.j12, all(camera[6 + n]), g.j1 * all(camera[3 + n]));
  }
}

inline Doubles standard_deviation(const float* log_scale) {
  return exp(smaller(larger(load_doubles(log_scale), all(-kLogScaleLimit)), all(kLogScaleLimit)));
}

// Computes the covariance on the image, after `project_centres` and `project_jacobian`.
inline void project_shape(const float* values, Geometry& g) {
  const Doubles one = all(1.0), two = all(2.0);
  Doubles w = load_doubles(values + kQuat * kBlock), x = load_doubles(values + (kQuat + 1) * kBlock);
  Doubles y = load_doubles(values + (kQuat + 2) * kBlock), z = load_doubles(values + (kQuat + 3) * kBlock);
  const Doubles squared = fma(z, z, fma(y, y, fma(x, x, w * w)));
  const DoubleMask valid = above(squared, all(0.0));  // a quaternion of zeros is the identity
  g.over = select(valid, one / square_root(squared), all(0.0));
  w = g.w = select(valid, w * g.over, one);
  x = g.i = x * g.over;
  y = g.j = y * g.over;
  z = g.k = z * g.over;
  Doubles* r = g.r;
  r[0] = fnma(two, fma(y, y, z * z), one);
  r[1] = two * (x * y - w * z);
  r[2] = two * fma(x, z, w * y);
  r[3] = two * fma(x, y, w * z);
  r[4] = fnma(two, fma(x, x, z * z), one);
  r[5] = two * (y * z - w * x);
  r[6] = two * (x * z - w * y);
  r[7] = two * fma(y, z, w * x);
  r[8] = fnma(two, fma(x, x, y * y), one);
  for (int n = 0; n < 3; n++) {
    g.s[n] = standard_deviation(values + (kScale + n) * kBlock);
    g.u[n] = g.s[n] * dot(r[n], r[3 + n], r[6 + n], g.p);
    g.v[n] = g.s[n] * dot(r[n], r[3 + n], r[6 + n], g.q);
  }
  // The determinant is a sum of squares, (u×v)_k = s_i s_j r_k·(p×q): accurate however long and thin the splat is.
  const Doubles c[3] = {g.p[1] * g.q[2] - g.p[2] * g.q[1], g.p[2] * g.q[0] - g.p[0] * g.q[2],
                        g.p[0] * g.q[1] - g.p[1] * g.q[0]};
  const Doubles area[3] = {g.s[1] * g.s[2] * dot(r[0], r[3], r[6], c), g.s[2] * g.s[0] * dot(r[1], r[4], r[7], c),
                           g.s[0] * g.s[1] * dot(r[2], r[5], r[8], c)};
  const Doubles dilation = all(kDilation);
  g.A = dot(g.u, g.u);
  g.B = dot(g.u, g.v);
  g.C = dot(g.v, g.v);
  g.bare = dot(area, area);
  g.det = g.bare + fma(dilation, g.A + g.C, all(kDilation * kDilation));
  g.A = g.A + dilation;
  g.C = g.C + dilation;
}

// Returns opacities; those of logits are rounded to float, as csplat_trainer.parameters.sigmoid does.
inline Doubles load_opacities(const Splats& splats, const float* values) {
  const Doubles given = load_doubles(values + kOpacity * kBlock);
  if (!splats.logits) return given;
  const Doubles x = smaller(larger(given, all(-700.0)), all(700.0));
  return rounded_to_float(all(1.0) / (all(1.0) + exp(-x)));
}

// Writes the unit directions from the camera to the centres of a block, [3, 16], and 1 / the distances, [16].
inline void view_directions(const float* values, const double* camera, float* directions, double* over_distance) {
  for (int lane = 0; lane < kBlock; lane += kDoubles) {
    Doubles d[3];
    for (int n = 0; n < 3; n++) d[n] = load_doubles(values + n * kBlock + lane) - all(camera[kPosition + n]);
    const Doubles over = all(1.0) / square_root(dot(d, d));
    for (int n = 0; n < 3; n++) store_floats(directions + n * kBlock + lane, d[n] * over);
    store(over_distance + lane, over);
  }
}

}  // namespace csplat
