// SPDX-License-Identifier: Apache-2.0
// Projection of splats to ellipses on the image; parallel over blocks, vectorised over the 16 splats of a block.
//
// With R and t the rotation and translation of the camera, r_k the axes of the splat and s_k its standard deviations:
//
//     c = R·mean + t = (x, y, z)                           centre in camera coordinates
//     J = (fx/z, 0, −fx x/z²; 0, fy/z, −fy y/z²)           Jacobian of the perspective, x/z and y/z clamped
//     (p; q) = J R
//     u_k = s_k r_k·p,  v_k = s_k r_k·q                    projected half-axes
//     Σ = (A, B; B, C) = (u·u, u·v; u·v, v·v) + dilation   covariance on the image
//     det Σ = |u×v|² + dilation (u·u + v·v) + dilation²
//
// Extent. A splat of opacity o is drawn within the ellipse dᵀ Σ⁻¹ d ≤ ρ², ρ² = 2 ln(o / alpha_min), whose half-width is
// ρ √A and whose half-height is ρ √C. At height y above its centre, its chord is
//
//     x = (B / C) y ± ρ √(det Σ / C) · √(1 − (y / (ρ √C))²)
//
// and it reaches farthest to the right, ρ √A, at y = ρ B / √A. `slope` is B / C, `half_width` ρ √(det Σ / C),
// `flatness` 1 / (ρ √C), and `widest` ρ B / √A.
//
// Shapes are computed in double, because a long thin splat amplifies their errors; colours in float.
#include <cmath>

#include "geometry.h"
#include "harmonics.h"
#include "spans.h"

