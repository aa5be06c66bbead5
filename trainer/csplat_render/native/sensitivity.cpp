// SPDX-License-Identifier: Apache-2.0
// Sums over the pixels of a view of the derivatives of its render with respect to each splat; the equations are at the
// top of csplat_trainer.sensitivity.
//
// The passes: coefficients of h and C, by splat; sums over the pixels of each pair of splat and tile, back to front,
// which give the light behind a splat; sums over the tiles of each splat.
#include "blending.h"
#include "geometry.h"
#include "harmonics.h"

namespace csplat {
namespace {

constexpr int kForm = 12;  // the matrix of h by d, [3, 2] row by row; C as xx yy zz xy xz yz

// Sums of a record, in the order of the equations: Σ w, Σ w², Σ s, Σ |s|, Σ s², 6 Σ s t, 6 Σ |s| |t|, Σ s² |h|²,
// 21 Σ s² t tᵀ. Entries of symmetric matrices: xx yy zz xy xz yz, and of t tᵀ the upper triangle, row by row.
constexpr int kTriangle = 21, kFirstSums = 18, kSums = kFirstSums + kTriangle;

void block_forms(const Renderer& renderer, const Splats& splats, const View& view, int64_t block, double* forms) {
  const int64_t first = block * kBlock;
  const int count = static_cast<int>(std::min<int64_t>(kBlock, splats.count - first));
  constexpr int kRow[6] = {0, 1, 2, 0, 0, 1}, kColumn[6] = {0, 1, 2, 1, 2, 2};
  alignas(64) float values[kValues * kBlock];
  load_block(splats, block, values);
  for (int lane = 0; lane < kBlock; lane += kDoubles) {
    Geometry g;
    project_centres(values + lane, view.camera, g);
    project_jacobian(view.camera, g);
    project_shape(values + lane, g);
    const Doubles zero = all(0.0), half = all(0.5) * dot(g.s, g.s), size = square_root(half);
    const Doubles a = g.C / g.det, b = -g.B / g.det, c = g.A / g.det;
    Doubles form[kForm];
    for (int k = 0; k < 3; k++) {
      form[2 * k] = size * fma(g.p[k], a, g.q[k] * b);
      form[2 * k + 1] = size * fma(g.p[k], b, g.q[k] * c);
    }
    // Derivative of log √(det Σ2 / det (Σ2 + dilation)) by Σ2: half the difference of inverses.
    const Doubles dilation = all(kDilation), A = g.A - dilation, C = g.C - dilation;
    const Doubles da = C / g.bare - a, db = -g.B / g.bare - b, dc = A / g.bare - c;
    const DoubleMask counts = above(g.bare, all(kCompensationMin) * g.det);
    for (int e = 0; e < 6; e++) {
      const int k = kRow[e], m = kColumn[e];
      const Doubles left = fma(g.p[k], da, g.q[k] * db), right = fma(g.p[k], db, g.q[k] * dc);
      form[6 + e] = view.antialiased ? select(counts, half * fma(left, g.p[m], right * g.q[m]), zero) : zero;
    }
    for (int e = 0; e < kForm; e++) {
      alignas(32) double lanes[kDoubles];
      store(lanes, form[e]);
      for (int k = 0; k < kDoubles && lane + k < count; k++)
        if (renderer.tile_counts[first + lane + k]) forms[kForm * (first + lane + k) + e] = lanes[k];
    }
  }
}

void measure_tile(Renderer& renderer, const View& view, const double* forms, int index, Scratch& scratch) {
  Tile tile;
  begin_tile(view, index, tile);
  const Blended blended = blend_tile<true, false, false>(renderer, Limits(view), index, tile, scratch);
  for (int c = 0; c < 3; c++)
    std::fill(tile.colour[c], tile.colour[c] + kTilePixels, static_cast<float>(view.background[c]));
  const double x0 = tile.left + 0.5 * kTile, y0 = tile.top + 0.5 * kTile;
  const Floats zero = all(0.0f);
  for (int n = blended.count - 1; n >= blended.used; n--)
    std::memset(renderer.records.data() + static_cast<int64_t>(kSums) * blended.pairs[n].record, 0,
                kSums * sizeof(float));
  const float* kept = blended.kept;
  for (int n = blended.used - 1; n >= 0; n--) {
    const Pair pair = blended.pairs[n];
    const Splat& s = renderer.splats[pair.splat];
    const double* form = forms + static_cast<int64_t>(kForm) * pair.splat;
    float* record = renderer.records.data() + static_cast<int64_t>(kSums) * pair.record;
    Floats h0[3], hx[3], hy[3], base[6];
    for (int k = 0; k < 3; k++) {
      h0[k] = all(static_cast<float>(std::fma(form[2 * k], x0 - s.x, form[2 * k + 1] * (y0 - s.y))));
      hx[k] = all(static_cast<float>(form[2 * k]));
      hy[k] = all(static_cast<float>(form[2 * k + 1]));
    }
    for (int e = 0; e < 6; e++) base[e] = all(static_cast<float>(form[6 + e]));
    const uint32_t squares = scratch.touched[n];
    kept = sum_squares<kSums>(squares, kept, record, [&](int place, Floats alpha, Floats weight, Floats* sums) {
      Floats slope = zero, size = zero, square = zero;
      for (int c = 0; c < 3; c++) {
        const Floats behind = load(tile.colour[c] + place), change = all(s.colour[c]) - behind;
        const Floats derivative = drop(at_least(alpha, all(kAlphaCap)), weight * change);
        store(tile.colour[c] + place, fma(alpha, change, behind));
        slope = slope + derivative;
        size = size + magnitude(derivative);
        square = fma(derivative, derivative, square);
      }
      const Floats x = load(kPositions.x + place), y = load(kPositions.y + place);
      Floats h[3], t[6];
      for (int k = 0; k < 3; k++) h[k] = fma(hy[k], y, fma(hx[k], x, h0[k]));
      for (int k = 0; k < 3; k++) t[k] = fma(h[k], h[k], base[k]);
      t[3] = fma(h[0], h[1], base[3]);
      t[4] = fma(h[0], h[2], base[4]);
      t[5] = fma(h[1], h[2], base[5]);
      sums[0] = sums[0] + weight;
      sums[1] = fma(weight, weight, sums[1]);
      sums[2] = sums[2] + slope;
      sums[3] = sums[3] + size;
      sums[4] = sums[4] + square;
      for (int e = 0; e < 6; e++) {
        sums[5 + e] = fma(slope, t[e], sums[5 + e]);
        sums[11 + e] = fma(size, magnitude(t[e]), sums[11 + e]);
      }
      sums[17] = fma(square, fma(h[0], h[0], fma(h[1], h[1], h[2] * h[2])), sums[17]);
      int at = kFirstSums;
      for (int e = 0; e < 6; e++) {
        const Floats scaled = square * t[e];
        for (int f = e; f < 6; f++, at++) sums[at] = fma(scaled, t[f], sums[at]);
      }
    });
  }
}

// Sums over all views of the scene, see `add_view`.
struct Sums {
  float *colour, *metric;
  double *net, *sizes, *squares, *shape_matrices;
  int64_t* views;
};

// Adds the sums of a view for a block of splats.
void add_block(const Renderer& renderer, const Splats& splats, const View& view, int64_t block, const Sums& out) {
  const int64_t first = block * kBlock;
  const int count = static_cast<int>(std::min<int64_t>(kBlock, splats.count - first)), size = splats.higher() + 1;
  alignas(64) float values[kValues * kBlock], directions[3 * kBlock], basis[kBasis * kBlock];
  alignas(64) double over_distance[kBlock];
  load_block(splats, block, values);
  view_directions(values, view.camera, directions, over_distance);
  block_basis(splats.degree, directions, basis);
  for (int lane = 0; lane < count; lane++) {
    const int64_t i = first + lane;
    if (!renderer.tile_counts[i]) continue;
    double sums[kSums] = {};
    const float* record = renderer.records.data() + static_cast<int64_t>(kSums) * renderer.offsets[i];
    for (int32_t n = 0; n < renderer.tile_counts[i]; n++, record += kSums)
      for (int e = 0; e < kSums; e++) sums[e] += record[e];
    if (!(sums[0] > 0.0)) continue;
    out.views[i]++;
    const auto function = [&](int k) { return static_cast<double>(basis[k * kBlock + lane]); };
    const double alpha = splats.opacities[i];
    if (out.colour) {
      for (int c = 0; c < 3; c++)
        for (int k = 0; k < size && renderer.splats[i].colour[c] > 0.0f; k++) {
          float& sum = out.colour[(i * size + k) * 3 + c];
          sum = static_cast<float>(sum + std::fabs(function(k)) * sums[0]);
        }
      out.net[7 * i] += std::fabs(sums[2]) / alpha;
      out.sizes[7 * i] += sums[3] / alpha;
      for (int e = 0; e < 6; e++) {
        const double twice = e < 3 ? 1.0 : 2.0;  // an entry off the diagonal occurs twice in the covariance
        out.net[7 * i + 1 + e] += twice * std::fabs(sums[5 + e]);
        out.sizes[7 * i + 1 + e] += twice * sums[11 + e];
      }
    }
    float* metric = out.metric ? out.metric + i * (size * (size + 1) / 2) : nullptr;
    for (int k = 0; metric && k < size; k++)
      for (int m = k; m < size; m++, metric++)
        *metric = static_cast<float>(*metric + function(k) * function(m) * sums[1]);
    double variance = 0.0;
    for (int n = 0; n < 3; n++) {
      const double s = exp(std::min(std::max<double>(splats.scales[3 * i + n], -kLogScaleLimit), kLogScaleLimit));
      variance += s * s;
    }
    out.squares[3 * i] += sums[1];
    out.squares[3 * i + 1] += sums[4] / (alpha * alpha);
    out.squares[3 * i + 2] += 2.0 * sums[17] / variance;
    for (int e = 0, at = 0; e < 6; e++)
      for (int f = e; f < 6; f++, at++) {
        const double multiplicity = (e > 2 ? 2.0 : 1.0) * (f > 2 ? 2.0 : 1.0);
        out.shape_matrices[kTriangle * i + at] += std::sqrt(multiplicity) * sums[kFirstSums + at];
      }
  }
}

}  // namespace
}  // namespace csplat

