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
// values of a row do not. Loops are vectorised over the values of a row, three per pixel.
#include <algorithm>
#include <cmath>
#include <utility>
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

// A sum along a row, in double: of 16 lanes first.
template <typename T>
struct RowSum {
  Vector<T> parts[kBlock / kLanes<T>];

  RowSum() { std::fill(std::begin(parts), std::end(parts), all(T(0))); }

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

  // Returns the blurred values of a row at p.
  Vector<T> along(const T* p) const {
    Vector<T> sum = taps[0] * load(p);
    for (int k = 1; k <= kRadius; k++) sum = fma(taps[k], load(p - kPixel * k) + load(p + kPixel * k), sum);
    return sum;
  }

  // Returns the blurred values of 11 rows at i.
  Vector<T> across(const T* const* rows, int64_t i) const {
    Vector<T> sum = taps[0] * load(rows[kRadius] + i);
    for (int k = 1; k <= kRadius; k++)
      sum = fma(taps[k], load(rows[kRadius - k] + i) + load(rows[kRadius + k] + i), sum);
    return sum;
  }
};

// Two images with `width` values per row.
template <typename T>
struct Images {
  const T *x, *y;
  int64_t height, width;
};

// The rows that a thread works on: aligned, filled up with zeros to full blocks, with a margin of zeros on either side.
template <typename T>
class Workspace {
 public:
  // Numbers of rows: 1 inside the image; E[x], E[y], E[x² + y²], E[x y] across rows; derivatives by E[x], E[x²] (twice)
  // and E[x y]; the gradient. Rings of 11 rows: x, y, and the derivatives blurred along.
  enum Row {
    kInside, kMoments, kDerivatives = kMoments + 4, kGradient = kDerivatives + 3, kX, kY = kX + kWindow,
    kAlong = kY + kWindow, kMetricRows = kAlong, kRows = kAlong + 3 * kWindow,
  };

  void allocate(int64_t width, int rows) {
    stride_ = (width + kBlock - 1) / kBlock * kBlock + 2 * kBlock;
    values_.assign(rows * stride_ + kBlock, T(0));
    const auto place = reinterpret_cast<uintptr_t>(values_.data());
    first_ = values_.data() + (-place % (kBlock * sizeof(T))) / sizeof(T) + kBlock;
    std::fill_n(row(kInside), width, T(1));
  }

  T* row(int number) const { return first_ + number * stride_; }

  // Returns row r of a ring of 11 rows.
  T* row(int ring, int64_t r) const { return row(ring + static_cast<int>((r + kWindow) % kWindow)); }

  // Copies row r of the images to the rings, or zeros.
  void read(const Images<T>& images, int64_t r) const {
    for (const auto& [ring, image] : {std::pair(kX, images.x), std::pair(kY, images.y)})
      if (r >= 0 && r < images.height)
        std::copy_n(image + r * images.width, images.width, row(ring, r));
      else
        std::fill_n(row(ring, r), images.width, T(0));
  }

 private:
  std::vector<T> values_;
  T* first_ = nullptr;
  int64_t stride_ = 0;
};

