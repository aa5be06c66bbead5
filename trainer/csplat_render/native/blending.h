// Blending of the splats of a tile, front to back, and passes over the same splats back to front; vectorised over
// squares of 4 × 4 pixels.
//
// At a pixel, with transmittance T = 1 before the first splat:
//
//     alpha = min(opacity · exp(−½ dᵀ Σ⁻¹ d), cap), and 0 below alpha_min
//     w = T · alpha
//     colour += w · c
//     T ← T · (1 − alpha); if this is below the minimum, the pixel is finished instead, without this splat
//
// In each tile, the exponent of 2 is rewritten in double as a polynomial about the centre of each square, so float
// suffices for the pixels however far away the centre of the splat is. A square is left out if an upper bound of the
// exponent shows that the splat is invisible in it: with (x, y) the distance from the centre of the square and K such
// that xx x² + xy x y + yy y² <= −K (x² + y²),
//
//     max of the exponent <= constant + Σ over x and y of max{|k| t − K t² : 0 <= t <= half the size}
//
// Alphas and weights are kept for the way back. A part is the lanes of a square that fit in a register: two with AVX2,
// which are left out independently, since this adds zeros to sums that have the same order without.
#pragma once

#include <cmath>

#include "renderer.h"

namespace csplat {

constexpr int kTilePixels = kTile * kTile;
constexpr int kSquare = 4;                        // width and height of a square, pixels
constexpr int kSquares = kTilePixels / kBlock;    // squares per tile
constexpr int kRows = kBlock / kParts / kSquare;  // rows of a part
constexpr int kBatch = 8;                         // splats that are expanded before they are blended
constexpr float kMargin = 0.01f;                  // margin of the bounds of exponents of 2, for rounding
constexpr uint32_t kAllParts = kParts == 1 ? 0xFFFF : 0xFFFFFFFF;
constexpr uint32_t kAllSquares = (1u << kSquares) - 1, kAllLanes = (1u << kFloats) - 1;
constexpr size_t kMostKept = 2 * kTilePixels;  // numbers that a splat keeps at most

struct Positions {
  alignas(64) double squares[kSquare] = {-6.0, -2.0, 2.0, 6.0};  // centres, relative to that of the tile
  // Of lanes, relative to the centre of a square, and their products.
  alignas(64) float lane_x[kBlock], lane_y[kBlock], lane_xx[kBlock], lane_xy[kBlock], lane_yy[kBlock];
  // Of pixels, square by square, relative to the centre of the tile.
  alignas(64) float x[kTilePixels], y[kTilePixels];

  constexpr Positions() : lane_x(), lane_y(), lane_xx(), lane_xy(), lane_yy(), x(), y() {
    for (int lane = 0; lane < kBlock; lane++) {
      lane_x[lane] = static_cast<float>(lane % kSquare) - 1.5f;
      lane_y[lane] = static_cast<float>(lane / kSquare) - 1.5f;
      lane_xx[lane] = lane_x[lane] * lane_x[lane];
      lane_xy[lane] = lane_x[lane] * lane_y[lane];
      lane_yy[lane] = lane_y[lane] * lane_y[lane];
      for (int square = 0; square < kSquares; square++) {
        x[square * kBlock + lane] = static_cast<float>(square % kSquare * kSquare - 6) + lane_x[lane];
        y[square * kBlock + lane] = static_cast<float>(square / kSquare * kSquare - 6) + lane_y[lane];
      }
    }
  }
};
inline constexpr Positions kPositions;

// The pixels of a tile, square by square.
struct Tile {
  alignas(64) float transmittance[kTilePixels];  // negative for finished pixels
  alignas(64) float colour[3][kTilePixels], depth[kTilePixels];
  int left, top, columns, rows;
  uint32_t unfinished;  // a bit for each part: those of the first part of each square, then those of the second
};

// The exponent of a splat about the centre of each square: constant + x_slope x + y_slope y + bend.
struct Exponents {
  alignas(64) float constant[kSquares], x_slope[kSquares], y_slope[kSquares], bend[kBlock];
  float colour[3], depth;
  uint32_t visible;  // a bit for each part
};

struct Limits {
  float exponent, transmittance_min;  // least exponent of 2 of alpha, and least transmittance

