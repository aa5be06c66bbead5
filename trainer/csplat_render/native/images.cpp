// SPDX-License-Identifier: Apache-2.0
// SSIM, the photometric loss with its gradient, and the convolution of LPIPS.
//
// With E the mean over the window, a Gaussian of 11×11 pixels, σ 1.5, with zeros beyond the border, SSIM of a value is
//
//   m1 = E[x], m2 = E[y], n = m1² + m2²
//   a = 2 m1 m2 + C1,  b = 2 (E[x y] − m1 m2) + C2,  c = n + C1,  d = E[x² + y²] − n + C2,  ssim = a b / (c d)
//
// and the gradient of its sum by x is E[∂/∂m1] + x E[2 ∂/∂E[x²]] + y E[∂/∂E[x y]], since the window is symmetric, with
//
//   ∂/∂E[x²] = −ssim / d,  ∂/∂E[x y] = 2 a / (c d)
//   ∂/∂m1 = 2 (m2 b / (c d) − m1 ssim / c − m1 ∂/∂E[x²]) − m2 ∂/∂E[x y]
//
// The window is separable. A thread goes down a band of rows: it blurs across 11 rows of the images, then along the
// result, and keeps the derivatives of 11 rows, blurred along. The size of bands depends on the number of threads, the
// values of a row do not. Loops are vectorised over the values of a row, three per pixel. Images of doubles have no
// gradient.
#include <algorithm>
#include <cmath>
#include <type_traits>
#include <vector>

#include "library.h"
#include "threads.h"
#include "vectors.h"

namespace csplat {
namespace {

constexpr int kRadius = 5, kWindow = 2 * kRadius + 1;  // rows and pixels
constexpr int kPixel = 3;                              // values of a pixel
constexpr int kMinBand = 32;                           // rows; a band computes the derivatives of 10 rows more

template <typename T>
using Vector = decltype(load(static_cast<const T*>(nullptr)));
template <typename T>
constexpr int kLanes = sizeof(Vector<T>) / sizeof(T);

// A sum along a row: of 16 lanes first, then in double.
template <typename T>
struct RowSum {
  Vector<T> parts[kBlock / kLanes<T>] = {};

  double total() const {
    T lanes[kBlock];
    double sum = 0.0;
    for (int p = 0; p < kBlock / kLanes<T>; p++) store(lanes + p * kLanes<T>, parts[p]);
    for (const T lane : lanes) sum += lane;
    return sum;
  }
};

// Calls body(i, part) for the vectors of a row.
template <typename T, typename Body>
inline void for_vectors(int64_t width, Body&& body) {
  for (int64_t i = 0; i < width; i += kBlock)
    for (int part = 0; part < kBlock / kLanes<T>; part++) body(i + part * kLanes<T>, part);
}

// The weights of the window, from its middle outwards.
template <typename T>
struct Window {
  Vector<T> taps[kRadius + 1];

  Window() {
    double total = 0.0, weights[kRadius + 1];
    for (int k = kRadius; k >= 0; k--) total += (k ? 2.0 : 1.0) * (weights[k] = exp(k * k / -4.5));
    for (int k = 0; k <= kRadius; k++) taps[k] = all(static_cast<T>(weights[k] / total));
  }

  // Returns the sum of weights times at(−5) to at(5).
  template <typename At>
  Vector<T> mean(At&& at) const {
    Vector<T> sum = taps[0] * at(0);
    for (int k = 1; k <= kRadius; k++) sum = fma(taps[k], at(-k) + at(k), sum);
    return sum;
  }

