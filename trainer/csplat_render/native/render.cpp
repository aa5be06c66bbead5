// SPDX-License-Identifier: Apache-2.0
// The pass that blends an image, all splats at once or slice by slice of depth; parallel over tiles.
#include "blending.h"

namespace csplat {
namespace {

constexpr int kState = 5;  // numbers of a pixel between slices: transmittance, red, green, blue, depth

void load_state(const View& view, const float* state, Tile& tile) {
  for_each_pixel(tile, view, [&](size_t pixel, int place) {
    const float* from = state + kState * pixel;
    tile.transmittance[place] = from[0];
    for (int c = 0; c < 3; c++) tile.colour[c][place] = from[1 + c];
    tile.depth[place] = from[4];
  });
}

void store_state(const View& view, const Tile& tile, float* state) {
  for_each_pixel(tile, view, [&](size_t pixel, int place) {
    float* to = state + kState * pixel;
    to[0] = tile.transmittance[place];
    for (int c = 0; c < 3; c++) to[1 + c] = tile.colour[c][place];
    to[4] = tile.depth[place];
  });
}

}  // namespace
}  // namespace csplat

using namespace csplat;

// Renders the splats that `csplat_project` has projected.
//
// state: [H, W, 5], the pixels after nearer slices, updated; or null. rgb: [H, W, 3]; transmittance and depth: [H, W].
CSPLAT_API int64_t csplat_render(int64_t threads, Renderer* renderer, const View* view, int64_t count, float* state,
                                 float* rgb, float* transmittance, float* depth) {
  return guarded([&]() -> int64_t {
    bin(threads, *renderer, *view, count);
    const Limits limits(*view);
    parallel(threads, view->tile_count(), [&](int64_t index, int) {
      Tile tile;
      Scratch none;
      begin_tile(*view, static_cast<int>(index), tile);
      if (state) load_state(*view, state, tile);
      blend_tile<false, true, true>(*renderer, limits, static_cast<int>(index), tile, none);
      if (state) store_state(*view, tile, state);
      for_each_pixel(tile, *view, [&](size_t pixel, int place) {
        const float left = std::fabs(tile.transmittance[place]);
        for (int c = 0; c < 3; c++)
          rgb[3 * pixel + c] = std::fma(left, static_cast<float>(view->background[c]), tile.colour[c][place]);
        transmittance[pixel] = left;
        depth[pixel] = tile.depth[place];
      });
    });
    return 0;
  });
}
