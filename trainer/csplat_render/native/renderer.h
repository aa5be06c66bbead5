// SPDX-License-Identifier: Apache-2.0
// The splats of a view, from the projection to the sums over pixels: data and memory that the passes share.
#pragma once

#include <algorithm>
#include <cstdint>
#include <cstring>
#include <new>
#include <vector>

#include "library.h"
#include "threads.h"
#include "vectors.h"

namespace csplat {

// As in csplat_render.conventions.
constexpr int kTile = 16;                // width and height of a tile, pixels
constexpr double kDilation = 0.3;        // square pixels, added to both variances on the image
constexpr double kLogScaleLimit = 80.0;  // log scales are clamped to ± this
constexpr float kAlphaCap = 0.99f;       // largest alpha of a splat in a pixel
constexpr double kCompensationMin = 0.000025;  // least ratio of determinants in the antialiased mode
constexpr double kLn2 = 0.6931471805599453, kLog2e = 1.4426950408889634;

// The arrays of splats, as `UncheckedSplats` of csplat_render.conventions. Mirrored by `_Splats` in rasteriser.py.
struct Splats {
  int64_t count, degree, coefficients;  // degree to render; coefficients stored in each row of `shN`
  int64_t logits;                       // 1 if `opacities` are logits
  const float *means, *quats, *scales, *opacities, *sh0, *shN;

  int64_t blocks() const { return (count + kBlock - 1) / kBlock; }
  int higher() const { return static_cast<int>((degree + 1) * (degree + 1) - 1); }
};

// A camera and the settings of an image. Mirrored by `_View` in rasteriser.py.
struct View {
  double camera[24];  // see `view_vector` of csplat_render.conventions, and the places below
  double alpha_min, transmittance_min, background[3];
  int64_t width, height, antialiased;

  int tiles_x() const { return static_cast<int>((width + kTile - 1) / kTile); }
  int tile_count() const { return tiles_x() * static_cast<int>((height + kTile - 1) / kTile); }
};
enum Place { kRotation = 0, kTranslation = 9, kFocal = 12, kPrincipal = 14, kNear = 16, kBounds = 17, kPosition = 21 };

// A group of parameters with Adam's moments, arrays of the same shape.
struct Group {
  float *values, *first, *second;
  double rate;  // learning rate, divided by 1 − β1^step
};

// A step of Adam, also for splats that the view does not show, whose gradients are 0. Mirrored by `_Step` in
// rasteriser.py.
struct Step {
  Group groups[6];  // means, quats, scales, logits, sh0, shN; means and shN may be null, they are then not fitted
  double over_root, beta2;      // 1 / √(1 − β2^step), β2
  double opacity_weight, scale_weight;  // of regularisers
  const float* mean_sizes;      // [N], factor of the step of each mean, or null
  float* means2d;               // [N], written: see `Gradients`; or null
  int64_t fitted_count;         // number of splats to fit, the first ones
};

// An array aligned to cache lines, which only grows.
template <typename T>
class Array {
 public:
  Array() = default;
  ~Array() { free(); }
  Array(Array&& other) noexcept : data_(other.data_), size_(other.size_) { other.data_ = nullptr; }
  Array(const Array&) = delete;
  Array& operator=(const Array&) = delete;

  // Makes room for `size` elements, and keeps the first `kept` of them.
  void reserve(size_t size, size_t kept = 0) {
    if (size <= size_) return;
    size = std::max(size, size_ + size_ / 4);
    if (!kept) free();
    T* data = static_cast<T*>(::operator new(size * sizeof(T), kAlignment));
    if (kept) std::memcpy(static_cast<void*>(data), data_, kept * sizeof(T));
    free();
    data_ = data;
    size_ = size;
  }
  void fill_zeros(size_t size) {
    reserve(size);
    if (size) std::memset(static_cast<void*>(data_), 0, size * sizeof(T));
  }
  T& operator[](size_t i) { return data_[i]; }
  const T& operator[](size_t i) const { return data_[i]; }
  T* data() { return data_; }
  const T* data() const { return data_; }

