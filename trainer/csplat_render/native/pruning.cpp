// SPDX-License-Identifier: Apache-2.0
// The squared change of a render without each splat; parallel over tiles.
//
// At a pixel, a splat of alpha a with transmittance T in front of it has the weight w = T·a. Let C be its colour and B
// the colour blended from everything behind it, background included, as seen directly behind the splat. Without the
// splat the pixel changes by
//
//     d = w·(B − C),
//
// because only the light from behind changes. So the splats of a tile are passed once more, back to front:
//
//     B ← B + a·(C − B)
//
// Nothing is subtracted from a finished sum, so splats deep in the scene are as accurate as those in front.
#include "blending.h"

namespace csplat {
namespace {

constexpr int kSums = 2;            // sums over the pixels of a tile: |d|², w
constexpr float kMaxColour = 1e15f; // so that squares of differences, summed over a tile, stay within float

void measure_tile(Renderer& renderer, const View& view, int index, float* rgb, Scratch& scratch) {
  Tile tile;
  begin_tile(view, index, tile);
  const Blended blended = blend_tile<true, true, false>(renderer, Limits(view), index, tile, scratch);
  float background[3];
  for (int c = 0; c < 3; c++) background[c] = static_cast<float>(view.background[c]);
  for_each_pixel(tile, view, [&](size_t pixel, int place) {
    const float left = std::fabs(tile.transmittance[place]);
    for (int c = 0; c < 3; c++) rgb[3 * pixel + c] = std::fma(left, background[c], tile.colour[c][place]);
  });
  for (int c = 0; c < 3; c++) std::fill(tile.colour[c], tile.colour[c] + kTilePixels, background[c]);
  for_each_behind(renderer, blended, scratch, [&](const Splat& s, int64_t record, uint32_t squares, const float* kept) {
    Floats colour[3];
    for (int c = 0; c < 3; c++) colour[c] = all(std::min(s.colour[c], kMaxColour));
    return sum_squares<kSums>(squares, kept, renderer.records.data() + kSums * record,
                            [&](int place, Floats alpha, Floats weight, Floats* sums) {
      Floats squares = all(0.0f);
      for (int c = 0; c < 3; c++) {
        const Floats behind = load(tile.colour[c] + place), change = colour[c] - behind;
        squares = fma(change, change, squares);
        store(tile.colour[c] + place, fma(alpha, change, behind));
      }
      sums[0] = fma(weight * weight, squares, sums[0]);
      sums[1] = sums[1] + weight;
    });
  });
}

}  // namespace
}  // namespace csplat

using namespace csplat;

// Measures the splats that `csplat_project` has projected.
//
// rgb: [H, W, 3], the render. errors: [N], incremented by the squared changes. seen: [N], set for visible splats.
CSPLAT_API int64_t csplat_measure_pruning(int64_t threads, Renderer* renderer, const View* view, int64_t count,
                                          float* rgb, double* errors, uint8_t* seen) {
  return guarded([&]() -> int64_t {
    bin(threads, *renderer, *view, count);
    renderer->reserve_scratch(threads);
    renderer->records.reserve(kSums * renderer->pair_count);
    parallel(threads, view->tile_count(), [&](int64_t index, int thread) {
      measure_tile(*renderer, *view, static_cast<int>(index), rgb, renderer->scratch[thread]);
    });
    parallel_runs(threads, count, 16 * kBlock, [&](int64_t begin, int64_t end, int) {
      for (int64_t i = begin; i < end; i++) {
        if (!renderer->tile_counts[i]) continue;
        double error = 0.0, weight = 0.0;
        const float* record = renderer->records.data() + static_cast<int64_t>(kSums) * renderer->offsets[i];
        for (int32_t n = 0; n < renderer->tile_counts[i]; n++, record += kSums) {
          error += record[0];
          weight += record[1];
        }
        if (weight > 0.0) {
          errors[i] += error;
          seen[i] = 1;
        }
      }
    });
    return 0;
  });
}
