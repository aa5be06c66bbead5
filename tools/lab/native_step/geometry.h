// The projection of a Gaussian, which the forward and the backward pass share; equations in projection.cpp.
#pragma once

#include "engine.h"

namespace csplat {

struct Geometry {
  Doubles x, y, z;            // centre in camera coordinates
  Doubles j0, j02, j1, j12;   // entries of the Jacobian other than 0
  Doubles p[3], q[3];         // rows of the Jacobian times the camera's rotation
  Doubles w, i, j, k, over;   // unit quaternion, 1 / length before
  Doubles r[9];               // rotation matrix, row by row
  Doubles s[3], u[3], v[3];   // standard deviations, projected half-axes
  Doubles A, B, C, det;       // covariance on the image with dilation, and its determinant
};

inline Doubles dot(const Doubles* a, const Doubles* b) { return fma(a[2], b[2], fma(a[1], b[1], a[0] * b[0])); }
inline Doubles dot(Doubles a0, Doubles a1, Doubles a2, const Doubles* b) {
  return fma(a2, b[2], fma(a1, b[1], a0 * b[0]));
}

// Transforms the centres of splats, without fused products, so that depths have the same bits as csplat_render's.
inline void project_centres(const float* values, const double* view, Geometry& g) {
  const Doubles X = load_doubles(values), Y = load_doubles(values + kBlock), Z = load_doubles(values + 2 * kBlock);
  g.x = all(view[0]) * X + all(view[1]) * Y + all(view[2]) * Z + all(view[9]);
  g.y = all(view[3]) * X + all(view[4]) * Y + all(view[5]) * Z + all(view[10]);
  g.z = all(view[6]) * X + all(view[7]) * Y + all(view[8]) * Z + all(view[11]);
}

inline void project_jacobian(const double* view, Geometry& g) {
  const Doubles over = all(1.0) / g.z;
  const Doubles tx = smaller(larger(g.x * over, all(view[kBounds])), all(view[kBounds + 1]));
  const Doubles ty = smaller(larger(g.y * over, all(view[kBounds + 2])), all(view[kBounds + 3]));
  g.j0 = all(view[kFocal]) * over;
  g.j1 = all(view[kFocal + 1]) * over;
  g.j02 = all(0.0) - g.j0 * tx;
  g.j12 = all(0.0) - g.j1 * ty;
  for (int n = 0; n < 3; n++) {
    g.p[n] = fma(g.j02, all(view[6 + n]), g.j0 * all(view[n]));
    g.q[n] = fma(g.j12, all(view[6 + n]), g.j1 * all(view[3 + n]));
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
  g.det = dot(area, area) + fma(dilation, g.A + g.C, all(kDilation * kDilation));
  g.A = g.A + dilation;
  g.C = g.C + dilation;
}

// Returns the opacities of logits, rounded to float as csplat_trainer.parameters.sigmoid does.
inline Doubles opacity_of(const float* logits) {
  const Doubles x = smaller(larger(load_doubles(logits), all(-700.0)), all(700.0));
  return rounded_to_float(all(1.0) / (all(1.0) + exp(all(0.0) - x)));
}

// Writes the directions from the camera to the centres of a block, [3, 16]; any finite ones for centres that are not.
inline void view_directions(const float* values, const double* view, float* directions) {
  for (int lane = 0; lane < kBlock; lane += kDoubles) {
    Doubles d[3];
    for (int n = 0; n < 3; n++) d[n] = load_doubles(values + n * kBlock + lane) - all(view[kPosition + n]);
    const Doubles over = all(1.0) / square_root(dot(d, d));
    for (int n = 0; n < 3; n++)
      store_floats(directions + n * kBlock + lane, smaller(larger(d[n] * over, all(-1.0)), all(1.0)));
  }
}

// Evaluates the real spherical harmonics of degree 0 to 3, as csplat.spherical_harmonics.
inline void sh_basis(int degree, Floats x, Floats y, Floats z, Floats* basis) {
  basis[0] = all(0.28209479177387814f);
  if (degree >= 1) {
    const Floats c1 = all(0.4886025119029199f), minus_c1 = all(-0.4886025119029199f);
    basis[1] = minus_c1 * y;
    basis[2] = c1 * z;
    basis[3] = minus_c1 * x;
  }
  if (degree >= 2) {
    const Floats xx = x * x, yy = y * y, zz = z * z, difference = xx - yy;
    basis[4] = all(1.0925484305920792f) * x * y;
    basis[5] = all(-1.0925484305920792f) * y * z;
    basis[6] = all(0.31539156525252005f) * (all(2.0f) * zz - xx - yy);
    basis[7] = all(-1.0925484305920792f) * x * z;
    basis[8] = all(0.5462742152960396f) * difference;
    if (degree >= 3) {
      const Floats far = fma(all(4.0f), zz, all(0.0f) - (xx + yy));
      basis[9] = all(-0.5900435899266435f) * y * fma(all(3.0f), xx, all(0.0f) - yy);
      basis[10] = all(2.890611442640554f) * x * y * z;
      basis[11] = all(-0.4570457994644658f) * y * far;
      basis[12] = all(0.3731763325901154f) * z * fnma(all(3.0f), xx + yy, all(2.0f) * zz);
      basis[13] = all(-0.4570457994644658f) * x * far;
      basis[14] = all(1.445305721320277f) * z * difference;
      basis[15] = all(-0.5900435899266435f) * x * fnma(all(3.0f), yy, xx);
    }
  }
}

}  // namespace csplat