  // Returns the blurred values of a row at p, and of a ring of rows at i.
  Vector<T> along(const T* p) const { return mean([p](int k) { return load(p + kPixel * k); }); }
  Vector<T> across(const T* const* rows, int64_t i) const {
    return mean([=](int k) { return load(rows[kRadius + k] + i); });
  }
};

// Two images with `width` values per row, and what is computed of them.
template <typename T>
struct Comparison {
  const T *x, *y;
  int64_t height, width;
  T l1_step, ssim_step;
  T* gradient;
  double* sums;  // of |x − y|, SSIM and (x − y)², [3] per row
};

// The rows that a thread works on: aligned, filled up with zeros to full blocks, with a margin of zeros on either side.
template <typename T>
class Band {
 public:
  explicit Band(const Comparison<T>& job) : job_(job) {
    const int64_t stride = (job.width + kBlock - 1) / kBlock * kBlock + 2 * kBlock;
    values_.assign(kRows * stride + kBlock, T(0));
    const auto place = reinterpret_cast<uintptr_t>(values_.data());
    T* next = values_.data() + (-place % (kBlock * sizeof(T))) / sizeof(T) + kBlock;
    for (T*& row : rows_) row = next, next += stride;
    std::fill_n(rows_[kInside], job.width, T(1));
  }

  // Computes the rows `begin` to `end`.
  void compute(int64_t begin, int64_t end) {
    const Window<T> window;
    const int64_t width = job_.width, radius = job_.ssim_step != T(0) ? kRadius : 0;
    const int64_t margin = kHasGradient ? radius : 0;  // rows whose derivatives are needed
    for (int64_t s = begin - radius - margin; s < end + radius + margin; s++) {  // a row that is read
      read(job_.x, s, rows_ + kX);
      read(job_.y, s, rows_ + kY);
      const int64_t r = s - radius;  // a row that is compared
      if (r < begin - margin) continue;
      if (radius) {
        const bool is_inside = r >= 0 && r < job_.height;
        const double ssim = is_inside ? compare(window) : 0.0;
        if (r >= begin && r < end) job_.sums[3 * r + 1] = ssim;
        for (int ring = kAlong; kHasGradient && ring < kRows; ring += kWindow) {
          T *const to = turn(rows_ + ring), *const from = rows_[kDerivatives + (ring - kAlong) / kWindow];
          if (is_inside)
            for_vectors<T>(width, [&](int64_t i, int) { store(to + i, window.along(from + i)); });
          else
            std::fill_n(to, width, T(0));
        }
      }
      if constexpr (kHasGradient)
        if (r - margin >= begin) finish(window, r - margin);
    }
  }

 private:
  static constexpr bool kHasGradient = std::is_same_v<T, float>;

  // Rows: 1 inside the image; E[x], E[y], E[x² + y²], E[x y] across rows; derivatives by E[x], E[x²] (twice) and
  // E[x y]; the gradient. Rings of the last 11 rows: x, y, and the derivatives blurred along.
  enum Row {
    kInside, kMoments, kDerivatives = kMoments + 4, kGradient = kDerivatives + 3, kX, kY = kX + kWindow,
    kAlong = kY + kWindow, kRows = kAlong + 3 * kWindow,
  };

  // Makes place for a row at the end of a ring, and returns it.
  static T* turn(T** ring) {
    std::rotate(ring, ring + 1, ring + kWindow);
    return ring[kWindow - 1];
  }

  void read(const T* image, int64_t r, T** ring) {
    if (r >= 0 && r < job_.height)
      std::copy_n(image + r * job_.width, job_.width, turn(ring));
    else
      std::fill_n(turn(ring), job_.width, T(0));
  }

