// SPDX-License-Identifier: Apache-2.0
// The real spherical harmonics of degrees 0 to 4 and their gradient, as csplat.spherical_harmonics, for lanes of
// directions.
#pragma once

#include "vectors.h"

namespace csplat {

constexpr int kBasis = 25;  // functions of degrees 0 to 4

inline Floats operator*(float a, Floats b) { return all(a) * b; }

// Evaluates the basis in unit directions.
inline void sh_basis(int64_t degree, Floats x, Floats y, Floats z, Floats* basis) {
  basis[0] = all(0.28209479177387814f);
  if (degree < 1) return;
  basis[1] = -0.4886025119029199f * y;
  basis[2] = 0.4886025119029199f * z;
  basis[3] = -0.4886025119029199f * x;
  if (degree < 2) return;
  const Floats xx = x * x, yy = y * y, zz = z * z, difference = xx - yy, one = all(1.0f), three = all(3.0f);
  basis[4] = 1.0925484305920792f * x * y;
  basis[5] = -1.0925484305920792f * y * z;
  basis[6] = 0.31539156525252005f * (2.0f * zz - xx - yy);
  basis[7] = -1.0925484305920792f * x * z;
  basis[8] = 0.5462742152960396f * difference;
  if (degree < 3) return;
  const Floats far = 4.0f * zz - xx - yy;
  basis[9] = -0.5900435899266435f * y * (3.0f * xx - yy);
  basis[10] = 2.890611442640554f * x * y * z;
  basis[11] = -0.4570457994644658f * y * far;
  basis[12] = 0.3731763325901154f * z * (2.0f * zz - 3.0f * xx - 3.0f * yy);
  basis[13] = -0.4570457994644658f * x * far;
  basis[14] = 1.445305721320277f * z * difference;
  basis[15] = -0.5900435899266435f * x * (xx - 3.0f * yy);
  if (degree < 4) return;
  const Floats seven = 7.0f * zz;
  basis[16] = 2.5033429417967046f * x * y * difference;
  basis[17] = -1.7701307697799304f * y * z * (3.0f * xx - yy);
  basis[18] = 0.9461746957575601f * x * y * (seven - one);
  basis[19] = -0.6690465435572892f * y * z * (seven - three);
  basis[20] = 0.10578554691520431f * (zz * (35.0f * zz - all(30.0f)) + three);
  basis[21] = -0.6690465435572892f * x * z * (seven - three);
  basis[22] = 0.47308734787878004f * difference * (seven - one);
  basis[23] = -1.7701307697799304f * x * z * (xx - 3.0f * yy);
  basis[24] = 0.6258357354491761f * (xx * (xx - 3.0f * yy) - yy * (3.0f * xx - yy));
}

// Writes the functions in the directions of a block, [3, 16], as [functions, 16].
inline void block_basis(int64_t degree, const float* directions, float* basis) {
  for (int lane = 0; lane < kBlock; lane += kFloats) {
    const float* d = directions + lane;
    Floats functions[kBasis];
    sh_basis(degree, load(d), load(d + kBlock), load(d + 2 * kBlock), functions);
    for (int k = 0; k < (degree + 1) * (degree + 1); k++) store(basis + k * kBlock + lane, functions[k]);
  }
}

// Computes the gradient of Σ g[k] · basis[k] with respect to x, y and z as independent variables.
inline void sh_basis_gradient(int64_t degree, Floats x, Floats y, Floats z, const Floats* g, Floats* gradient) {
  Floats gx = all(0.0f), gy = gx, gz = gx;
  if (degree >= 1) {
    gx = -0.4886025119029199f * g[3];
    gy = -0.4886025119029199f * g[1];
    gz = 0.4886025119029199f * g[2];
  }
  if (degree >= 2) {
    const Floats g4 = 1.0925484305920792f * g[4], g5 = -1.0925484305920792f * g[5];
    const Floats g6 = 0.31539156525252005f * g[6], g7 = -1.0925484305920792f * g[7], g8 = 0.5462742152960396f * g[8];
    gx = gx + y * g4 - 2.0f * x * g6 + z * g7 + 2.0f * x * g8;
    gy = gy + x * g4 + z * g5 - 2.0f * y * g6 - 2.0f * y * g8;
    gz = gz + y * g5 + 4.0f * z * g6 + x * g7;
  }
  if (degree >= 3) {
    const Floats xx = x * x, yy = y * y, zz = z * z, xy = x * y, yz = y * z, xz = x * z;
    const Floats g9 = -0.5900435899266435f * g[9], g10 = 2.890611442640554f * g[10], g11 = -0.4570457994644658f * g[11];
    const Floats g12 = 0.3731763325901154f * g[12], g13 = -0.4570457994644658f * g[13];
    const Floats g14 = 1.445305721320277f * g[14], g15 = -0.5900435899266435f * g[15];
    gx = gx + 6.0f * xy * g9 + yz * g10 - 2.0f * xy * g11 - 6.0f * xz * g12 + (4.0f * zz - 3.0f * xx - yy) * g13 +
         2.0f * xz * g14 + 3.0f * (xx - yy) * g15;
    gy = gy + 3.0f * (xx - yy) * g9 + xz * g10 + (4.0f * zz - xx - 3.0f * yy) * g11 - 6.0f * yz * g12 -
         2.0f * xy * g13 - 2.0f * yz * g14 - 6.0f * xy * g15;
    gz = gz + xy * g10 + 8.0f * yz * g11 + (6.0f * zz - 3.0f * xx - 3.0f * yy) * g12 + 8.0f * xz * g13 +
         (xx - yy) * g14;
    if (degree >= 4) {
      const Floats seven = 7.0f * zz, one = all(1.0f), three = all(3.0f);
      const Floats g16 = 2.5033429417967046f * g[16], g17 = -1.7701307697799304f * g[17];
      const Floats g18 = 0.9461746957575601f * g[18], g19 = -0.6690465435572892f * g[19];
      const Floats g20 = 0.10578554691520431f * g[20], g21 = -0.6690465435572892f * g[21];
      const Floats g22 = 0.47308734787878004f * g[22], g23 = -1.7701307697799304f * g[23];
      const Floats g24 = 0.6258357354491761f * g[24];
      gx = gx + y * (3.0f * xx - yy) * g16 + 6.0f * xy * z * g17 + y * (seven - one) * g18 +
           z * (seven - three) * g21 + 2.0f * x * (seven - one) * g22 + 3.0f * z * (xx - yy) * g23 +
           4.0f * x * (xx - 3.0f * yy) * g24;
      gy = gy + x * (xx - 3.0f * yy) * g16 + 3.0f * z * (xx - yy) * g17 + x * (seven - one) * g18 +
           z * (seven - three) * g19 - 2.0f * y * (seven - one) * g22 - 6.0f * xy * z * g23 +
           4.0f * y * (yy - 3.0f * xx) * g24;
      gz = gz + y * (3.0f * xx - yy) * g17 + 14.0f * xy * z * g18 + y * (3.0f * seven - three) * g19 +
           z * (140.0f * zz - all(60.0f)) * g20 + x * (3.0f * seven - three) * g21 + 14.0f * z * (xx - yy) * g22 +
           x * (xx - 3.0f * yy) * g23;
    }
  }
  gradient[0] = gx;
  gradient[1] = gy;
  gradient[2] = gz;
}

}  // namespace csplat