// Returns the sum of SSIM of row r, from rows of the rings; computes the derivatives, too, if `kGradient`.
template <bool kGradient, typename T>
double compare_row(int64_t r, int64_t width, const Window<T>& window, const Workspace<T>& space) {
  using V = Vector<T>;
  using S = Workspace<T>;
  const T *x[kWindow], *y[kWindow];
  for (int k = 0; k < kWindow; k++) x[k] = space.row(S::kX, r + k - kRadius), y[k] = space.row(S::kY, r + k - kRadius);
  T *moments[4], *derivatives[3];
  for (int k = 0; k < 4; k++) moments[k] = space.row(S::kMoments + k);
  for (int k = 0; k < 3; k++) derivatives[k] = space.row(S::kDerivatives + k);
  const T* const inside = space.row(S::kInside);
  const V* const taps = window.taps;
  for_vectors<T>(width, [&](int64_t i, int) {
    const V u = load(x[kRadius] + i), v = load(y[kRadius] + i);
    V mean_x = taps[0] * u, mean_y = taps[0] * v, square = taps[0] * fma(u, u, v * v), product = mean_x * v;
    for (int k = 1; k <= kRadius; k++) {
      const V u0 = load(x[kRadius - k] + i), v0 = load(y[kRadius - k] + i);
      const V u1 = load(x[kRadius + k] + i), v1 = load(y[kRadius + k] + i);
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
  for_vectors<T>(width, [&](int64_t i, int part) {
    const V m1 = window.along(moments[0] + i), m2 = window.along(moments[1] + i), mm = m1 * m2;
    const V n = fma(m1, m1, m2 * m2), square = window.along(moments[2] + i), product = window.along(moments[3] + i);
    const V a = fma(two, mm, c1), b = fma(two, product - mm, c2), c = n + c1, d = square - n + c2;
    const V over = load(inside + i) / (c * d), ssim = a * b * over;  // 0 beyond the end of the row
    sum.parts[part] = sum.parts[part] + ssim;
    if (!kGradient) return;
    const V by_square = -ssim * (c * over), by_product = two * a * over;
    store(derivatives[0] + i, two * (m2 * b * over - m1 * fma(ssim, d * over, by_square)) - m2 * by_product);
    store(derivatives[1] + i, two * by_square);
    store(derivatives[2] + i, by_product);
  });
  return sum.total();
}

// Writes the rows `begin` to `end` of the gradient, and their sums of |x − y|, SSIM and (x − y)², [3] per row.
void gradient_of_band(const Images<float>& images, int64_t begin, int64_t end, float l1_step, float ssim_step,
                      const Workspace<float>& space, float* gradient, double* sums) {
  using S = Workspace<float>;
  const Window<float> window;
  const int64_t width = images.width, radius = ssim_step != 0.0f ? kRadius : 0;
  for (int64_t s = begin - 2 * radius; s < end + 2 * radius; s++) {  // a row that is read
    space.read(images, s);
    const int64_t r = s - radius, q = r - radius;  // a row that is compared, a row that is finished
    if (r < begin - radius) continue;
    if (radius) {
      const bool is_inside = r >= 0 && r < images.height;
      const double ssim = is_inside ? compare_row<true>(r, width, window, space) : 0.0;
      if (r >= begin && r < end) sums[3 * r + 1] = ssim;
      for (int field = 0; field < 3; field++) {
        float* const along = space.row(S::kAlong + field * kWindow, r);
        const float* const in = space.row(S::kDerivatives + field);
        if (is_inside)
          for_vectors<float>(width, [&](int64_t i, int) { store(along + i, window.along(in + i)); });
        else
          std::fill_n(along, width, 0.0f);
      }
    }
    if (q < begin) continue;
    const float* rows[3][kWindow];
    for (int field = 0; field < 3; field++)
      for (int k = 0; k < kWindow; k++) rows[field][k] = space.row(S::kAlong + field * kWindow, q + k - kRadius);
    const float *const x = space.row(S::kX, q), *const y = space.row(S::kY, q);
    float* const out = space.row(S::kGradient);
    RowSum<float> l1, square;
    for_vectors<float>(width, [&](int64_t i, int part) {
      const Floats u = load(x + i), v = load(y + i), difference = u - v;
      Floats step = sign_of(difference, all(l1_step));
      if (radius) {
        const Floats sum = fma(u, window.across(rows[1], i), window.across(rows[0], i));
        step = fma(all(ssim_step), fma(v, window.across(rows[2], i), sum), step);
      }
      l1.parts[part] = l1.parts[part] + magnitude(difference);
      square.parts[part] = fma(difference, difference, square.parts[part]);
      store(out + i, step);
    });
    sums[3 * q] = l1.total();
    sums[3 * q + 2] = square.total();
    std::copy_n(out, width, gradient + q * width);
  }
}

// Calls work(begin, end, workspace, sums) for bands of rows; adds up sums [height, count] of the rows into `totals`.
template <typename T, typename Work>
void for_bands(int64_t threads, const Images<T>& images, int rows, int count, double* totals, Work&& work) {
  const int64_t runs = threads > 1 ? 2 * threads : 1;
  const int64_t band = std::max<int64_t>((images.height + runs - 1) / runs, kMinBand);
  std::vector<Workspace<T>> spaces(std::min(threads, (images.height + band - 1) / band));
  for (Workspace<T>& space : spaces) space.allocate(images.width, rows);
  std::vector<double> sums(images.height * count);
  parallel_runs(threads, images.height, band, [&](int64_t begin, int64_t end, int thread) {
    work(begin, end, spaces[thread], sums.data());
  });
  std::fill_n(totals, count, 0.0);
  for (int64_t r = 0; r < images.height; r++)
    for (int k = 0; k < count; k++) totals[k] += sums[r * count + k];
}

// The convolution: pixels of a row × outputs that are summed in registers.
constexpr int kPanel = 2 * kFloats, kTile = kFloats == 16 ? 12 : 6;

struct Convolution {
  int64_t values, across;  // of the image: values per row, and per pixel of the result
  int64_t height, taps;    // of the kernel: rows, and adjacent values per row
};

// Computes kPixels × kPanel results: sums of products in the order of the kernel's rows and values.
template <int kPixels>
void convolve_tile(const Convolution& job, const float* x, const float* weights, const float* bias, float* out) {
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
  for (int p = 0; p < kPixels; p++) store(out + p * kPanel, sums[p][0]), store(out + p * kPanel + kFloats, sums[p][1]);
}

using Tile = void (*)(const Convolution&, const float*, const float*, const float*, float*);

template <int... kPixels>
Tile tile_of(int64_t pixels, std::integer_sequence<int, kPixels...>) {
  static constexpr Tile tiles[] = {convolve_tile<kPixels + 1>...};
  return tiles[pixels - 1];
}

}  // namespace

// Computes L1 and SSIM of two images, and their gradient.
//
// x, y, gradient: [height, width] float32; sums: [3], of |x − y|, SSIM (left out if ssim_step is 0) and (x − y)². The
// gradient is l1_step · sign(x − y) + ssim_step · ∂(sum of SSIM)/∂x.
CSPLAT_API int64_t csplat_photometric_loss(int64_t threads, const float* x, const float* y, int64_t height,
                                           int64_t width, double l1_step, double ssim_step, float* gradient,
                                           double* sums) {
  return guarded([&]() -> int64_t {
    const Images<float> images{x, y, height, width};
    for_bands(threads, images, Workspace<float>::kRows, 3, sums,
              [&](int64_t begin, int64_t end, const Workspace<float>& space, double* row_sums) {
                gradient_of_band(images, begin, end, static_cast<float>(l1_step), static_cast<float>(ssim_step), space,
                                 gradient, row_sums);
              });
    return 0;
  });
}

// Sums SSIM of two images, [height, width] float64, into `sum`, [1].
CSPLAT_API int64_t csplat_ssim(int64_t threads, const double* x, const double* y, int64_t height, int64_t width,
                               double* sum) {
  return guarded([&]() -> int64_t {
    const Images<double> images{x, y, height, width};
    const Window<double> window;
    for_bands(threads, images, Workspace<double>::kMetricRows, 1, sum,
              [&](int64_t begin, int64_t end, const Workspace<double>& space, double* row_sums) {
                for (int64_t s = begin - kRadius; s < end + kRadius; s++) {
                  space.read(images, s);
                  const int64_t r = s - kRadius;
                  if (r >= begin) row_sums[r] = compare_row<false>(r, width, window, space);
                }
              });
    return 0;
  });
}

// Convolves an image: result[r, c, o] = bias[o] + Σ_ik weights[i, k, o] · x[r down + i, c across + k].
//
// x: [rows of the image, values]; weights: [height, taps, outputs]; result: [rows, columns, outputs]; all float32.
CSPLAT_API int64_t csplat_convolve(int64_t threads, const float* x, int64_t values, const float* weights,
                                   const float* bias, int64_t height, int64_t taps, int64_t outputs, int64_t down,
                                   int64_t across, int64_t rows, int64_t columns, float* result) {
  return guarded([&]() -> int64_t {
    const Convolution job{values, across, height, taps};
    const int64_t panels = (outputs + kPanel - 1) / kPanel, all_taps = height * taps;
    std::vector<float> packed(panels * (all_taps + 1) * kPanel);  // per panel of outputs: their bias, and their weights
    parallel(threads, panels, [&](int64_t panel, int) {
      const int64_t first = panel * kPanel, count = std::min<int64_t>(kPanel, outputs - first);
      float* out = packed.data() + panel * (all_taps + 1) * kPanel;
      std::copy_n(bias + first, count, out);
      for (int64_t k = 0; k < all_taps; k++) std::copy_n(weights + k * outputs + first, count, out += kPanel);
    });
    const int64_t tiles = (columns + kTile - 1) / kTile;
    parallel(threads, panels * rows, [&](int64_t item, int) {
      const int64_t panel = item / rows, r = item % rows, first = panel * kPanel;
      const int64_t count = std::min<int64_t>(kPanel, outputs - first);
      const float* const own = packed.data() + panel * (all_taps + 1) * kPanel;
      for (int64_t tile = 0; tile < tiles; tile++) {
        const int64_t begin = tile * columns / tiles, pixels = (tile + 1) * columns / tiles - begin;
        float out[kTile * kPanel];
        tile_of(pixels, std::make_integer_sequence<int, kTile>())(
            job, x + r * down * values + begin * across, own + kPanel, own, out);
        for (int64_t p = 0; p < pixels; p++)
          std::copy_n(out + p * kPanel, count, result + (r * columns + begin + p) * outputs + first);
      }
    });
    return 0;
  });
}

}  // namespace csplat
