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
#include "binning.h"

namespace csplat {
namespace {

constexpr double kLn2 = 0.6931471805599453, kLog2e = 1.4426950408889634;

// Results of a block, lane by lane: first those of a `Splat`, then those of an `Extent`.
enum Field { kX, kY, kXX, kXY, kYY, kLog2Opacity,
             kSlope, kHalfWidth, kFlatness, kWidest, kLeft, kRight, kTop, kBottom, kFields };
struct Lanes {
  alignas(64) double fields[kFields][kBlock];
  alignas(64) float depth[kBlock], curvature[kBlock], colour[3][kBlock];
};

// Projects some lanes of a block, and returns a bit for each splat that may be drawn.
unsigned project_lanes(const float* values, const Image& image, int lane, Lanes& out) {
  const double* view = image.view;
  const Doubles zero = all(0.0), half = all(0.5), alpha_min = all(image.alpha_min);
  const Doubles width = all(static_cast<double>(image.width)), height = all(static_cast<double>(image.height));
  Geometry g;
  project_centres(values + lane, view, g);
  const Doubles opacity = opacity_of(values + kLogit * kBlock + lane);
  Doubles sum = zero;  // NaN if a value of the shape is not finite
  for (int n = 0; n < kSh0; n++) sum = sum + zero * load_doubles(values + n * kBlock + lane);
  const DoubleMask valid = both(at_least(zero, sum), at_least(opacity, alpha_min));
  const DoubleMask in_front = both(valid, above(g.z, all(view[kNear])));
  if (!bits(in_front)) return 0;
  project_jacobian(view, g);
  const Doubles x = all(view[kFocal]) * (g.x / g.z) + all(view[kPrincipal]);
  const Doubles y = all(view[kFocal + 1]) * (g.y / g.z) + all(view[kPrincipal + 1]);
  const Doubles log2_opacity = log2(opacity);
  // ρ, slightly enlarged so that rounding never loses a pixel.
  const Doubles squared = all(2.0 * kLn2) * (log2_opacity - all(std::log2(image.alpha_min)));
  const Doubles reach = fma(square_root(larger(squared, zero)), all(1.0 + 1e-6), all(1e-6));

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
    if (!bits(both(in_front, both(near_columns, near_rows)))) return 0;
  }

  project_shape(values + lane, g);
  const Doubles root_a = square_root(g.A), root_c = square_root(g.C), rx = reach * root_a, ry = reach * root_c;
  const Doubles left = ceiling(smaller(larger(x - rx - half, zero), width));
  const Doubles right = floor(smaller(larger(x + rx + half, zero), width));
  const Doubles top = ceiling(smaller(larger(y - ry - half, zero), height));
  const Doubles bottom = floor(smaller(larger(y + ry + half, zero), height));
  const Doubles limit = all(1e300);
  const DoubleMask finite = both(above(limit, g.det), both(above(limit, magnitude(x)), above(limit, magnitude(y))));
  const DoubleMask on_image = both(above(right, left), above(bottom, top));
  const unsigned drawn = bits(both(both(in_front, finite), on_image));
  if (!drawn) return 0;

  const Doubles over = all(1.0) / g.det, over_a = all(1.0) / root_a, over_c = all(1.0) / root_c;
  const Doubles xx = all(-0.5 * kLog2e) * g.C * over, yy = all(-0.5 * kLog2e) * g.A * over;
  const Doubles xy = all(kLog2e) * g.B * over;
  const Doubles half_width = reach * square_root(g.det) * over_c;
  const Doubles fields[kFields] = {x, y, xx, xy, yy, log2_opacity, g.B * over_c * over_c, half_width, all(1.0) / ry,
                                   reach * g.B * over_a, left, right, top, bottom};
  for (int n = 0; n < kFields; n++) store(out.fields[n] + lane, fields[n]);
  store_floats(out.curvature + lane, larger(zero - larger(xx, yy) - half * magnitude(xy), zero));
  store_floats(out.depth + lane, g.z);
  return drawn << lane;
}

// Computes the colours of a block before clamping: Σ_k Y_k(direction) · sh_k + ½.
void project_colours(const Engine& engine, const float* values, const double* view, Lanes& out) {
  alignas(64) float directions[3 * kBlock];
  view_directions(values, view, directions);
  for (int lane = 0; lane < kBlock; lane += kFloats) {
    const float* d = directions + lane;
    Floats basis[16];
    sh_basis(engine.degree, load(d), load(d + kBlock), load(d + 2 * kBlock), basis);
    for (int c = 0; c < 3; c++) {
      const float* sh = values + (kSh0 + c) * kBlock + lane;
      Floats colour = fma(basis[0], load(sh), all(0.5f));
      for (int k = 1; k <= engine.higher; k++) colour = fma(basis[k], load(sh + 3 * k * kBlock), colour);
      store(out.colour[c] + lane, colour);
    }
  }
}

void project_block(Engine& engine, const Image& image, int block) {
  const float* values = engine.values.data() + static_cast<size_t>(block) * engine.value_count * kBlock;
  float* depths = engine.depths.data() + static_cast<size_t>(block) * kBlock;
  int32_t* tile_counts = engine.tile_counts.data() + static_cast<size_t>(block) * kBlock;
  Lanes lanes;
  unsigned drawn = 0;
  for (int lane = 0; lane < kBlock; lane += kDoubles) drawn |= project_lanes(values, image, lane, lanes);
  if (const int left = engine.count - block * kBlock; left < kBlock) drawn &= (1u << left) - 1;
  engine.drawn[block] = drawn != 0;
  if (!drawn) return;
  std::memset(depths, 0, kBlock * sizeof(float));
  std::memset(tile_counts, 0, kBlock * sizeof(int32_t));
  project_colours(engine, values, image.view, lanes);
  for (; drawn; drawn &= drawn - 1) {
    const int lane = __builtin_ctz(drawn);
    const size_t i = static_cast<size_t>(block) * kBlock + lane;
    const auto field = [&](Field n) { return lanes.fields[n][lane]; };
    const auto pixel = [&](Field n) { return static_cast<int32_t>(lanes.fields[n][lane]); };
    const float red = lanes.colour[0][lane], green = lanes.colour[1][lane], blue = lanes.colour[2][lane];
    if (!std::isfinite(red + green + blue)) continue;
    const Splat& splat = engine.splats[i] = {
        field(kX), field(kY), field(kXX), field(kXY), field(kYY), field(kLog2Opacity),
        {std::max(red, 0.0f), std::max(green, 0.0f), std::max(blue, 0.0f)}, lanes.curvature[lane]};
    const Extent& extent = engine.extents[i] = {field(kSlope), field(kHalfWidth), field(kFlatness), field(kWidest),
                                                pixel(kLeft), pixel(kRight), pixel(kTop), pixel(kBottom)};
    int32_t tiles = 0;
    for_each_span(splat, extent, [&tiles](int, int begin, int end) { tiles += end - begin; });
    if (!tiles || !std::isfinite(lanes.depth[lane])) continue;
    depths[lane] = lanes.depth[lane];
    tile_counts[lane] = tiles;
  }
}

}  // namespace

void project(Engine& engine, const Image& image) {
  for_each_block(engine, [&](int block) { project_block(engine, image, block); });
}

}  // namespace csplat