namespace csplat {
namespace {

// Results of a block, lane by lane: first those of a `Splat`, then those of an `Extent`, then the radius.
enum Field { kX, kY, kXX, kXY, kYY, kSlope, kHalfWidth, kFlatness, kWidest, kLeft, kRight, kTop, kBottom, kRadius,
             kFields };
struct Lanes {
  alignas(64) double fields[kFields][kBlock];
  alignas(64) float depth[kBlock], log2_opacity[kBlock], curvature[kBlock];
};

struct Drawn { unsigned drawn, finite; };  // a bit for each splat that may be drawn, and with a finite shape

// Returns ρ, slightly enlarged so that rounding never loses a pixel.
Doubles reach_of(Doubles log2_opacity, double log2_least) {
  const Doubles squared = all(2.0 * kLn2) * (log2_opacity - all(log2_least));
  return fma(square_root(larger(squared, all(0.0))), all(1.0 + 1e-6), all(1e-6));
}

// Projects some lanes of a block.
Drawn project_lanes(const Splats& splats, const float* values, const View& view, double log2_least, int lane,
                    Lanes& out) {
  const double* camera = view.camera;
  const Doubles zero = all(0.0), half = all(0.5), alpha_min = all(view.alpha_min);
  const Doubles width = all(static_cast<double>(view.width)), height = all(static_cast<double>(view.height));
  Geometry g;
  project_centres(values + lane, camera, g);
  Doubles opacity = load_opacities(splats, values + lane);
  Doubles sum = zero;  // NaN if a value is not finite
  for (int n = 0; n < kValues; n++) sum = sum + zero * load_doubles(values + n * kBlock + lane);
  const DoubleMask finite_values = at_least(zero, sum);
  const unsigned finite_bits = bits(finite_values) << lane;
  const DoubleMask in_front = both(both(finite_values, at_least(opacity, alpha_min)), above(g.z, all(camera[kNear])));
  if (!bits(in_front)) return {0, finite_bits};
  project_jacobian(camera, g);
  const Doubles x = all(camera[kFocal]) * (g.x / g.z) + all(camera[kPrincipal]);
  const Doubles y = all(camera[kFocal + 1]) * (g.y / g.z) + all(camera[kPrincipal + 1]);
  Doubles log2_opacity = log2(opacity), reach = reach_of(log2_opacity, log2_least);

  const DoubleMask in_columns = both(at_least(x, zero), at_least(width, x));
  const DoubleMask in_rows = both(at_least(y, zero), at_least(height, y));
  if (!bits(both(in_front, both(in_columns, in_rows)))) {
    // Early rejection: |u| <= max(s) |p|, |v| <= max(s) |q|.
    const float* scales = values + kScale * kBlock + lane;
    Doubles longest = standard_deviation(scales);
    for (int n = 1; n < 3; n++) longest = larger(longest, standard_deviation(scales + n * kBlock));
    const Doubles squares = longest * longest, dilation = all(kDilation);
    const Doubles rx = fma(reach, square_root(fma(squares, dot(g.p, g.p), dilation)), all(1.0));
    const Doubles ry = fma(reach, square_root(fma(squares, dot(g.q, g.q), dilation)), all(1.0));
    const DoubleMask near_columns = both(at_least(x + rx, zero), at_least(width, x - rx));
    const DoubleMask near_rows = both(at_least(y + ry, zero), at_least(height, y - ry));
    if (!bits(both(in_front, both(near_columns, near_rows)))) return {0, finite_bits};
  }

  project_shape(values + lane, g);
  DoubleMask visible = in_front;
  if (view.antialiased) {
    opacity = opacity * square_root(larger(g.bare / g.det, all(kCompensationMin)));
    visible = both(visible, at_least(opacity, alpha_min));
    log2_opacity = log2(opacity);
    reach = reach_of(log2_opacity, log2_least);
  }
  const Doubles root_a = square_root(g.A), root_c = square_root(g.C), rx = reach * root_a, ry = reach * root_c;
  const Doubles left = ceiling(smaller(larger(x - rx - half, zero), width));
  const Doubles right = floor(smaller(larger(x + rx + half, zero), width));
  const Doubles top = ceiling(smaller(larger(y - ry - half, zero), height));
  const Doubles bottom = floor(smaller(larger(y + ry + half, zero), height));
  const Doubles limit = all(1e300);
  const DoubleMask finite = both(above(limit, g.det), both(above(limit, magnitude(x)), above(limit, magnitude(y))));
  const DoubleMask on_image = both(above(right, left), above(bottom, top));
  const unsigned drawn = bits(both(both(visible, finite), on_image)) << lane;
  if (!drawn) return {0, finite_bits};

  const Doubles over = all(1.0) / g.det, over_a = all(1.0) / root_a, over_c = all(1.0) / root_c;
  const Doubles xx = all(-0.5 * kLog2e) * g.C * over, yy = all(-0.5 * kLog2e) * g.A * over;
  const Doubles xy = all(kLog2e) * g.B * over, spread = half * (g.A - g.C);
  const Doubles half_width = reach * square_root(g.det) * over_c;
  const Doubles longest = half * (g.A + g.C) + square_root(fma(spread, spread, g.B * g.B));
  const Doubles fields[kFields] = {x, y, xx, xy, yy, g.B * over_c * over_c, half_width, all(1.0) / ry,
                                   reach * g.B * over_a, left, right, top, bottom, all(3.0) * square_root(longest)};
  for (int n = 0; n < kFields; n++) store(out.fields[n] + lane, fields[n]);
  store_floats(out.curvature + lane, larger(-larger(xx, yy) - half * magnitude(xy), zero));
  store_floats(out.depth + lane, g.z);
  store_floats(out.log2_opacity + lane, log2_opacity);
  return {drawn, finite_bits};
}

// Returns true if all values are finite.
bool all_finite(const float* values, int count) {
  uint32_t infinite = 0;
  for (int n = 0; n < count; n++) {
    uint32_t bits;
    std::memcpy(&bits, values + n, sizeof bits);
    infinite |= (bits & 0x7F800000) == 0x7F800000;
  }
  return !infinite;
}

// Projects a block, and returns the number of its splats with NaN or infinity; 0 unless `count_bad`.
int64_t project_block(Renderer& renderer, const Splats& splats, const View& view, double log2_least, int64_t block,
                      float* radii, bool count_bad) {
  const int64_t first = block * kBlock;
  const int count = static_cast<int>(std::min<int64_t>(kBlock, splats.count - first)), higher = splats.higher();
  const int64_t row = 3 * splats.coefficients;
  float* depths = renderer.depths.data() + first;
  int32_t* tile_counts = renderer.tile_counts.data() + first;
  alignas(64) float values[kValues * kBlock];
  load_block(splats, block, values);
  Lanes lanes;
  unsigned drawn = 0, finite = 0;
  for (int lane = 0; lane < kBlock; lane += kDoubles) {
    const Drawn found = project_lanes(splats, values, view, log2_least, lane, lanes);
    if (found.drawn && !drawn) prefetch(splats.shN + row * first, row * count);
    drawn |= found.drawn;
    finite |= found.finite;
  }
  const unsigned real = (1u << count) - 1;
  int64_t bad = __builtin_popcount(real & ~finite);
  drawn &= real;
  renderer.drawn[block] = drawn != 0;
  std::memset(depths, 0, count * sizeof(float));
  std::memset(tile_counts, 0, count * sizeof(int32_t));
  if (radii) std::memset(radii + first, 0, count * sizeof(float));
  if (count_bad)
    for (unsigned rest = real & finite & ~drawn; rest; rest &= rest - 1) {
      const int64_t i = first + __builtin_ctz(rest);
      bad += !(all_finite(splats.sh0 + 3 * i, 3) && all_finite(splats.shN + row * i, 3 * higher));
    }
  if (!drawn) return bad;
  alignas(64) float basis[kBasis * kBlock];
  alignas(64) float directions[3 * kBlock];
  alignas(64) double over_distance[kBlock];
  view_directions(values, view.camera, directions, over_distance);
  block_basis(splats.degree, directions, basis);
  for (; drawn; drawn &= drawn - 1) {
    const int lane = __builtin_ctz(drawn);
    const int64_t i = first + lane;
    const float* sh = splats.shN + row * i;
    float colour[3];
    for (int c = 0; c < 3; c++) colour[c] = std::fma(basis[lane], splats.sh0[3 * i + c], 0.5f);
    for (int k = 0; k < higher; k++)
      for (int c = 0; c < 3; c++) colour[c] = std::fma(basis[(k + 1) * kBlock + lane], sh[3 * k + c], colour[c]);
    if (!std::isfinite(colour[0] + colour[1] + colour[2])) {
      bad++;
      continue;
    }
    const auto field = [&](Field n) { return lanes.fields[n][lane]; };
    const auto pixel = [&](Field n) { return static_cast<int32_t>(lanes.fields[n][lane]); };
    const Splat& splat = renderer.splats[i] = {
        field(kX), field(kY), field(kXX), field(kXY), field(kYY), lanes.log2_opacity[lane], lanes.depth[lane],
        {std::max(colour[0], 0.0f), std::max(colour[1], 0.0f), std::max(colour[2], 0.0f)}, lanes.curvature[lane]};
    const Extent& extent = renderer.extents[i] = {field(kSlope), field(kHalfWidth), field(kFlatness), field(kWidest),
                                                  pixel(kLeft), pixel(kRight), pixel(kTop), pixel(kBottom)};
    int32_t tiles = 0;
    for_each_span(splat, extent, [&tiles](int, int begin, int end) { tiles += end - begin; });
    if (!tiles || !std::isfinite(splat.depth)) continue;
    depths[lane] = splat.depth;
    tile_counts[lane] = tiles;
    if (radii) radii[i] = static_cast<float>(field(kRadius));
  }
  return count_bad ? bad : 0;
}

}  // namespace
}  // namespace csplat

