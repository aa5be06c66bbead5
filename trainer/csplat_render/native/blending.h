// SPDX-License-Identifier: Apache-2.0
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
// Alphas and weights are kept for the way back. A part is the lanes of a square that fit in a register: two with AVX2.
#pragma once

#include <cmath>

#include "renderer.h"

namespace csplat {

constexpr int kTilePixels = kTile * kTile;
constexpr int kSquare = 4;                        // width and height of a square, pixels
constexpr int kSquares = kTilePixels / kBlock;    // squares per tile
constexpr int kBatch = 16;                        // splats that are expanded before they are blended
constexpr float kMargin = 0.01f;                  // margin of the bounds of exponents of 2, for rounding
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
  uint32_t unfinished;  // a bit for each square
};

// The exponent of a splat about the centre of each square: constant + x_slope x + y_slope y + bend.
struct Exponents {
  alignas(64) float constant[kSquares], x_slope[kSquares], y_slope[kSquares], bend[kBlock];
  const Splat* splat;
  uint32_t visible;  // a bit for each square
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
  for (int y = 0; y < tile.rows; y++) {
    const size_t row = static_cast<size_t>(tile.top + y) * view.width + tile.left;
    for (int x = 0, place = y / kSquare * kSquare * kBlock + y % kSquare * kSquare; x < tile.columns; place += kBlock)
      for (const int end = x + kSquare, from = x; x < end && x < tile.columns; x++) function(row + x, place + x - from);
  }
}

// Clears the bits of finished squares. Done between batches: within, each splat would wait for the last.
inline void update_unfinished(Tile& tile) {
  for (uint32_t rest = tile.unfinished; rest; rest &= rest - 1) {
    const float* t = tile.transmittance + __builtin_ctz(rest) * kBlock;
    uint32_t finished = kAllLanes;
    for (int lanes = 0; lanes < kBlock; lanes += kFloats) finished &= negative_lanes(load(t + lanes));
    if (finished == kAllLanes) tile.unfinished ^= rest & -rest;
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
  tile.unfinished = kAllSquares;
}

// Returns the maximum of |k| t − K t² for 0 <= t <= size.
inline Floats highest(Floats slope, Floats curvature, Floats half_over_curvature, Floats size) {
  const Floats k = magnitude(slope), t = smaller(k * half_over_curvature, size);
  return t * fnma(curvature, t, k);
}

// Expands the exponent of a splat in a tile, and marks the squares in which it may be at least `least`.
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
  e.splat = &s;

  const Floats K = all(s.curvature), half_over = all(0.5f / s.curvature), lowest = all(least);
  const Floats half_size = all(0.5f * (kSquare - 1));
  e.visible = 0;
  for (int square = 0; square < kSquares; square += kFloats) {
    const int row = square / kSquare;
    const Floats k0 = join(k0_rows + row), kx = join(kx_rows + row), ky = join(ky_rows + row);
    store(e.constant + square, k0);
    store(e.x_slope + square, kx);
    store(e.y_slope + square, ky);
    const Floats rise = highest(kx, K, half_over, half_size) + highest(ky, K, half_over, half_size);
    e.visible |= bits(at_least(k0 + rise, lowest)) << square;
  }
}

