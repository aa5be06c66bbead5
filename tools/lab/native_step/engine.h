// The splats of a refit, their optimiser's state, and the memory that the passes of a step share.
#pragma once

#include <algorithm>
#include <cstdint>
#include <cstdlib>
#include <cstring>
#include <new>

#include "threads.h"
#include "vectors.h"

namespace csplat {

constexpr int kTile = 16;               // width and height of a tile, pixels
constexpr int kTilePixels = kTile * kTile;
constexpr double kDilation = 0.3;       // square pixels, added to both variances on the image
constexpr double kLogScaleLimit = 80.0; // log scales are clamped to ± this
constexpr float kAlphaCap = 0.99f;      // largest alpha of a splat in a pixel
constexpr double kMaxGradient = 1e37;   // gradients are clamped to ± this

// Places of the values of a splat in its block, in units of 16 lanes. Means are not fitted.
enum Value { kMean = 0, kQuat = 3, kScale = 7, kLogit = 10, kSh0 = 11, kShN = 14 };

constexpr int kHighestDegree = 3;
constexpr int kMostValues = kSh0 + 3 * (kHighestDegree + 1) * (kHighestDegree + 1);

// Places in the vector of a camera, see `view_vector` in csplat_render.conventions.
enum View { kRotation = 0, kTranslation = 9, kFocal = 12, kPrincipal = 14, kNear = 16, kBounds = 17, kPosition = 21 };

// An array aligned to cache lines, which only grows.
template <typename T>
class Array {
 public:
  Array() = default;
  ~Array() { std::free(data_); }
  Array(const Array&) = delete;
  Array& operator=(const Array&) = delete;

  // Makes room for `size` elements; contents are lost if there was not enough.
  void reserve(size_t size) {
    if (size <= size_) return;
    size = size_ ? size + size / 4 : size;
    std::free(data_);
    data_ = static_cast<T*>(std::aligned_alloc(64, (size * sizeof(T) + 63) / 64 * 64));
    if (!data_) throw std::bad_alloc();
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
  T* data_ = nullptr;
  size_t size_ = 0;
};

// A splat on the image, a cache line. With (dx, dy) the distance from its centre,
//     log2(alpha) = xx dx² + xy dx dy + yy dy² + log2_opacity <= log2_opacity − curvature (dx² + dy²).
struct Splat {
  double x, y, xx, xy, yy, log2_opacity;
  float colour[3], curvature;
};

// The ellipse within which a splat is drawn; see "Extent" in projection.cpp.
struct Extent {
  double slope, half_width, flatness, widest;
  int32_t left, right, top, bottom;  // pixels that it may touch: columns left to right − 1, rows top to bottom − 1
};

// A splat in the list of a tile, and the record of its gradients.
struct Pair { int32_t splat, record; };

// Sums over the pixels of a tile, for a splat: moments of slope about the centre of the tile (1, x, y, xx, xy, yy), and
// gradients with respect to red, green and blue.
constexpr int kSums = 9;
struct Record { float sums[kSums]; };

// Alphas and weights that blending keeps for its gradient; one for each thread.
struct Scratch {
  Array<float> alphas;
  Array<uint32_t> touched;  // a bit for each part that a splat changes
};

struct Image {
  int width, height, tiles_x, tile_count;
  const double* view;
  const float* background;
  const float* reference;  // [H, W, 3], or null: blend only
  float* rgb;              // [H, W, 3], written if not null
  double alpha_min;
  float transmittance_min;
};

// Parts of a step whose time is measured; blending includes its gradient, and the gradient of the projection Adam.
enum Phase { kProjection, kBinning, kBlending, kProjectionBackward, kPhases };

struct Engine {
  int count = 0, block_count = 0, degree = 0, higher = 0, value_count = 0;
  int64_t steps = 0;
  Array<float> values, first, second;  // [blocks, values, 16]; Adam's moments for values from kQuat on
  Array<float> gradients;              // as `values`, written if asked for
  Array<int32_t> sources;              // index of each splat in the caller's order

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
  Array<Record> records;
  Array<int32_t> record_tiles;  // tile of each record
  Array<double> errors;         // squared error of each tile
  int64_t drawn_count = 0, pair_count = 0;
  double seconds[kPhases] = {};  // wall time since they were read

  Threads threads;
  Scratch* scratch;

  explicit Engine(int thread_count) : threads(thread_count), scratch(new Scratch[thread_count]) {}
  ~Engine() { delete[] scratch; }
};

// Calls function(block) for all blocks, on all threads, for 16 adjacent blocks at a time.
template <typename Function>
void for_each_block(Engine& engine, Function&& function) {
  engine.threads.run((engine.block_count + 15) / 16, [&](int64_t run, int) {
    const int begin = static_cast<int>(run) * 16, end = std::min(begin + 16, engine.block_count);
    for (int block = begin; block < end; block++) function(block);
  });
}

void project(Engine& engine, const Image& image);
void bin(Engine& engine, const Image& image);
void blend(Engine& engine, const Image& image, bool with_gradients);
void project_backward(Engine& engine, const Image& image, const float* rates, bool keep_gradients);

}  // namespace csplat
