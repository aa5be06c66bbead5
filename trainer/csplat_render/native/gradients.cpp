// SPDX-License-Identifier: Apache-2.0
// The gradient of a loss with respect to the splats, and a step of Adam along it.
//
// Blending, back to front; parallel over tiles. With g the gradient of the loss at a pixel and `behind` the part of
// g·colour due to all farther splats and the background, per unit of transmittance:
//
//     slope = ∂loss/∂exponent = w (g·c − behind), and 0 if alpha is capped
//     behind ← behind + alpha (g·c − behind)
//
// The gradients of depth and of alpha, which is 1 less the transmittance in the end, are those of a fourth colour, and
// of a background of −1. Each pair of splat and tile has a record of sums, which are added in a fixed order.
//
// Projection; parallel over blocks, vectorised over the 16 splats of a block. With d the distance of a pixel from the
// centre m of the ellipse and e = Σ⁻¹ d, the exponent E = −½ dᵀ Σ⁻¹ d has ∂E/∂m = e and ∂E/∂Σ = ½ e eᵀ. Writing g_x for
// ∂loss/∂x:
//
//     g_m = Σ slope·e                      g_A = ½ Σ slope·e_x²,  g_B = Σ slope·e_x e_y,  g_C = ½ Σ slope·e_y²
//     g_opacity = Σ slope / opacity,  g_logit = (1 − opacity) Σ slope
//     g_u = 2 g_A u + g_B v,  g_v = 2 g_C v + g_B u
//     g_log(s_k) = g_u_k u_k + g_v_k v_k   (u_k and v_k are proportional to s_k)
//     g_r_k = s_k (g_u_k p + g_v_k q)      then through the rotation matrix and the normalisation of the quaternion
//     g_p = Σ_k s_k g_u_k r_k,  g_q = Σ_k s_k g_v_k r_k
//     g_J = (g_p; g_q) Rᵀ
//     g_c = Jᵀ g_m + (∂J/∂c) g_J + g_depth (0, 0, 1)
//     g_mean = Rᵀ g_c + (I − n nᵀ) / |mean − camera| · ∂(colour)/∂n    for the viewing direction n
//
// Records hold moments about the centre of a tile. With D the vector from the splat's centre to the tile's and δ that
// from the tile's centre to a pixel, e = Σ⁻¹ (D + δ).
//
// In the antialiased mode the opacity is multiplied by √ratio (Yu et al., Mip-Splatting, 2024), where ratio = bare /
// dilated is the quotient of the determinants without and with the dilation. With g = ½ Σ slope / bare this adds
//
//     g_A += g (C_bare − ratio (C_bare + dilation))
//     g_B −= 2 g B (1 − ratio)
//     g_C += g (A_bare − ratio (A_bare + dilation))
#include "adam.h"
#include "blending.h"
#include "geometry.h"
#include "harmonics.h"