  explicit Limits(const View& view)
      : exponent(static_cast<float>(csplat::log2(view.alpha_min))),
        transmittance_min(static_cast<float>(view.transmittance_min)) {}
};

// Calls function(pixel, place of the pixel in a tile) for each pixel of a tile on the image.
template <typename Function>
void for_each_pixel(const Tile& tile, const View& view, Function&& function) {
  for (int y = 0; y < tile.rows; y++)
    for (int x = 0; x < tile.columns; x++)
      function(static_cast<size_t>(tile.top + y) * view.width + tile.left + x,
               (y / kSquare * kSquare + x / kSquare) * kBlock + y % kSquare * kSquare + x % kSquare);
}

// Clears the bits of parts whose pixels are finished. Done between batches: within, each splat would wait for the last.
inline void update_unfinished(Tile& tile) {
  for (uint32_t rest = tile.unfinished; rest; rest &= rest - 1) {
    const int bit = __builtin_ctz(rest);
    const Floats t = load(tile.transmittance + bit % kSquares * kBlock + bit / kSquares * kFloats);
    if (negative_lanes(t) == kAllLanes) tile.unfinished &= ~(1u << bit);
  }
}

inline void begin_tile(const View& view, int index, Tile& tile) {
  tile.left = index % view.tiles_x() * kTile;
  tile.top = index / view.tiles_x() * kTile;
  tile.columns = static_cast<int>(std::min<int64_t>(kTile, view.width - tile.left));
  tile.rows = static_cast<int>(std::min<int64_t>(kTile, view.height - tile.top));
  std::memset(tile.colour, 0, sizeof tile.colour);
  std::memset(tile.depth, 0, sizeof tile.depth);
  for (float& t : tile.transmittance) t = -1.0f;
  for_each_pixel(tile, view, [&](size_t, int place) { tile.transmittance[place] = 1.0f; });
  tile.unfinished = kAllParts;
}

// Returns the maximum of |k| t − K t² for 0 <= t <= size.
inline Floats highest(Floats slope, Floats curvature, Floats half_over_curvature, Floats size) {
  const Floats k = magnitude(slope), t = smaller(k * half_over_curvature, size);
  return t * fnma(curvature, t, k);
}

// Expands the exponent of a splat in a tile, and marks the parts in which it may be at least `least`.
inline void expand(const Splat& s, const Tile& tile, float least, Exponents& e) {
  const double dx = tile.left + 0.5 * kTile - s.x, dy = tile.top + 0.5 * kTile - s.y;
  const double constant = std::fma(std::fma(s.xx, dx, s.xy * dy), dx, std::fma(s.yy * dy, dy, s.log2_opacity));
  const Doubles xx = all(s.xx), xy = all(s.xy), yy = all(s.yy), x = load(kPositions.squares);
  const Doubles along = fma(x, xx, all(std::fma(2.0 * s.xx, dx, s.xy * dy)));
  const Doubles constants = fma(x, along, all(constant)), x_slopes = fma(x, xx, along);
  const Doubles y_slopes = fma(x, xy, all(std::fma(2.0 * s.yy, dy, s.xy * dx)));
  Fours k0_rows[kSquare], kx_rows[kSquare], ky_rows[kSquare];
  for (int row = 0; row < kSquare; row++) {
    const Doubles y = all(kPositions.squares[row]), half_way = fma(y, yy, y_slopes);
    k0_rows[row] = to_floats(fma(y, half_way, constants));
    kx_rows[row] = to_floats(fma(y, xy, x_slopes));
    ky_rows[row] = to_floats(fma(y, yy, half_way));
  }
  const Floats float_xx = all(static_cast<float>(s.xx)), float_xy = all(static_cast<float>(s.xy));
  const Floats float_yy = all(static_cast<float>(s.yy));
  for (int lanes = 0; lanes < kBlock; lanes += kFloats) {
    const Floats square = fma(float_xx, load(kPositions.lane_xx + lanes), float_yy * load(kPositions.lane_yy + lanes));
    store(e.bend + lanes, fma(float_xy, load(kPositions.lane_xy + lanes), square));
  }
  for (int c = 0; c < 3; c++) e.colour[c] = s.colour[c];
  e.depth = s.depth;

  const Floats K = all(s.curvature), half_over = all(0.5f / s.curvature), lowest = all(least);
  const Floats half_width = all(0.5f * (kSquare - 1)), half_height = all(0.5f * (kRows - 1));
  e.visible = 0;
  for (int square = 0; square < kSquares; square += kFloats) {
    const int row = square / kSquare;
    const Floats k0 = join(k0_rows + row), kx = join(kx_rows + row), ky = join(ky_rows + row);
    store(e.constant + square, k0);
    store(e.x_slope + square, kx);
    store(e.y_slope + square, ky);
    for (int part = 0; part < kParts; part++) {
      const Floats y = all(static_cast<float>(part * kRows) - 0.5f * (kSquare - kRows));  // centre of the part
      const Floats part_k0 = kParts == 1 ? k0 : fma(y, fma(y, float_yy, ky), k0);
      const Floats part_kx = kParts == 1 ? kx : fma(y, float_xy, kx);
      const Floats part_ky = kParts == 1 ? ky : fma(y + y, float_yy, ky);
      const Floats rise_x = highest(part_kx, K, half_over, half_width);
      const Floats rise_y = highest(part_ky, K, half_over, half_height);
      e.visible |= bits(at_least(part_k0 + rise_x + rise_y, lowest)) << (part * kSquares + square);
    }
  }
}

// Blends a splat; if asked to, keeps alphas and weights of the parts that it changes, and returns where the next go.
template <bool kKeep, bool kDepth>
float* blend_splat(const Exponents& e, const Limits& limits, Tile& tile, float* kept, uint32_t* touched) {
  const Floats red = all(e.colour[0]), green = all(e.colour[1]), blue = all(e.colour[2]), depth = all(e.depth);
  uint32_t changed = 0;
  for (uint32_t rest = e.visible & tile.unfinished; rest; rest &= rest - 1) {
    const int bit = __builtin_ctz(rest), square = bit % kSquares, lanes = bit / kSquares * kFloats;
    const int place = square * kBlock + lanes;
    const Floats x = load(kPositions.lane_x + lanes), y = load(kPositions.lane_y + lanes);
    const Floats rest_of_sum = fma(all(e.y_slope[square]), y, load(e.bend + lanes) + all(e.constant[square]));
    const Floats exponent = fma(all(e.x_slope[square]), x, rest_of_sum);
    const Mask seen = at_least(exponent, all(limits.exponent));
    if (!bits(seen)) continue;
    const Floats alpha = keep(seen, smaller(exp2_within(exponent), all(kAlphaCap)));
    const Floats before = load(tile.transmittance + place);
    const Floats weight_if_going = before * alpha;
    const Mask going = at_least(before - weight_if_going, all(limits.transmittance_min));
    const Floats weight = keep(going, weight_if_going), after = negate_outside(going, before - weight);
    store(tile.transmittance + place, after);
    store(tile.colour[0] + place, fma(weight, red, load(tile.colour[0] + place)));
    store(tile.colour[1] + place, fma(weight, green, load(tile.colour[1] + place)));
    store(tile.colour[2] + place, fma(weight, blue, load(tile.colour[2] + place)));
    if (kDepth) store(tile.depth + place, fma(weight, depth, load(tile.depth + place)));
    if (kKeep) {
      store(kept, keep(going, alpha));
      store(kept + kFloats, weight);
      kept += 2 * kFloats;
      changed |= 1u << bit;
    }
  }
  if (kKeep) *touched = changed;
  return kept;
}

// The splats of a tile that were blended.
struct Blended {
  const Pair* pairs;
  int count, used;     // pairs of the tile, and those before all of its pixels were finished
  const float* kept;   // end of the alphas and weights
};

// Blends the splats of a tile, after `begin_tile`.
template <bool kKeep, bool kDepth>
Blended blend_tile(const Renderer& renderer, const Limits& limits, int index, Tile& tile, Scratch& scratch) {
  const Pair* pairs = renderer.pairs.data() + renderer.starts[index];
  const int count = renderer.starts[index + 1] - renderer.starts[index];
  if (kKeep) scratch.touched.reserve(count);
  update_unfinished(tile);
  size_t kept = 0;
  Exponents batch[kBatch];
  int used = 0;
  while (used < count && tile.unfinished) {
    const int size = std::min(kBatch, count - used);
    for (int n = 0; n < size; n++) {
      if (used + n + kBatch < count) __builtin_prefetch(&renderer.splats[pairs[used + n + kBatch].splat]);
      expand(renderer.splats[pairs[used + n].splat], tile, limits.exponent - kMargin, batch[n]);
    }
    if (kKeep) scratch.kept.reserve(kept + kBatch * kMostKept, kept);
    float* to = scratch.kept.data() + kept;
    uint32_t* touched = scratch.touched.data() + used;
    for (int n = 0; n < size; n++) to = blend_splat<kKeep, kDepth>(batch[n], limits, tile, to, touched + n);
    if (kKeep) kept = to - scratch.kept.data();
    used += size;
    update_unfinished(tile);
  }
  return {pairs, count, used, scratch.kept.data() + kept};
}

// Calls function(splat, record, parts, kept) for the blended splats of a tile from back to front: parts has a bit for
// each part that the splat changes, kept points to the end of its alphas and weights, and the function returns their
// start; parts is 0 for splats that change nothing.
template <typename Function>
void for_each_behind(const Renderer& renderer, const Blended& blended, const Scratch& scratch, Function&& function) {
  const float* kept = blended.kept;
  for (int n = blended.count - 1; n >= 0; n--) {
    const Pair pair = blended.pairs[n];
    kept = function(renderer.splats[pair.splat], pair.record, n < blended.used ? scratch.touched[n] : 0, kept);
  }
}

// Sums of `kSums` values over the parts of a tile in which a splat changes pixels, from the last square to the first.
//
// Calls function(place, alpha, weight, sums) for each part: `place` is that of its first pixel; the function adds to
// `sums`. Writes the totals, and returns the start of the splat's alphas and weights.
template <int kSums, typename Function>
const float* sum_parts(uint32_t parts, const float* kept, float* totals, Function&& function) {
  Floats sums[kSums][kParts];
  for (int part = kParts - 1; part >= 0; part--) {
    Floats own[kSums];
    for (Floats& sum : own) sum = all(0.0f);
    for (uint32_t squares = parts >> (part * kSquares) & kAllSquares; squares;) {
      const int square = 31 - __builtin_clz(squares);
      squares ^= 1u << square;
      kept -= 2 * kFloats;
      function(square * kBlock + part * kFloats, load(kept), load(kept + kFloats), own);
    }
    for (int n = 0; n < kSums; n++) sums[n][part] = own[n];
  }
  Eights folded[(kSums + 7) / 8 * 8];
  for (int n = 0; n < kSums; n++) folded[n] = fold(sums[n]);
  int n = 0;
  for (; n + 8 <= kSums; n += 8) store(totals + n, sum_lanes(folded + n));
  for (; n < kSums; n++) totals[n] = sum_lanes(folded[n]);
  return kept;
}

}  // namespace csplat
