// The gradient of the projection, then a step of Adam; parallel over blocks, vectorised over the 16 splats of a block.
//
// With d the distance of a pixel from the centre of the ellipse and e = Σ⁻¹ d, the exponent E = −½ dᵀ Σ⁻¹ d has ∂E/∂Σ =
// ½ e eᵀ. Writing g_x for ∂loss/∂x and `slope` for ∂loss/∂E of a pixel:
//
//     g_A = ½ Σ slope·e_x²,  g_B = Σ slope·e_x e_y,  g_C = ½ Σ slope·e_y²
//     g_logit = (1 − opacity) Σ slope
//     g_u = 2 g_A u + g_B v,  g_v = 2 g_C v + g_B u
//     g_log(s_k) = g_u_k u_k + g_v_k v_k   (u_k and v_k are proportional to s_k)
//     g_r_k = s_k (g_u_k p + g_v_k q)      then through the rotation matrix and the normalisation of the quaternion
//
// Records hold moments about the centre of a tile. With D the vector from the splat's centre to the tile's and δ that
// from the tile's centre to a pixel, e = Σ⁻¹ (D + δ).
#include <algorithm>
#include <cmath>

#include "adam.h"
#include "geometry.h"

namespace csplat {
namespace {

constexpr double kLn2 = 0.6931471805599453;
alignas(64) constexpr float kZeros[kMostValues * kBlock] = {};  // gradients of a block that the view does not show

// Sums over all pixels of each splat of a block.
struct BlockSums {
  alignas(64) double slope[kBlock], xx[kBlock], xy[kBlock], yy[kBlock];  // slope times 1, e_x², e_x e_y, e_y²
  alignas(64) float colour[3][kBlock];                                   // 0 for colours that are clamped
};

// Sums the records of a splat, tile by tile.
void sum_records(const Engine& engine, size_t i, int tiles_x, int lane, BlockSums& out) {
  const Splat& s = engine.splats[i];
  const double a = -2.0 * kLn2 * s.xx, b = -kLn2 * s.xy, c = -2.0 * kLn2 * s.yy;  // Σ⁻¹ = (a, b; b, c)
  double slope = 0.0, sxx = 0.0, sxy = 0.0, syy = 0.0, mxx = 0.0, mxy = 0.0, myy = 0.0, colour[3] = {0.0, 0.0, 0.0};
  const Record* record = engine.records.data() + engine.offsets[i];
  const int32_t* tile = engine.record_tiles.data() + engine.offsets[i];
  for (const Record* end = record + engine.tile_counts[i]; record < end; record++, tile++) {
    const double dx = *tile % tiles_x * kTile + 0.5 * kTile - s.x, dy = *tile / tiles_x * kTile + 0.5 * kTile - s.y;
    // Σ⁻¹ D first: the result is small in tiles in which the splat is visible.
    const double ex = std::fma(a, dx, b * dy), ey = std::fma(b, dx, c * dy);
    const double m0 = record->sums[0], m1 = record->sums[1], m2 = record->sums[2];
    const double fx = std::fma(a, m1, b * m2), fy = std::fma(b, m1, c * m2), gx = std::fma(ex, m0, fx);
    slope += m0;
    sxx = std::fma(ex, fx + gx, sxx);
    sxy = std::fma(ex, fy, std::fma(ey, gx, sxy));
    syy = std::fma(ey, std::fma(2.0, fy, ey * m0), syy);
    mxx += record->sums[3];
    mxy += record->sums[4];
    myy += record->sums[5];
    for (int n = 0; n < 3; n++) colour[n] += record->sums[6 + n];
  }
  out.slope[lane] = slope;
  out.xx[lane] = sxx + a * (a * mxx + b * mxy) + b * (a * mxy + b * myy);
  out.xy[lane] = sxy + b * (a * mxx + b * mxy) + c * (a * mxy + b * myy);
  out.yy[lane] = syy + b * (b * mxx + c * mxy) + c * (b * mxy + c * myy);
  for (int n = 0; n < 3; n++) out.colour[n][lane] = s.colour[n] > 0.0f ? static_cast<float>(colour[n]) : 0.0f;
}

// Stores gradients of splats that are drawn, clamped, with 0 for NaN, and 0 for all other splats.
void store_gradient(float* to, DoubleMask drawn, Doubles gradient) {
  const Doubles limit = all(kMaxGradient), zero = all(0.0);
  const DoubleMask number = at_least(magnitude(gradient), zero);  // false for NaN
  const Doubles clamped = smaller(larger(gradient, zero - limit), limit);
  store_floats(to, select(both(drawn, number), clamped, zero));
}

void shape_gradients(const float* values, const double* view, const BlockSums& sums, const double* tile_counts,
                     int lane, float* gradients) {
  const Doubles two = all(2.0), four = all(4.0);
  const DoubleMask drawn = above(load(tile_counts + lane), all(0.0));
  Geometry g;
  project_centres(values + lane, view, g);
  project_jacobian(view, g);
  project_shape(values + lane, g);
  const Doubles gA2 = load(sums.xx + lane), gB = load(sums.xy + lane), gC2 = load(sums.yy + lane);  // 2 g_A, g_B, 2 g_C
  Doubles r[9];  // gradient of the rotation matrix
  for (int n = 0; n < 3; n++) {
    const Doubles du = fma(gA2, g.u[n], gB * g.v[n]), dv = fma(gC2, g.v[n], gB * g.u[n]);
    const float* log_scale = values + (kScale + n) * kBlock + lane;
    const DoubleMask inside = above(all(kLogScaleLimit), magnitude(load_doubles(log_scale)));
    store_gradient(gradients + (kScale + n) * kBlock + lane, both(drawn, inside), fma(du, g.u[n], dv * g.v[n]));
    const Doubles dus = du * g.s[n], dvs = dv * g.s[n];
    for (int m = 0; m < 3; m++) r[3 * m + n] = fma(dus, g.p[m], dvs * g.q[m]);
  }
  const Doubles w = g.w, x = g.i, y = g.j, z = g.k;
  const Doubles d21 = r[7] - r[5], d02 = r[2] - r[6], d10 = r[3] - r[1];
  const Doubles s21 = r[7] + r[5], s02 = r[2] + r[6], s10 = r[3] + r[1];
  const Doubles q[4] = {two * fma(x, d21, fma(y, d02, z * d10)),
                        fnma(four * x, r[4] + r[8], two * fma(w, d21, fma(y, s10, z * s02))),
                        fnma(four * y, r[0] + r[8], two * fma(w, d02, fma(x, s10, z * s21))),
                        fnma(four * z, r[0] + r[4], two * fma(w, d10, fma(x, s02, y * s21)))};
  const Doubles unit[4] = {w, x, y, z};
  const Doubles radial = fma(q[0], w, fma(q[1], x, fma(q[2], y, q[3] * z)));
  for (int n = 0; n < 4; n++)
    store_gradient(gradients + (kQuat + n) * kBlock + lane, drawn, fnma(radial, unit[n], q[n]) * g.over);
  const Doubles opacity = opacity_of(values + kLogit * kBlock + lane);
  store_gradient(gradients + kLogit * kBlock + lane, drawn, load(sums.slope + lane) * (all(1.0) - opacity));
}

void colour_gradients(const Engine& engine, const float* values, const double* view, const BlockSums& sums,
                      float* gradients) {
  alignas(64) float directions[3 * kBlock];
  view_directions(values, view, directions);
  for (int lane = 0; lane < kBlock; lane += kFloats) {
    const float* d = directions + lane;
    Floats basis[16];
    sh_basis(engine.degree, load(d), load(d + kBlock), load(d + 2 * kBlock), basis);
    for (int c = 0; c < 3; c++) {
      const Floats colour = load(sums.colour[c] + lane);
      float* to = gradients + (kSh0 + c) * kBlock + lane;
      for (int k = 0; k <= engine.higher; k++) store(to + 3 * k * kBlock, basis[k] * colour);
    }
  }
}

// Writes the gradients of a block's values from kQuat on.
void block_gradients(const Engine& engine, const Image& image, int block, float* gradients) {
  const float* values = engine.values.data() + static_cast<size_t>(block) * engine.value_count * kBlock;
  BlockSums sums;
  std::memset(&sums, 0, sizeof sums);
  alignas(64) double tile_counts[kBlock];
  for (int lane = 0; lane < kBlock; lane++) {
    const size_t i = static_cast<size_t>(block) * kBlock + lane;
    tile_counts[lane] = engine.tile_counts[i];
    if (engine.tile_counts[i]) sum_records(engine, i, image.tiles_x, lane, sums);
  }
  for (int lane = 0; lane < kBlock; lane += kDoubles)
    shape_gradients(values, image.view, sums, tile_counts, lane, gradients);
  colour_gradients(engine, values, image.view, sums, gradients);
}

}  // namespace

void project_backward(Engine& engine, const Image& image, const float* rates, bool keep_gradients) {
  const size_t stride = static_cast<size_t>(engine.value_count) * kBlock;
  if (rates) engine.steps++;
  const Adam adam = rates ? Adam(rates, engine.steps) : Adam();
  for_each_block(engine, [&](int block) {
    alignas(64) float gradients[kMostValues * kBlock];
    const bool drawn = engine.drawn[block];
    if (drawn) block_gradients(engine, image, block, gradients);
    if (keep_gradients) {
      float* to = engine.gradients.data() + block * stride;
      std::memset(to, 0, stride * sizeof(float));
      if (drawn) std::copy(gradients + kQuat * kBlock, gradients + stride, to + kQuat * kBlock);
    }
    if (rates)
      adam.step(engine.value_count, engine.values.data() + block * stride, drawn ? gradients : kZeros,
                engine.first.data() + block * stride, engine.second.data() + block * stride);
  });
}

}  // namespace csplat