  // Returns the sum of SSIM of the rings' middle row, and computes the derivatives.
  double compare(const Window<T>& window) const {
    using V = Vector<T>;
    const V* const taps = window.taps;
    const T *const *x = rows_ + kX + kRadius, *const *y = rows_ + kY + kRadius, *inside = rows_[kInside];
    T *moments[4], *derivatives[3];
    std::copy_n(rows_ + kMoments, 4, moments);
    std::copy_n(rows_ + kDerivatives, 3, derivatives);
    for_vectors<T>(job_.width, [&](int64_t i, int) {
      const V u = load(x[0] + i), v = load(y[0] + i);
      V mean_x = taps[0] * u, mean_y = taps[0] * v, square = taps[0] * fma(u, u, v * v), product = mean_x * v;
      for (int k = 1; k <= kRadius; k++) {
        const V u0 = load(x[-k] + i), v0 = load(y[-k] + i), u1 = load(x[k] + i), v1 = load(y[k] + i);
        mean_x = fma(taps[k], u0 + u1, mean_x);
        mean_y = fma(taps[k], v0 + v1, mean_y);
        square = fma(taps[k], fma(u0, u0, fma(v0, v0, fma(u1, u1, v1 * v1))), square);
        product = fma(taps[k], fma(u0, v0, u1 * v1), product);
      }
      store(moments[0] + i, mean_x), store(moments[1] + i, mean_y);
      store(moments[2] + i, square), store(moments[3] + i, product);
    });
    RowSum<T> sum;
    const V c1 = all(T(0.01 * 0.01)), c2 = all(T(0.03 * 0.03)), two = all(T(2));
    for_vectors<T>(job_.width, [&](int64_t i, int part) {
      const V m1 = window.along(moments[0] + i), m2 = window.along(moments[1] + i);
      const V mm = m1 * m2, n = fma(m1, m1, m2 * m2);
      const V a = fma(two, mm, c1), b = fma(two, window.along(moments[3] + i) - mm, c2);
      const V c = n + c1, d = window.along(moments[2] + i) - n + c2;
      const V over = load(inside + i) / (c * d), ssim = a * b * over;  // 0 beyond the end of the row
      sum.parts[part] = sum.parts[part] + ssim;
      if (!kHasGradient) return;
      const V by_square = -ssim * (c * over), by_product = two * a * over;
      store(derivatives[0] + i, two * (m2 * b * over - m1 * fma(ssim, d * over, by_square)) - m2 * by_product);
      store(derivatives[1] + i, two * by_square);
      store(derivatives[2] + i, by_product);
    });
    return sum.total();
  }

  // Writes row q of the gradient, and its sums.
  void finish(const Window<float>& window, int64_t q) const {
    const bool has_ssim = job_.ssim_step != 0.0f;
    const int place = has_ssim ? 0 : kWindow - 1;  // of row q in the rings
    const float *x = rows_[kX + place], *y = rows_[kY + place];
    const Floats l1_step = all(job_.l1_step), ssim_step = all(job_.ssim_step);
    float* const out = rows_[kGradient];
    RowSum<float> l1, square;
    for_vectors<float>(job_.width, [&](int64_t i, int part) {
      const Floats u = load(x + i), v = load(y + i), difference = u - v;
      Floats step = sign_of(difference, l1_step);
      if (has_ssim) {
        const Floats by_x = window.across(rows_ + kAlong, i), by_square = window.across(rows_ + kAlong + kWindow, i);
        const Floats by_product = window.across(rows_ + kAlong + 2 * kWindow, i);
        step = fma(ssim_step, fma(v, by_product, fma(u, by_square, by_x)), step);
      }
      l1.parts[part] = l1.parts[part] + magnitude(difference);
      square.parts[part] = fma(difference, difference, square.parts[part]);
      store(out + i, step);
    });
    job_.sums[3 * q] = l1.total();
    job_.sums[3 * q + 2] = square.total();
    std::copy_n(out, job_.width, job_.gradient + q * job_.width);
  }

