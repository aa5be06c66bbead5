// Linear interpolation between the pixels of an image.
//
// With (x, y) as the position among pixel centres, limited to the image, and (s, t) its distance from the pixel (i, j) at
// the upper left:
//   value = (1 − t) (1 − s) p(i, j) + (1 − t) s p(i + 1, j) + t (1 − s) p(i, j + 1) + t s p(i + 1, j + 1)
// Colours of an image with alpha are weighted by it, and divided by the alpha of the result.
#include <algorithm>
#include <cmath>

#include "library.h"
#include "threads.h"

namespace csplat {
namespace {

// Two neighbouring pixels of a row or column, and their weights.
struct Pair {
  int64_t at[2];
  double weights[2];
  Pair(double edge, int64_t side) {
    const double centre = std::min(std::max(0.0, edge - 0.5), static_cast<double>(side - 1));
    at[0] = static_cast<int64_t>(centre);
    at[1] = std::min(at[0] + 1, side - 1);
    weights[1] = centre - static_cast<double>(at[0]);
    weights[0] = 1.0 - weights[1];
  }
};

}  // namespace
}  // namespace csplat

using namespace csplat;

// Interpolates bytes, rounded to the nearest, ties to even.
//
// pixels: [height, width, channels], at most 4, of which the fourth is alpha; x, y: [count], where the left and upper
// edges of the image are 0; least_alpha: divisor of colours where alpha is lower; result: [count, channels].
CSPLAT_API int64_t csplat_interpolate(int64_t threads, const uint8_t* pixels, int64_t height, int64_t width,
                                      int64_t channels, const double* x, const double* y, int64_t count,
                                      double least_alpha, uint8_t* result) {
  return guarded([&]() -> int64_t {
    parallel_runs(threads, count, 1 << 12, [&](int64_t begin, int64_t end, int) {
      for (int64_t n = begin; n < end; n++) {
        const Pair columns(x[n], width), rows(y[n], height);
        double values[4] = {};
        for (int corner = 0; corner < 4; corner++) {
          const int row = corner >> 1, column = corner & 1;
          const uint8_t* pixel = pixels + (rows.at[row] * width + columns.at[column]) * channels;
          for (int64_t c = 0; c < channels; c++) {
            const double value = channels == 4 && c < 3 ? static_cast<double>(pixel[c]) * pixel[3] : pixel[c];
            values[c] += value * rows.weights[row] * columns.weights[column];
          }
        }
        for (int64_t c = 0; c < channels; c++) {
          const double value = channels == 4 && c < 3 ? values[c] / std::max(values[3], least_alpha) : values[c];
          result[n * channels + c] = static_cast<uint8_t>(std::min(std::nearbyint(value), 255.0));
        }
      }
    });
    return 0;
  });
}
