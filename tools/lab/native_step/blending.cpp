// Blending of the splats of each tile, front to back, the squared error of its pixels, and the gradient, back to front;
// parallel over tiles, vectorised over squares of 4 × 4 pixels.
//
// Forward, at a pixel, with transmittance T = 1 before the first splat:
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
// Backward. With g the gradient at a pixel and `behind` the part of g·colour due to all farther splats and the
// background, per unit of transmittance:
//
//     slope = ∂loss/∂exponent = w (g·c − behind), and 0 if alpha is capped
//     behind ← behind + alpha (g·c − behind)
//
// Alphas and weights are kept from the forward pass. A part is the lanes of a square that fit in a register: two with
// AVX2, which are left out independently, since this adds zeros to sums that have the same order without.
#include <algorithm>
#include <cmath>

#include "engine.h"

namespace csplat {
namespace {

constexpr int kSquare = 4;                          // width and height of a square, pixels
constexpr int kSquares = kTilePixels / kBlock;      // squares per tile
constexpr int kRows = kBlock / kParts / kSquare;    // rows of a part
constexpr int kBatch = 8;                           // splats that are expanded before they are blended
constexpr float kMargin = 0.01f;                    // margin of the bounds of exponents of 2, for rounding
constexpr uint32_t kAllParts = kParts == 1 ? 0xFFFF : 0xFFFFFFFF;
constexpr uint32_t kAllSquares = (1u << kSquares) - 1, kAllLanes = (1u << kFloats) - 1;

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
constexpr Positions kPositions;

// The pixels of a tile, square by square.
struct Tile {
  alignas(64) float transmittance[kTilePixels];  // negative for finished pixels
  alignas(64) float colour[3][kTilePixels], error[3][kTilePixels], behind[kTilePixels];
  int left, top, columns, rows;
  uint32_t unfinished;  // a bit for each part: those of the first part of each square, then those of the second
};

// The exponent of a splat about the centre of each square: constant + x_slope x + y_slope y + bend.
struct Exponents {
  alignas(64) float constant[kSquares], x_slope[kSquares], y_slope[kSquares], bend[kBlock];
  float colour[3];
  uint32_t visible;  // a bit for each part
};

struct Limits { float exponent, alpha_min, transmittance_min; };

// Calls function(pixel, place of the pixel in a tile) for each pixel of a tile on the image.
template <typename Function>
void for_each_pixel(const Tile& tile, int width, Function&& function) {
  for (int y = 0; y < tile.rows; y++)
    for (int x = 0; x < tile.columns; x++)
      function(static_cast<size_t>(tile.top + y) * width + tile.left + x,
               (y / kSquare * kSquare + x / kSquare) * kBlock + y % kSquare * kSquare + x % kSquare);
}

// Clears the bits of parts whose pixels are finished. Done between batches: within, each splat would wait for the last.
void update_unfinished(Tile& tile) {
  for (uint32_t rest = tile.unfinished; rest; rest &= rest - 1) {
    const int bit = __builtin_ctz(rest);
    const Floats t = load(tile.transmittance + bit % kSquares * kBlock + bit / kSquares * kFloats);
    if (negative_lanes(t) == kAllLanes) tile.unfinished &= ~(1u << bit);
  }
}

void begin_tile(const Image& image, int index, Tile& tile) {
  tile.left = index % image.tiles_x * kTile;
  tile.top = index / image.tiles_x * kTile;
  tile.columns = std::min(kTile, image.width - tile.left);
  tile.rows = std::min(kTile, image.height - tile.top);
  std::memset(tile.colour, 0, sizeof tile.colour);
  for (float& t : tile.transmittance) t = -1.0f;
  for_each_pixel(tile, image.width, [&](size_t, int place) { tile.transmittance[place] = 1.0f; });
  tile.unfinished = kAllParts;
  update_unfinished(tile);
}

// Returns the maximum of |k| t − K t² for 0 <= t <= size.
Floats highest(Floats slope, Floats curvature, Floats half_over_curvature, Floats size) {
  const Floats k = magnitude(slope), t = smaller(k * half_over_curvature, size);
  return t * fnma(curvature, t, k);
}

// Expands the exponent of a splat in a tile, and marks the parts in which it may be at least `least`.
void expand(const Splat& s, const Tile& tile, float least, Exponents& e) {
  const double dx = tile.left + 0.5 * kTile - s.x, dy = tile.top + 0.5 * kTile - s.y;
  const double constant = std::fma(std::fma(s.xx, dx, s.xy * dy), dx, std::fma(s.yy * dy, dy, s.log2_opacity));
  const Doubles xx = all(s.xx), xy = all(s.xy), yy = all(s.yy), x = load(kPositions.squares);
  const Doubles along = fma(x, xx, all(std::fma(2.0 * s.xx, dx, s.xy * dy)));
  const Doubles constants = fma(x, along, all(constant)), x_slopes = fma(x, xx, along);
  const Doubles y_slopes = fma(x, xy, all(std::fma(2.0 * s.yy, dy, s.xy * dx)));
  __m128 k0_rows[kSquare], kx_rows[kSquare], ky_rows[kSquare];
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

// Blends a splat; keeps alphas and weights of the parts that it changes, and returns where the next ones go.
template <bool kGradients>
float* blend_splat(const Exponents& e, const Limits& limits, Tile& tile, float* kept, uint32_t* touched) {
  const Floats red = all(e.colour[0]), green = all(e.colour[1]), blue = all(e.colour[2]);
  uint32_t changed = 0;
  for (uint32_t rest = e.visible & tile.unfinished; rest; rest &= rest - 1) {
    const int bit = __builtin_ctz(rest), square = bit % kSquares, lanes = bit / kSquares * kFloats;
    const int place = square * kBlock + lanes;
    const Floats x = load(kPositions.lane_x + lanes), y = load(kPositions.lane_y + lanes);
    const Floats rest_of_sum = fma(all(e.y_slope[square]), y, load(e.bend + lanes) + all(e.constant[square]));
    const Floats exponent = fma(all(e.x_slope[square]), x, rest_of_sum);
    if (!bits(at_least(exponent, all(limits.exponent)))) continue;
    const Floats full = exp2(exponent), before = load(tile.transmittance + place);
    const Floats alpha = keep(at_least(full, all(limits.alpha_min)), smaller(full, all(kAlphaCap)));
    const Floats weight_if_going = before * alpha;
    const Mask going = at_least(before - weight_if_going, all(limits.transmittance_min));
    const Floats weight = keep(going, weight_if_going), after = negate_outside(going, before - weight);
    store(tile.transmittance + place, after);
    store(tile.colour[0] + place, fma(weight, red, load(tile.colour[0] + place)));
    store(tile.colour[1] + place, fma(weight, green, load(tile.colour[1] + place)));
    store(tile.colour[2] + place, fma(weight, blue, load(tile.colour[2] + place)));
    if (kGradients) {
      store(kept, keep(going, alpha));
      store(kept + kFloats, weight);
      kept += 2 * kFloats;
      changed |= 1u << bit;
    }
  }
  if (kGradients) *touched = changed;
  return kept;
}

// Adds the background, writes the image, and returns the squared error; the gradient of half of it becomes `error`.
double finish_tile(const Image& image, Tile& tile) {
  const float* background = image.background;
  for (int place = 0; place < kTilePixels; place += kFloats) {
    const Floats left = magnitude(load(tile.transmittance + place));
    for (int c = 0; c < 3; c++) {
      store(tile.colour[c] + place, fma(left, all(background[c]), load(tile.colour[c] + place)));
      store(tile.error[c] + place, all(0.0f));
    }
  }
  for_each_pixel(tile, image.width, [&](size_t pixel, int place) {
    for (int c = 0; c < 3; c++) {
      const float colour = tile.colour[c][place];
      if (image.rgb) image.rgb[3 * pixel + c] = colour;
      if (image.reference) {
        const float target = std::min(std::max(image.reference[3 * pixel + c], 0.0f), 1.0f);
        tile.error[c][place] = std::min(std::max(colour, 0.0f), 1.0f) - target;
      }
    }
  });
  Floats squares[kParts] = {};
  for (int place = 0; place < kTilePixels; place += kFloats) {
    Floats behind = all(0.0f);
    for (int c = 0; c < 3; c++) {
      const Floats error = load(tile.error[c] + place);
      Floats& sum = squares[place / kFloats % kParts];
      sum = fma(error, error, sum);
      behind = fma(error, all(background[c]), behind);
    }
    store(tile.behind + place, behind);
  }
  return sum_lanes(fold(squares));
}

// Sums the gradients of a splat over the pixels of a tile, and returns the start of its alphas and weights.
const float* sum_gradients(const Splat& s, Tile& tile, const float* kept, uint32_t touched, float* sums) {
  const Floats cap = all(kAlphaCap), red = all(s.colour[0]), green = all(s.colour[1]), blue = all(s.colour[2]);
  Floats parts[kSums][kParts];
  for (int part = kParts - 1; part >= 0; part--) {
    Floats m0 = all(0.0f), mx = m0, my = m0, mxx = m0, mxy = m0, myy = m0, r = m0, g = m0, b = m0;
    for (uint32_t squares = touched >> (part * kSquares) & kAllSquares; squares;) {
      const int square = 31 - __builtin_clz(squares), place = square * kBlock + part * kFloats;
      squares ^= 1u << square;
      kept -= 2 * kFloats;
      const Floats alpha = load(kept), weight = load(kept + kFloats), behind = load(tile.behind + place);
      const Floats g0 = load(tile.error[0] + place), g1 = load(tile.error[1] + place), g2 = load(tile.error[2] + place);
      const Floats step = fma(g0, red, fma(g1, green, fma(g2, blue, all(0.0f) - behind)));
      store(tile.behind + place, fma(alpha, step, behind));
      const Floats slope = drop(at_least(alpha, cap), weight * step);
      const Floats x = load(kPositions.x + place), y = load(kPositions.y + place), sx = slope * x, sy = slope * y;
      m0 = m0 + slope;
      mx = mx + sx;
      my = my + sy;
      mxx = fma(sx, x, mxx);
      mxy = fma(sx, y, mxy);
      myy = fma(sy, y, myy);
      r = fma(weight, g0, r);
      g = fma(weight, g1, g);
      b = fma(weight, g2, b);
    }
    const Floats sums_of_part[kSums] = {m0, mx, my, mxx, mxy, myy, r, g, b};
    for (int n = 0; n < kSums; n++) parts[n][part] = sums_of_part[n];
  }
  __m256 folded[kSums];
  for (int n = 0; n < kSums; n++) folded[n] = fold(parts[n]);
  _mm256_storeu_ps(sums, sum_lanes(folded));
  sums[8] = sum_lanes(folded[8]);
  return kept;
}

template <bool kGradients>
double blend_tile(Engine& engine, const Image& image, int index, Scratch& scratch) {
  const Pair* pairs = engine.pairs.data() + engine.starts[index];
  const int count = engine.starts[index + 1] - engine.starts[index];
  if (kGradients) {
    scratch.alphas.reserve(static_cast<size_t>(count) * 2 * kTilePixels);
    scratch.touched.reserve(count);
  }
  const float least = static_cast<float>(std::log2(image.alpha_min)) - kMargin;
  const Limits limits = {least, static_cast<float>(image.alpha_min), image.transmittance_min};
  Tile tile;
  begin_tile(image, index, tile);
  float* kept = scratch.alphas.data();
  uint32_t* touched = scratch.touched.data();
  Exponents batch[kBatch];
  int used = 0;
  while (used < count && tile.unfinished) {
    const int size = std::min(kBatch, count - used);
    for (int n = 0; n < size; n++) {
      if (used + n + kBatch < count) __builtin_prefetch(&engine.splats[pairs[used + n + kBatch].splat]);
      expand(engine.splats[pairs[used + n].splat], tile, least, batch[n]);
    }
    for (int n = 0; n < size; n++) kept = blend_splat<kGradients>(batch[n], limits, tile, kept, touched + used + n);
    used += size;
    update_unfinished(tile);
  }
  const double error = finish_tile(image, tile);
  if (!kGradients) return error;
  const float* rest = kept;
  for (int n = count - 1; n >= 0; n--) {
    float* sums = engine.records[pairs[n].record].sums;
    if (n >= used || !touched[n])
      std::memset(sums, 0, kSums * sizeof(float));
    else
      rest = sum_gradients(engine.splats[pairs[n].splat], tile, rest, touched[n], sums);
  }
  return error;
}

}  // namespace

void blend(Engine& engine, const Image& image, bool with_gradients) {
  engine.threads.run(image.tile_count, [&](int64_t index, int thread) {
    const auto blend_one = with_gradients ? blend_tile<true> : blend_tile<false>;
    engine.errors[index] = blend_one(engine, image, static_cast<int>(index), engine.scratch[thread]);
  });
}

}  // namespace csplat