using namespace csplat;

// Adds the derivatives of a view, after `csplat_project` of the same splats.
//
// forms: [N, 12], scratch. The other arrays are incremented: colour: [N, B, 3], |derivative of the render's sum by a
// coefficient|; null if this and the next two are not requested. net: [N, 7], the same for alpha and the six entries of
// the covariance over its trace. sizes: [N, 7], the same with magnitudes taken per pixel and channel. squares: [N, 3],
// squared derivatives of the pixels' channels by a colour (one channel), alpha, and the centre. metric: [N, B (B + 1) /
// 2], squared derivatives by SH coefficients of one channel, the upper triangle of a matrix; or null. shape_matrices:
// [N, 21], squared derivatives of all channels by the covariance over its trace, the upper triangle of a matrix over
// xx, yy, zz, √2 xy, √2 xz, √2 yz. views: [N], by 1 for splats seen.
CSPLAT_API int64_t csplat_add_derivatives(int64_t threads, Renderer* renderer, const Splats* splats, const View* view,
                                          double* forms, float* colour, double* net, double* sizes, double* squares,
                                          float* metric, double* shape_matrices, int64_t* views) {
  return guarded([&]() -> int64_t {
    bin(threads, *renderer, *view, splats->count);
    renderer->reserve_scratch(threads);
    renderer->records.reserve(static_cast<size_t>(kSums) * renderer->pair_count);
    for_each_block(threads, splats->blocks(), [&](int64_t block) {
      if (renderer->drawn[block]) block_forms(*renderer, *splats, *view, block, forms);
    });
    parallel(threads, view->tile_count(), [&](int64_t index, int thread) {
      measure_tile(*renderer, *view, forms, static_cast<int>(index), renderer->scratch[thread]);
    });
    const Sums sums = {colour, metric, net, sizes, squares, shape_matrices, views};
    for_each_block(threads, splats->blocks(), [&](int64_t block) {
      if (renderer->drawn[block]) add_block(*renderer, *splats, *view, block, sums);
    });
    return 0;
  });
}
