// SPDX-License-Identifier: Apache-2.0
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
  static constexpr double kNumbers[kDoubles] = {0.0, 1.0, 2.0, 3.0};
  const Doubles zero = all(0.0), half = all(0.5), one = all(1.0), y = all(splat.y), over_tile = all(1.0 / kTile);
  const Doubles leftmost = all(static_cast<double>(first)), rightmost = all(last - 1.0);
  for (int row = top; row < bottom; row += kDoubles) {
    const Doubles row_top = all(static_cast<double>(kTile)) * (all(static_cast<double>(row)) + load(kNumbers));
    const Doubles row_bottom = row_top + all(static_cast<double>(kTile));
    const Doubles low = larger(row_top, all(static_cast<double>(e.top))) + half - y;
    const Doubles high = smaller(row_bottom, all(static_cast<double>(e.bottom))) - half - y;
    const auto end_of_chord = [&](double height_of_point, double half_width) {  // NaN stays
      const Doubles dy = smaller(high, larger(low, all(height_of_point))), across = dy * all(e.flatness);
      return dy * all(e.slope) + all(half_width) * square_root(larger(zero, one - across * across));
    };
    const Doubles right = end_of_chord(e.widest, e.half_width), left = end_of_chord(-e.widest, -e.half_width);
    const DoubleMask valid = at_least(right, left);  // false for NaN by overflow: use the box
    // Pixel centres are at least half a pixel inside a tile, which leaves a margin for rounding.
    const Doubles x0 = larger((all(splat.x) + left) * over_tile, leftmost), x1 = (all(splat.x) + right) * over_tile;
    double begins[kDoubles], ends[kDoubles];
    store(begins, select(valid, smaller(x0, rightmost + one), leftmost));
    store(ends, select(valid, smaller(larger(x1, leftmost), rightmost), rightmost));
    for (int n = 0; n < kDoubles && row + n < bottom; n++) {
      const int begin = static_cast<int>(begins[n]), end = static_cast<int>(ends[n]) + 1;
      if (begin < end) function(row + n, begin, end);
    }
  }
}

}  // namespace csplat