 private:
  static constexpr std::align_val_t kAlignment{64};
  void free() {
    if (data_) ::operator delete(data_, kAlignment);
    data_ = nullptr;
    size_ = 0;
  }

  T* data_ = nullptr;
  size_t size_ = 0;
};

// A splat on the image, a cache line. With (dx, dy) the distance from its centre,
//     log2(alpha) = xx dx² + xy dx dy + yy dy² + log2_opacity <= log2_opacity − curvature (dx² + dy²).
struct Splat {
  double x, y, xx, xy, yy;
  float log2_opacity, depth, colour[3], curvature;
};

// The ellipse within which a splat is drawn; see "Extent" in projection.cpp.
struct Extent {
  double slope, half_width, flatness, widest;
  int32_t left, right, top, bottom;  // pixels that it may touch: columns left to right − 1, rows top to bottom − 1
};

// A splat in the list of a tile, and the record of its sums over the pixels of the tile.
struct Pair { int32_t splat, record; };

// Alphas and weights that blending keeps for a pass from back to front; one for each thread.
struct Scratch {
  Array<float> kept;
  Array<uint32_t> touched;  // a bit for each square of a tile that a splat may change
};

struct Renderer {
  Array<Splat> splats;
  Array<Extent> extents;
  Array<float> depths;                  // 0 for splats that are not drawn
  Array<int32_t> tile_counts, offsets;  // number of tiles and first record of each splat
  Array<uint8_t> drawn;                 // for each block, 1 if a splat is drawn
  Array<uint32_t> keys, keys2;
  Array<int32_t> order, order2;
  Array<int32_t> chunk_counts;  // [chunks, tiles]
  Array<int32_t> starts;        // [tiles + 1], first pair of each tile
  Array<Pair> pairs;
  Array<float> records;
  Array<int32_t> record_tiles;  // tile of each record
  Array<double> errors;         // squared error of each tile
  std::vector<Scratch> scratch;
  int64_t drawn_count = 0, pair_count = 0;

  void reserve_scratch(int64_t threads) {
    if (static_cast<int64_t>(scratch.size()) < threads) scratch.resize(threads);
  }
};

// Fetches values that will be needed soon, where the processor does not see by itself which these are.
inline void prefetch(const float* values, int64_t count) {
  for (int64_t n = 0; n < count; n += kBlock) __builtin_prefetch(values + n);
}

// Calls function(block) for all blocks, 16 adjacent blocks at a time.
template <typename Function>
void for_each_block(int64_t threads, int64_t blocks, Function&& function) {
  parallel_runs(threads, blocks, 16, [&](int64_t begin, int64_t end, int) {
    for (int64_t block = begin; block < end; block++) function(block);
  });
}

// Sorts the drawn splats by depth, and into tiles.
void bin(int64_t threads, Renderer& renderer, const View& view, int64_t count);

// Places of the values of a splat in a block, in units of 16 lanes.
enum Value { kMean = 0, kQuat = 3, kScale = 7, kOpacity = 10, kValues = 11 };

// Copies the values of a block, [kValues, 16]; lanes beyond the last splat are 0.
inline void load_block(const Splats& splats, int64_t block, float* values) {
  const int64_t first = block * kBlock;
  const int lanes = static_cast<int>(std::min<int64_t>(kBlock, splats.count - first));
  if (lanes < kBlock) std::memset(values, 0, kValues * kBlock * sizeof(float));
  const float *mean = splats.means + 3 * first, *quat = splats.quats + 4 * first, *scale = splats.scales + 3 * first;
  for (int lane = 0; lane < lanes; lane++) {
    for (int n = 0; n < 3; n++) values[(kMean + n) * kBlock + lane] = mean[3 * lane + n];
    for (int n = 0; n < 4; n++) values[(kQuat + n) * kBlock + lane] = quat[4 * lane + n];
    for (int n = 0; n < 3; n++) values[(kScale + n) * kBlock + lane] = scale[3 * lane + n];
    values[kOpacity * kBlock + lane] = splats.opacities[first + lane];
  }
}

}  // namespace csplat