  const Comparison<T> job_;
  std::vector<T> values_;
  T* rows_[kRows];
};

// Computes bands of rows, and adds up the sums, [3].
template <typename T>
int64_t compare_images(int64_t threads, Comparison<T> job, double* sums) {
  return guarded([&]() -> int64_t {
    const int64_t runs = threads > 1 ? 2 * threads : 1;
    const int64_t size = std::max<int64_t>((job.height + runs - 1) / runs, kMinBand);
    std::vector<double> row_sums(3 * job.height);
    job.sums = row_sums.data();
    parallel_runs(threads, job.height, size,
                  [&](int64_t begin, int64_t end, int) { Band<T>(job).compute(begin, end); });
    std::fill_n(sums, 3, 0.0);
    for (size_t k = 0; k < row_sums.size(); k++) sums[k % 3] += row_sums[k];
    return 0;
  });
}

// The convolution: pixels of a row × outputs that are summed in registers, and outputs of a panel of weights.
constexpr int kTile = kFloats == 16 ? 12 : 6, kAcross = 2 * kFloats, kPanel = 32;

struct Convolution {
  int64_t values, across;          // of the image: values per row, and per pixel of the result
  int64_t height, taps, outputs;   // of the kernel: rows, adjacent values per row, and outputs
};

// Computes `pixels` <= kPixels × kAcross results: sums of products in the order of the kernel's rows and values.
template <int kPixels>
void convolve_tile(const Convolution& job, int64_t pixels, const float* x, const float* weights, const float* bias,
                   float* out) {
  if constexpr (kPixels > 1)
    if (pixels < kPixels) return convolve_tile<kPixels - 1>(job, pixels, x, weights, bias, out);
  Floats sums[kPixels][2];
  for (int p = 0; p < kPixels; p++) sums[p][0] = load(bias), sums[p][1] = load(bias + kFloats);
  for (int64_t i = 0; i < job.height; i++, x += job.values)
    for (int64_t k = 0; k < job.taps; k++, weights += kPanel) {
      const Floats w0 = load(weights), w1 = load(weights + kFloats);
      for (int p = 0; p < kPixels; p++) {
        const Floats value = all(x[p * job.across + k]);
        sums[p][0] = fma(value, w0, sums[p][0]);
        sums[p][1] = fma(value, w1, sums[p][1]);
      }
    }
  for (int p = 0; p < kPixels; p++, out += job.outputs) store(out, sums[p][0]), store(out + kFloats, sums[p][1]);
}

}  // namespace

// Computes L1 and SSIM of two images, and their gradient.
//
// x, y, gradient: [height, width] float32; sums: [3], of |x − y|, SSIM (left out if ssim_step is 0) and (x − y)². The
// gradient is l1_step · sign(x − y) + ssim_step · ∂(sum of SSIM)/∂x.
CSPLAT_API int64_t csplat_photometric_loss(int64_t threads, const float* x, const float* y, int64_t height,
                                           int64_t width, double l1_step, double ssim_step, float* gradient,
                                           double* sums) {
  const float steps[2] = {static_cast<float>(l1_step), static_cast<float>(ssim_step)};
  return compare_images<float>(threads, {x, y, height, width, steps[0], steps[1], gradient, nullptr}, sums);
}

// Sums SSIM of two images, [height, width] float64, into the second of `sums`, [3].
CSPLAT_API int64_t csplat_ssim(int64_t threads, const double* x, const double* y, int64_t height, int64_t width,
                               double* sums) {
  return compare_images<double>(threads, {x, y, height, width, 0.0, 1.0, nullptr, nullptr}, sums);
}

// Convolves an image: result[r, c, o] = bias[o] + Σ_ik weights[i, k, o] · x[r down + i, c across + k].
//
// x: [rows of the image, values]; weights: [outputs / 32, height, taps, 32]; bias: [outputs]; result: [rows, columns,
// outputs]; all float32. The number of outputs is a multiple of 32.
CSPLAT_API int64_t csplat_convolve(int64_t threads, const float* x, int64_t values, const float* weights,
                                   const float* bias, int64_t height, int64_t taps, int64_t outputs, int64_t down,
                                   int64_t across, int64_t rows, int64_t columns, float* result) {
  const Convolution job{values, across, height, taps, outputs};
  const int64_t tiles = (columns + kTile - 1) / kTile;
  parallel(threads, outputs / kAcross * rows, [&](int64_t item, int) {
    const int64_t first = item / rows * kAcross, r = item % rows;
    const float* own = weights + first / kPanel * kPanel * height * taps + first % kPanel;
    for (int64_t tile = 0; tile < tiles; tile++) {
      const int64_t begin = tile * columns / tiles, pixels = (tile + 1) * columns / tiles - begin;
      convolve_tile<kTile>(job, pixels, x + r * down * values + begin * across, own, bias + first,
                           result + (r * columns + begin) * outputs + first);
    }
  });
  return 0;
}

}  // namespace csplat