// Blends a splat; if asked to, keeps alphas and weights of the squares that it may change, and returns where the next
// go. Takes no shortcuts where alpha is 0, which would be hard to predict; `exp2_within` is out of its range there.
template <bool kKeep, bool kColour, bool kDepth>
float* blend_splat(const Exponents& e, const Limits& limits, Tile& tile, float* kept, uint32_t* touched) {
  const Splat& s = *e.splat;
  const Floats red = all(s.colour[0]), green = all(s.colour[1]), blue = all(s.colour[2]), depth = all(s.depth);
  const Floats lowest = all(limits.exponent), transmittance_min = all(limits.transmittance_min), cap = all(kAlphaCap);
  const uint32_t visible = e.visible & tile.unfinished;
  for (uint32_t rest = visible; rest; rest &= rest - 1) {
    const int square = __builtin_ctz(rest);
    const Floats constant = all(e.constant[square]), x_slope = all(e.x_slope[square]), y_slope = all(e.y_slope[square]);
    for (int lanes = 0; lanes < kBlock; lanes += kFloats) {
      const int place = square * kBlock + lanes;
      const Floats x = load(kPositions.lane_x + lanes), y = load(kPositions.lane_y + lanes);
      const Floats exponent = fma(x_slope, x, fma(y_slope, y, load(e.bend + lanes) + constant));
      const Floats alpha = keep(at_least(exponent, lowest), smaller(exp2_within(exponent), cap));
      const Floats before = load(tile.transmittance + place), weight_if_going = before * alpha;
      const Floats after = before - weight_if_going;
      const Mask going = at_least(after, transmittance_min);
      const Floats weight = keep(going, weight_if_going);
      store(tile.transmittance + place, select(going, after, negative(before)));
      if (kColour) {
        store(tile.colour[0] + place, fma(weight, red, load(tile.colour[0] + place)));
        store(tile.colour[1] + place, fma(weight, green, load(tile.colour[1] + place)));
        store(tile.colour[2] + place, fma(weight, blue, load(tile.colour[2] + place)));
      }
      if (kDepth) store(tile.depth + place, fma(weight, depth, load(tile.depth + place)));
      if (kKeep) {
        store(kept + lanes, keep(going, alpha));
        store(kept + kBlock + lanes, weight);
      }
    }
    if (kKeep) kept += 2 * kBlock;
  }
  if (kKeep) *touched = visible;
  return kept;
}

// The splats of a tile that were blended.
struct Blended {
  const Pair* pairs;
  int count, used;     // pairs of the tile, and those before all of its pixels were finished
  const float* kept;   // end of the alphas and weights
};

// Blends the splats of a tile, after `begin_tile`.
template <bool kKeep, bool kColour, bool kDepth>
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
    for (int n = 0; n < size; n++) to = blend_splat<kKeep, kColour, kDepth>(batch[n], limits, tile, to, touched + n);
    if (kKeep) kept = to - scratch.kept.data();
    used += size;
    update_unfinished(tile);
  }
  return {pairs, count, used, scratch.kept.data() + kept};
}

// Calls function(splat, record, squares, kept) for the blended splats of a tile from back to front: squares has a bit
// for each square that the splat may change, kept points to the end of its alphas and weights, and the function returns
// their start.
template <typename Function>
void for_each_behind(const Renderer& renderer, const Blended& blended, const Scratch& scratch, Function&& function) {
  const float* kept = blended.kept;
  for (int n = blended.count - 1; n >= 0; n--) {
    const Pair pair = blended.pairs[n];
    kept = function(renderer.splats[pair.splat], pair.record, n < blended.used ? scratch.touched[n] : 0, kept);
  }
}

// Sums of `kSums` values over the squares of a tile in which a splat may change pixels, from the last to the first.
//
// Calls function(place, alpha, weight, sums) for each part: `place` is that of its first pixel; the function adds to
// `sums`. Writes the totals, and returns the start of the splat's alphas and weights.
template <int kSums, typename Function>
const float* sum_squares(uint32_t squares, const float* kept, float* totals, Function&& function) {
  Floats sums[kSums][kParts];
  for (int part = 0; part < kParts; part++) {
    const float* from = kept + part * kFloats;
    Floats own[kSums];
    for (Floats& sum : own) sum = all(0.0f);
    for (uint32_t rest = squares; rest;) {
      const int square = 31 - __builtin_clz(rest);
      rest ^= 1u << square;
      from -= 2 * kBlock;
      function(square * kBlock + part * kFloats, load(from), load(from + kBlock), own);
    }
    for (int n = 0; n < kSums; n++) sums[n][part] = own[n];
  }
  Eights folded[(kSums + 7) / 8 * 8];
  for (int n = 0; n < kSums; n++) folded[n] = fold(sums[n]);
  int n = 0;
  for (; n + 8 <= kSums; n += 8) store(totals + n, sum_lanes(folded + n));
  for (; n < kSums; n++) totals[n] = sum_lanes(folded[n]);
  return kept - 2 * kBlock * __builtin_popcount(squares);
}

}  // namespace csplat