using namespace csplat;

CSPLAT_API Renderer* csplat_new_renderer() {
  try {
    return new Renderer;
  } catch (const std::exception&) {
    return nullptr;
  }
}

CSPLAT_API void csplat_delete_renderer(Renderer* renderer) { delete renderer; }

// Projects the splats of a view, and returns the number of pairs of splat and tile.
//
// radii: [N], or null, as in `RenderResult`. counts: [2], the number of drawn splats, and of splats with NaN or
// infinity; or null.
CSPLAT_API int64_t csplat_project(int64_t threads, Renderer* renderer, const Splats* splats, const View* view,
                                  float* radii, int64_t* counts) {
  return guarded([&]() -> int64_t {
    const int64_t blocks = splats->blocks(), places = blocks * kBlock, runs = (blocks + 15) / 16;
    renderer->splats.reserve(places);
    renderer->extents.reserve(places);
    renderer->depths.reserve(places);
    renderer->tile_counts.reserve(places);
    renderer->drawn.reserve(blocks);
    std::vector<int64_t> bad(runs), drawn(runs), pairs(runs);
    const double log2_least = csplat::log2(view->alpha_min);
    parallel_runs(threads, blocks, 16, [&](int64_t begin, int64_t end, int) {
      for (int64_t block = begin; block < end; block++)
        bad[begin / 16] += project_block(*renderer, *splats, *view, log2_least, block, radii, counts != nullptr);
      for (int64_t i = begin * kBlock; i < std::min(end * kBlock, splats->count); i++) {
        drawn[begin / 16] += renderer->tile_counts[i] > 0;
        pairs[begin / 16] += renderer->tile_counts[i];
      }
    });
    int64_t totals[3] = {0, 0, 0};
    for (int64_t run = 0; run < runs; run++) {
      totals[0] += drawn[run];
      totals[1] += bad[run];
      totals[2] += pairs[run];
    }
    if (counts) std::copy(totals, totals + 2, counts);
    renderer->drawn_count = totals[0];
    return renderer->pair_count = totals[2];
  });
}

// Copies depths and numbers of tiles of the splats that `csplat_project` found, [N] each; 0 for all others.
CSPLAT_API int64_t csplat_visible(int64_t, const Renderer* renderer, int64_t count, float* depths, int32_t* tiles) {
  std::copy(renderer->depths.data(), renderer->depths.data() + count, depths);
  std::copy(renderer->tile_counts.data(), renderer->tile_counts.data() + count, tiles);
  return 0;
}