namespace csplat {
namespace {

constexpr double kMaxGradient = 1e37;   // gradients are clamped to ± this so that sums of them fit in float
constexpr double kLogOfLargest = 40.0;  // of the sizes whose gradients Adam can square in float

// Sums over the pixels of a tile: slope times 1, x, y, xx, xy, yy about the centre of the tile, and the gradients with
// respect to red, green, blue and depth.
constexpr int kSums = 10;

// Gradients of the loss at the pixels of a tile; `behind` as above.
struct Slopes {
  alignas(64) float colour[3][kTilePixels], depth[kTilePixels], behind[kTilePixels];
};

// The gradients of images, [H, W, 3], [H, W] and [H, W]; the last two may be null.
struct ImageGradients { const float *rgb, *alpha, *depth; };

void load_slopes(const View& view, const ImageGradients& image, const Tile& tile, Slopes& slopes) {
  std::memset(&slopes, 0, sizeof slopes);
  for_each_pixel(tile, view, [&](size_t pixel, int place) {
    float behind = image.alpha ? -image.alpha[pixel] : 0.0f;
    for (int c = 0; c < 3; c++) {
      const float slope = slopes.colour[c][place] = image.rgb[3 * pixel + c];
      behind = std::fma(slope, static_cast<float>(view.background[c]), behind);
    }
    if (image.depth) slopes.depth[place] = image.depth[pixel];
    slopes.behind[place] = behind;
  });
}

// Computes the gradient of half the squared error of a tile, and returns the squared error. Images are clipped to 0..1;
// the gradient passes through the clipping.
double compare(const View& view, const float* reference, const Tile& tile, Slopes& slopes) {
  std::memset(&slopes, 0, sizeof slopes);
  for_each_pixel(tile, view, [&](size_t pixel, int place) {
    const float left = std::fabs(tile.transmittance[place]);
    float behind = 0.0f;
    for (int c = 0; c < 3; c++) {
      const float background = static_cast<float>(view.background[c]);
      const float colour = std::fma(left, background, tile.colour[c][place]);
      const float target = std::min(std::max(reference[3 * pixel + c], 0.0f), 1.0f);
      const float error = slopes.colour[c][place] = std::min(std::max(colour, 0.0f), 1.0f) - target;
      behind = std::fma(error, background, behind);
    }
    slopes.behind[place] = behind;
  });
  Floats squares[kParts];
  for (Floats& sum : squares) sum = all(0.0f);
  for (int place = 0; place < kTilePixels; place += kFloats)
    for (int c = 0; c < 3; c++) {
      const Floats error = load(slopes.colour[c] + place);
      Floats& sum = squares[place / kFloats % kParts];
      sum = fma(error, error, sum);
    }
  return sum_lanes(fold(squares));
}

// Sums the gradients of a splat over the pixels of a tile, and returns the start of its alphas and weights.
template <bool kDepth>
const float* sum_gradients(const Splat& s, Slopes& slopes, const float* kept, uint32_t squares, float* record) {
  const Floats cap = all(kAlphaCap), colour[3] = {all(s.colour[0]), all(s.colour[1]), all(s.colour[2])};
  const Floats depth = all(s.depth);
  if (!kDepth) record[9] = 0.0f;
  return sum_squares<kDepth ? 10 : 9>(squares, kept, record, [&](int place, Floats alpha, Floats weight, Floats* sums) {
    // In an order that needs few registers: AVX2 has 16.
    const Floats behind = load(slopes.behind + place);
    Floats step = -behind;
    for (int c = 2; c >= 0; c--) {
      const Floats slope = load(slopes.colour[c] + place);
      step = fma(slope, colour[c], step);
      sums[6 + c] = fma(weight, slope, sums[6 + c]);
    }
    if (kDepth) {
      const Floats slope = load(slopes.depth + place);
      step = fma(slope, depth, step);
      sums[9] = fma(weight, slope, sums[9]);
    }
    store(slopes.behind + place, fma(alpha, step, behind));
    const Floats slope = drop(at_least(alpha, cap), weight * step);
    sums[0] = sums[0] + slope;
    const Floats x = load(kPositions.x + place), sx = slope * x;
    sums[1] = sums[1] + sx;
    sums[3] = fma(sx, x, sums[3]);
    const Floats y = load(kPositions.y + place), sy = slope * y;
    sums[4] = fma(sx, y, sums[4]);
    sums[2] = sums[2] + sy;
    sums[5] = fma(sy, y, sums[5]);
  });
}

// Writes the records of a tile, and returns its squared error if there is a reference.
template <bool kDepth>
double tile_gradients(Renderer& renderer, const View& view, const ImageGradients& image, const float* reference,
                      int index, Scratch& scratch) {
  Tile tile;
  Slopes slopes;
  begin_tile(view, index, tile);
  const auto blend = reference ? blend_tile<true, true, false> : blend_tile<true, false, false>;
  const Blended blended = blend(renderer, Limits(view), index, tile, scratch);
  double error = 0.0;
  if (reference)
    error = compare(view, reference, tile, slopes);
  else
    load_slopes(view, image, tile, slopes);
  for_each_behind(renderer, blended, scratch, [&](const Splat& s, int64_t record, uint32_t squares, const float* kept) {
    float* to = renderer.records.data() + kSums * record;
    if (squares) return sum_gradients<kDepth>(s, slopes, kept, squares, to);
    std::memset(to, 0, kSums * sizeof(float));
    return kept;
  });
  return error;
}

// Sums over all pixels of each splat of a block.
struct BlockSums {
  alignas(64) double slope[kBlock], x[kBlock], y[kBlock], xx[kBlock], xy[kBlock], yy[kBlock];  // slope times e, e eᵀ
  alignas(64) double depth[kBlock];
  alignas(64) double drawn[kBlock];      // 1 or 0
  alignas(64) float colour[3][kBlock];   // 0 for colours that are clamped
};

// Sums the records of a splat, tile by tile.
void sum_records(const Renderer& renderer, int64_t i, int tiles_x, int lane, BlockSums& out) {
  const Splat& s = renderer.splats[i];
  const double a = -2.0 * kLn2 * s.xx, b = -kLn2 * s.xy, c = -2.0 * kLn2 * s.yy;  // Σ⁻¹ = (a, b; b, c)
  double slope = 0.0, sx = 0.0, sy = 0.0, sxx = 0.0, sxy = 0.0, syy = 0.0, mxx = 0.0, mxy = 0.0, myy = 0.0;
  double colour[3] = {0.0, 0.0, 0.0}, depth = 0.0;
  const float* record = renderer.records.data() + static_cast<int64_t>(kSums) * renderer.offsets[i];
  const int32_t* tile = renderer.record_tiles.data() + renderer.offsets[i];
  for (const int32_t* end = tile + renderer.tile_counts[i]; tile < end; record += kSums, tile++) {
    const double dx = *tile % tiles_x * kTile + 0.5 * kTile - s.x, dy = *tile / tiles_x * kTile + 0.5 * kTile - s.y;
    // Σ⁻¹ D first: the result is small in tiles in which the splat is visible.
    const double ex = std::fma(a, dx, b * dy), ey = std::fma(b, dx, c * dy);
    const double m0 = record[0], m1 = record[1], m2 = record[2];
    const double fx = std::fma(a, m1, b * m2), fy = std::fma(b, m1, c * m2), gx = std::fma(ex, m0, fx);
    slope += m0;
    sx += gx;
    sy += std::fma(ey, m0, fy);
    sxx = std::fma(ex, fx + gx, sxx);
    sxy = std::fma(ex, fy, std::fma(ey, gx, sxy));
    syy = std::fma(ey, std::fma(2.0, fy, ey * m0), syy);
    mxx += record[3];
    mxy += record[4];
    myy += record[5];
    for (int n = 0; n < 3; n++) colour[n] += record[6 + n];
    depth += record[9];
  }
  out.slope[lane] = slope;
  out.x[lane] = sx;
  out.y[lane] = sy;
  out.xx[lane] = sxx + a * (a * mxx + b * mxy) + b * (a * mxy + b * myy);
  out.xy[lane] = sxy + b * (a * mxx + b * mxy) + c * (a * mxy + b * myy);
  out.yy[lane] = syy + b * (b * mxx + c * mxy) + c * (b * mxy + c * myy);
  out.depth[lane] = depth;
  for (int n = 0; n < 3; n++) out.colour[n][lane] = s.colour[n] > 0.0f ? static_cast<float>(colour[n]) : 0.0f;
}

// Returns gradients of splats that are drawn, clamped, with 0 for NaN, and 0 for all other splats.
Doubles clamped(DoubleMask drawn, Doubles gradient) {
  const Doubles limit = all(kMaxGradient), zero = all(0.0);
  const DoubleMask number = at_least(magnitude(gradient), zero);  // false for NaN
  return select(both(drawn, number), smaller(larger(gradient, -limit), limit), zero);
}
float clamped(float gradient) {
  const float limit = static_cast<float>(kMaxGradient);
  return gradient != gradient ? 0.0f : std::min(std::max(gradient, -limit), limit);
}

// Gradients of a block of splats, rows of the splats' arrays.
struct BlockGradients {
  alignas(64) float means[3 * kBlock], quats[4 * kBlock], scales[3 * kBlock], opacities[kBlock];
  alignas(64) float sh0[3 * kBlock], shN[3 * (kBasis - 1) * kBlock], means2d[kBlock];
};

// Weights of regularisers: of the sum of opacities, and of the sum of standard deviations.
struct Weights { double opacity, scale; };

void shape_gradients(const Splats& splats, const View& view, const float* values, const BlockSums& sums, int lane,
                     float* gradients, double* centres) {
  const double* camera = view.camera;
  const Doubles two = all(2.0), four = all(4.0), half = all(0.5), zero = all(0.0), dilation = all(kDilation);
  const DoubleMask drawn = above(load(sums.drawn + lane), zero);
  const auto give = [&](int n, DoubleMask where, Doubles gradient) {
    store_floats(gradients + n * kBlock + lane, clamped(where, gradient));
  };
  Geometry g;
  project_centres(values + lane, camera, g);
  project_jacobian(camera, g);
  project_shape(values + lane, g);
  const Doubles slope = load(sums.slope + lane);
  Doubles gA = half * load(sums.xx + lane), gB = load(sums.xy + lane), gC = half * load(sums.yy + lane);
  if (view.antialiased) {
    const Doubles ratio = g.bare / g.det, h = half * slope / g.bare, A = g.A - dilation, C = g.C - dilation;
    const DoubleMask counts = above(ratio, all(kCompensationMin));
    gA = gA + select(counts, h * (C - ratio * g.C), zero);
    gC = gC + select(counts, h * (A - ratio * g.A), zero);
    gB = gB - select(counts, h * two * g.B * (all(1.0) - ratio), zero);
  }
  const Doubles gA2 = two * gA, gC2 = two * gC;
  Doubles r[9];  // gradient of the rotation matrix
  Doubles gp[3] = {zero, zero, zero}, gq[3] = {zero, zero, zero};
  for (int n = 0; n < 3; n++) {
    const Doubles du = fma(gA2, g.u[n], gB * g.v[n]), dv = fma(gC2, g.v[n], gB * g.u[n]);
    const Doubles log_scale = load_doubles(values + (kScale + n) * kBlock + lane);
    const DoubleMask inside = above(all(kLogScaleLimit), magnitude(log_scale));
    give(kScale + n, both(drawn, inside), fma(du, g.u[n], dv * g.v[n]));
    const Doubles dus = du * g.s[n], dvs = dv * g.s[n];
    for (int m = 0; m < 3; m++) {
      r[3 * m + n] = fma(dus, g.p[m], dvs * g.q[m]);
      gp[m] = fma(dus, g.r[3 * m + n], gp[m]);
      gq[m] = fma(dvs, g.r[3 * m + n], gq[m]);
    }
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
  for (int n = 0; n < 4; n++) give(kQuat + n, drawn, fnma(radial, unit[n], q[n]) * g.over);
  const Doubles opacity = load_opacities(splats, values + lane);
  give(kOpacity, drawn, splats.logits ? slope * (all(1.0) - opacity) : slope / opacity);

  const Doubles sx = load(sums.x + lane), sy = load(sums.y + lane), over = all(1.0) / g.z;
  const auto turned = [&](const Doubles* vector, int row) {  // a row of the rotation times a vector
    return dot(all(camera[row]), all(camera[row + 1]), all(camera[row + 2]), vector);
  };
  const Doubles g_j0 = turned(gp, 0), g_j02 = turned(gp, 6), g_j1 = turned(gq, 3), g_j12 = turned(gq, 6);
  const Doubles along_x = select(g.inside_x, g_j02 * over, zero), along_y = select(g.inside_y, g_j12 * over, zero);
  const Doubles cx = fnma(along_x, g.j0, sx * g.j0), cy = fnma(along_y, g.j1, sy * g.j1);
  Doubles cz = load(sums.depth + lane) - fma(sx * g.j0, g.x, sy * g.j1 * g.y) * over;
  cz = cz - fma(g_j0, g.j0, fma(g_j02, g.j02, fma(g_j1, g.j1, g_j12 * g.j12))) * over;
  cz = cz - fma(along_x, g.j02, along_y * g.j12);
  for (int n = 0; n < 3; n++)
    store(centres + n * kBlock + lane, fma(all(camera[n]), cx, fma(all(camera[3 + n]), cy, all(camera[6 + n]) * cz)));
  const Doubles norm = square_root(fma(sx, sx, sy * sy));
  give(kValues, drawn, norm);
}

// Adds the part of the gradients of means that is due to the viewing directions.
void add_direction_gradients(const Splats& splats, const float* directions, const double* over_distance,
                             const float* weights, double* centres) {
  for (int lane = 0; lane < kBlock; lane += kFloats) {
    const Floats x = load(directions + lane), y = load(directions + kBlock + lane);
    const Floats z = load(directions + 2 * kBlock + lane);
    Floats factors[kBasis], gradient[3];
    for (int k = 0; k <= splats.higher(); k++) factors[k] = load(weights + k * kBlock + lane);
    sh_basis_gradient(splats.degree, x, y, z, factors, gradient);
    const Floats radial = fma(gradient[0], x, fma(gradient[1], y, gradient[2] * z));
    const Floats unit[3] = {x, y, z};
    alignas(64) float across[3][kFloats];
    for (int n = 0; n < 3; n++) {
      store(across[n], fnma(radial, unit[n], gradient[n]));
      for (int k = 0; k < kFloats; k++)
        centres[n * kBlock + lane + k] += across[n][k] * over_distance[lane + k];
    }
  }
}

// Computes the gradients of a block. Those of means are only computed `with_means`.
void block_gradients(const Renderer& renderer, const Splats& splats, const View& view, int64_t block, bool with_means,
                     BlockGradients& out) {
  const int64_t first = block * kBlock;
  const int count = static_cast<int>(std::min<int64_t>(kBlock, splats.count - first)), higher = splats.higher();
  alignas(64) float values[kValues * kBlock], lanes[(kValues + 1) * kBlock], directions[3 * kBlock];
  alignas(64) double centres[3 * kBlock], over_distance[kBlock];
  alignas(64) float basis[kBasis * kBlock], weights[kBasis * kBlock];
  const int row = 3 * static_cast<int>(splats.coefficients);
  if (with_means) prefetch(splats.shN + row * first, row * count);
  load_block(splats, block, values);
  BlockSums sums;
  std::memset(&sums, 0, sizeof sums);
  for (int lane = 0; lane < count; lane++) {
    sums.drawn[lane] = renderer.tile_counts[first + lane] > 0;
    if (renderer.tile_counts[first + lane]) sum_records(renderer, first + lane, view.tiles_x(), lane, sums);
  }
  for (int lane = 0; lane < kBlock; lane += kDoubles)
    shape_gradients(splats, view, values, sums, lane, lanes, centres);
  view_directions(values, view.camera, directions, over_distance);
  block_basis(splats.degree, directions, basis);
  std::memset(out.shN, 0, static_cast<size_t>(row) * kBlock * sizeof(float));
  std::memset(weights, 0, sizeof weights);
  for (int lane = 0; lane < kBlock; lane++) {
    float colour[3] = {0.0f, 0.0f, 0.0f};
    if (sums.drawn[lane] > 0.0)
      for (int c = 0; c < 3; c++) colour[c] = clamped(sums.colour[c][lane]);
    for (int c = 0; c < 3; c++) out.sh0[3 * lane + c] = basis[lane] * colour[c];
    if (sums.drawn[lane] > 0.0) {
      float* to = out.shN + row * lane;
      for (int k = 0; k < higher; k++)
        for (int c = 0; c < 3; c++) to[3 * k + c] = basis[(k + 1) * kBlock + lane] * colour[c];
      if (with_means) {
        const float* sh = splats.shN + row * (first + lane);
        for (int k = 0; k < higher; k++)
          weights[(k + 1) * kBlock + lane] =
              std::fma(colour[0], sh[3 * k], std::fma(colour[1], sh[3 * k + 1], colour[2] * sh[3 * k + 2]));
      }
    }
    for (int n = 0; n < 4; n++) out.quats[4 * lane + n] = lanes[(kQuat + n) * kBlock + lane];
    for (int n = 0; n < 3; n++) out.scales[3 * lane + n] = lanes[(kScale + n) * kBlock + lane];
    out.opacities[lane] = lanes[kOpacity * kBlock + lane];
    out.means2d[lane] = lanes[kValues * kBlock + lane];
  }
  if (with_means) {
    add_direction_gradients(splats, directions, over_distance, weights, centres);
    for (int n = 0; n < 3; n++)
      for (int lane = 0; lane < kBlock; lane += kDoubles)
        store_floats(lanes + (kMean + n) * kBlock + lane,
                     clamped(above(load(sums.drawn + lane), all(0.0)), load(centres + n * kBlock + lane)));
    for (int lane = 0; lane < kBlock; lane++)
      for (int n = 0; n < 3; n++) out.means[3 * lane + n] = lanes[(kMean + n) * kBlock + lane];
  }
}

// Adds the gradients of regularisers.
void regularise(const Splats& splats, int64_t block, const Weights& weights, BlockGradients& out) {
  alignas(64) float values[kValues * kBlock];
  load_block(splats, block, values);
  for (int lane = 0; lane < kBlock; lane += kDoubles) {
    const Doubles opacity = load_opacities(splats, values + lane);
    alignas(32) double slopes[kDoubles], sizes[kDoubles];
    store(slopes, all(weights.opacity) * opacity * (all(1.0) - opacity));
    for (int k = 0; k < kDoubles; k++) out.opacities[lane + k] += static_cast<float>(slopes[k]);
    for (int n = 0; n < 3; n++) {
      const Doubles size = exp(smaller(load_doubles(values + (kScale + n) * kBlock + lane), all(kLogOfLargest)));
      store(sizes, all(weights.scale) * size);
      for (int k = 0; k < kDoubles; k++) out.scales[3 * (lane + k) + n] += static_cast<float>(sizes[k]);
    }
  }
}

// Writes the records of all tiles, and returns the squared error if there is a reference.
double blend_gradients(int64_t threads, Renderer& renderer, const View& view, const ImageGradients& image,
                       const float* reference) {
  renderer.reserve_scratch(threads);
  renderer.records.reserve(kSums * renderer.pair_count);
  parallel(threads, view.tile_count(), [&](int64_t index, int thread) {
    const auto pass = image.depth ? tile_gradients<true> : tile_gradients<false>;
    renderer.errors[index] = pass(renderer, view, image, reference, static_cast<int>(index), renderer.scratch[thread]);
  });
  double error = 0.0;
  for (int64_t tile = 0; reference && tile < view.tile_count(); tile++) error += renderer.errors[tile];
  return error;
}

// Gradients of splats, see `Gradients` in csplat_render.conventions.
struct SplatGradients { float *means, *quats, *scales, *opacities, *sh0, *shN, *means2d; };

void project_gradients(int64_t threads, const Renderer& renderer, const Splats& splats, const View& view,
                       const SplatGradients& to) {
  for_each_block(threads, splats.blocks(), [&](int64_t block) {
    const int64_t first = block * kBlock, count = std::min<int64_t>(kBlock, splats.count - first);
    BlockGradients g;
    const bool drawn = renderer.drawn[block];
    if (drawn) block_gradients(renderer, splats, view, block, to.means, g);
    const auto write = [&](float* rows, const float* from, int64_t width) {
      if (rows && drawn)
        std::copy(from, from + width * count, rows + width * first);
      else if (rows)
        std::fill(rows + width * first, rows + width * (first + count), 0.0f);
    };
    write(to.means, g.means, 3);
    write(to.quats, g.quats, 4);
    write(to.scales, g.scales, 3);
    write(to.opacities, g.opacities, 1);
    write(to.sh0, g.sh0, 3);
    write(to.shN, g.shN, 3 * splats.coefficients);
    write(to.means2d, g.means2d, 1);
  });
}

}  // namespace
}  // namespace csplat

using namespace csplat;

// Computes the gradients of a loss, after `csplat_render` of the same splats.
//
// rgb, alpha, depth: [H, W, 3], [H, W] or null, the gradients of the images. The other arrays are written.
CSPLAT_API int64_t csplat_gradients(int64_t threads, Renderer* renderer, const Splats* splats, const View* view,
                                    const float* rgb, const float* alpha, const float* depth, float* means,
                                    float* quats, float* scales, float* opacities, float* sh0, float* shN,
                                    float* means2d) {
  return guarded([&]() -> int64_t {
    blend_gradients(threads, *renderer, *view, {rgb, alpha, depth}, nullptr);
    project_gradients(threads, *renderer, *splats, *view, {means, quats, scales, opacities, sh0, shN, means2d});
    return 0;
  });
}

// Computes the gradients of half the squared error of a view, after `csplat_project`; without those of means.
//
// reference: [H, W, 3]. error: [1], written: the squared error.
CSPLAT_API int64_t csplat_error_gradients(int64_t threads, Renderer* renderer, const Splats* splats, const View* view,
                                          const float* reference, double* error, float* quats, float* scales,
                                          float* opacities, float* sh0, float* shN) {
  return guarded([&]() -> int64_t {
    bin(threads, *renderer, *view, splats->count);
    *error = blend_gradients(threads, *renderer, *view, {nullptr, nullptr, nullptr}, reference);
    project_gradients(threads, *renderer, *splats, *view, {nullptr, quats, scales, opacities, sh0, shN, nullptr});
    return 0;
  });
}

// Makes a step of all groups along the gradient of half the squared error of a view, or along that of another loss.
//
// reference: [H, W, 3], after `csplat_project`; or null, and gradient: [H, W, 3], that of the loss with respect to the
// image, after `csplat_render`. error: [1], written: the squared error. The values are those of `splats`.
CSPLAT_API int64_t csplat_step(int64_t threads, Renderer* renderer, const Splats* splats, const View* view,
                               const float* reference, const float* gradient, const Step* step, double* error) {
  return guarded([&]() -> int64_t {
    if (reference) bin(threads, *renderer, *view, splats->count);
    *error = blend_gradients(threads, *renderer, *view, {gradient, nullptr, nullptr}, reference);
    const Weights weights = {step->opacity_weight, step->scale_weight};
    const float over_root = static_cast<float>(step->over_root), beta2 = static_cast<float>(step->beta2);
    for_each_block(threads, (step->fitted_count + kBlock - 1) / kBlock, [&](int64_t block) {
      const int64_t first = block * kBlock, count = std::min<int64_t>(kBlock, step->fitted_count - first);
      BlockGradients g;
      if (renderer->drawn[block])
        block_gradients(*renderer, *splats, *view, block, step->groups[0].values, g);
      else
        std::memset(&g, 0, sizeof g);
      if (weights.opacity > 0.0 || weights.scale > 0.0) regularise(*splats, block, weights, g);
      if (step->means2d) std::copy(g.means2d, g.means2d + count, step->means2d + first);
      const float* gradients[6] = {g.means, g.quats, g.scales, g.opacities, g.sh0, g.shN};
      const int64_t widths[6] = {3, 4, 3, 1, 3, 3 * splats->coefficients};
      for (int n = 0; n < 6; n++) {
        const Group& group = step->groups[n];
        const int64_t at = first * widths[n], size = count * widths[n];
        if (!group.values || !size) continue;
        float* values = group.values + at;
        alignas(64) float moves[3 * kBlock] = {};
        const bool sized = n == 0 && step->mean_sizes;
        step_adam(static_cast<float>(group.rate), over_root, beta2, size, sized ? moves : values, gradients[n],
                  group.first + at, group.second + at);
        if (sized)
          for (int64_t k = 0; k < size; k++) values[k] = std::fma(step->mean_sizes[first + k / 3], moves[k], values[k]);
      }
      constrain_quats(count, step->groups[1].values + 4 * first);
      for (int64_t i = first; i < first + count; i++)
        step->groups[3].values[i] = constrain_logit(step->groups[3].values[i]);
    });
    return 0;
  });
}
