// The tiles that the ellipse of a splat touches, a span for each row of tiles.
#pragma once

#include <algorithm>
#include <cmath>

#include "renderer.h"

namespace csplat {

constexpr int kSmallBox = 6;  // tiles; in boxes up to this size all tiles are used, without intersecting the ellipse

// Calls function(row, begin, end) for each row of tiles: columns of tiles begin to end − 1, at least one.
//
// Within the row's heights, the right end of the chord is farthest at the height of the ellipse's rightmost point,
// clamped to the row, and the left end at the height of its leftmost point.
template <typename Function>
inline void for_each_span(const Splat& splat, const Extent& e, Function&& function) {
  const int first = e.left / kTile, last = (e.right - 1) / kTile + 1;
  const int top = e.top / kTile, bottom = (e.bottom - 1) / kTile + 1;
  const int width = last - first, height = bottom - top;
  if (width < 2 || height < 2 || width * height <= kSmallBox) {
    for (int row = top; row < bottom; row++) function(row, first, last);
    return;
  }
  for (int row = top; row < bottom; row++) {
    const double low = std::max(row * kTile, e.top) + 0.5 - splat.y;
    const double high = std::min(row * kTile + kTile, e.bottom) - 0.5 - splat.y;
    const auto end_of_chord = [&](double height_of_point, double sign) {
      const double dy = std::min(std::max(height_of_point, low), high);
      const double t = 1.0 - (dy * e.flatness) * (dy * e.flatness);
      return dy * e.slope + sign * e.half_width * std::sqrt(std::max(t, 0.0));
    };
    const double right = end_of_chord(e.widest, 1.0), left = end_of_chord(-e.widest, -1.0);
    if (!(left <= right)) {
      function(row, first, last);  // NaN by overflow: use the box
      continue;
    }
    // Pixel centres are at least half a pixel inside a tile, which leaves a margin for rounding.
    const double x0 = (splat.x + left) / kTile, x1 = (splat.x + right) / kTile;
    const int begin = x0 < first ? first : x0 > last ? last : static_cast<int>(x0);
    const int end = x1 > last - 1 ? last : (x1 < first ? first : static_cast<int>(x1)) + 1;
    if (begin < end) function(row, begin, end);
  }
}

}  // namespace csplat
