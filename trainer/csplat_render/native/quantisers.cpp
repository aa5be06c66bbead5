// Quantisers of a file, for steps of fine-tuning through them: decoded values, sums of gradients over the splats of a
// codebook entry, and slopes of the rate term.
//
// With s a step of a lattice, R() rounding to the nearest integer, halves to even, and M a number of levels:
//
//     means, scales  R(v / s) s
//     opacities      q² / M²,  q = R(√alpha M)
//     quats          (√(2 M² − |q|²), q) / (√2 M),  q = R(√2 M (x, y, z)), rounded towards 0 if |q|² > 2 M²
//     colours        Co = R((r − b) / 2^k), Cg = R((g − (r + b) / 2) / 2^k), Y so that the decoded sum is closest
//
// Each result equals that of the NumPy code of csplat.encoder bit for bit: the operations, their precision and their
// order are the same, and adding 0.0 gives the zero of an integer, which has no sign. If that code takes another path
// for a value (NaN, a coarser lattice, wider integers), the result only says so.
//
// Rate term: a gradient grows by the slope of a table at the value's integer, in bits per step, times loss per bit.
//
// A codebook's rows are its entries, then the escaped splats. Parallel over runs of rows; sums are in the order of the
// splats.
#include <algorithm>
#include <atomic>
#include <cmath>
#include <cstring>
#include <type_traits>

#include "library.h"
#include "threads.h"

namespace csplat {
namespace {

constexpr int64_t kRun = 2048;            // rows that a thread takes at a time
constexpr int kColours = 256;             // colours that are quantised at a time
constexpr float kMostSteps = 1 << 19;     // magnitude in steps above which a tile may need a coarser lattice, LAT-4
constexpr double kRoot2 = 1.4142135623730951;
constexpr int kReach = 128, kTable = 2 * kReach + 1;  // largest integer of a table, and its size

// Consecutive splats with the same steps, from `begin` on.
struct Tile { double begin, mean_step, scale_step, quat_multiple, opacity_multiple, colour_step, in_double; };

// Calls function(begin, end, tile) for runs of rows of a tile; returns the number of runs for which it returns true.
template <typename Function>
int64_t over_tiles(int64_t threads, int64_t rows, int64_t tile_count, const Tile* tiles, Function&& function) {
  std::atomic<int64_t> outside{0};
  parallel_runs(threads, rows, kRun, [&](int64_t begin, int64_t end, int) {
    for (int64_t n = 0; n < tile_count; n++) {
      const int64_t first = static_cast<int64_t>(tiles[n].begin);
      const int64_t stop = n + 1 < tile_count ? static_cast<int64_t>(tiles[n + 1].begin) : rows;
      const int64_t from = first > begin ? first : begin, to = stop < end ? stop : end;
      if (from < to && function(from, to, tiles[n])) outside++;
    }
  });
  return outside;
}

// Rounds n values to multiples of a step; returns true if one is not within ± `most`. `Real` is the type of quotients.
template <typename Real>
bool round_to_lattice(int64_t n, double step, double most, const float* values, float* out) {
  const Real divisor = static_cast<Real>(step);
  const float limit = static_cast<float>(most);
  int outside = 0;
  for (int64_t i = 0; i < n; i++) {
    outside |= !(std::fabs(values[i]) <= limit);
    out[i] = static_cast<float>((static_cast<double>(std::rint(values[i] / divisor)) + 0.0) * step);
  }
  return outside != 0;
}

bool round_opacities(int64_t n, double levels, double multiple, const float* alphas, float* out) {
  const float factor = static_cast<float>(levels / multiple), most = static_cast<float>(levels);
  const float times = static_cast<float>(multiple);
  int outside = 0;
  for (int64_t i = 0; i < n; i++) {
    outside |= !(alphas[i] >= 0.0f && alphas[i] <= 1.0f);
    const float q = std::rint(std::sqrt(alphas[i]) * factor) * times;
    const double level = alphas[i] == 1.0f || q > most ? most : q;
    out[i] = static_cast<float>(level * level / (levels * levels));
  }
  return outside != 0;
}

bool round_quats(int64_t n, double levels, double multiple, const float* quats, float* out) {
  const float factor = static_cast<float>(levels * kRoot2 / multiple);
  const float most = static_cast<float>(std::floor(levels / multiple));
  const double over = 1.0 / (levels * kRoot2), squared = 2.0 * levels * levels;
  int outside = 0;
  for (int64_t i = 0; i < n; i++, quats += 4, out += 4) {
    double q[3], sum = 0.0;
    for (int c = 0; c < 3; c++) {
      const float scaled = quats[c + 1] * factor, whole = std::rint(scaled);
      outside |= !(std::fabs(scaled) < 1e9f);
      q[c] = whole < -most ? -most : whole > most ? most : whole;
    }
    sum = (q[0] * q[0] + q[1] * q[1] + q[2] * q[2]) * multiple * multiple;
    if (sum > squared) {
      for (int c = 0; c < 3; c++) q[c] = std::trunc(quats[c + 1] * factor);
      sum = (q[0] * q[0] + q[1] * q[1] + q[2] * q[2]) * multiple * multiple;
    }
    out[0] = static_cast<float>(std::sqrt(squared - sum) * over);
    for (int c = 0; c < 3; c++) out[c + 1] = static_cast<float>((q[c] * multiple + 0.0) * over);
  }
  return outside != 0;
}

// Splits n colours [n, 3] into three arrays, each value times a factor.
template <typename Real>
void split(int n, const float* rgb, Real factor, Real* r, Real* g, Real* b) {
  for (int i = 0; i < n; i++) {
    r[i] = rgb[3 * i] * factor;
    g[i] = rgb[3 * i + 1] * factor;
    b[i] = rgb[3 * i + 2] * factor;
  }
}

// Quantises n <= kColours colours to multiples of 2**coarse steps.
template <typename Real>
bool round_colours(int n, double step, int shift, const int* coarse, const float* rgb, float* out) {
  Real r[kColours], g[kColours], b[kColours], finer[kColours];
  split(n, rgb, static_cast<Real>(1.0 / step), r, g, b);
  const Real part = static_cast<Real>(std::ldexp(1.0, -shift));
  for (int i = 0; i < n; i++) finer[i] = static_cast<Real>(1.0f / static_cast<float>(1 << coarse[i]));
  int outside = 0;
  float decoded[3][kColours];
  for (int i = 0; i < n; i++) {
    const Real most = kMostSteps;
    const int beyond = !(std::fabs(r[i]) < most) | !(std::fabs(g[i]) < most) | !(std::fabs(b[i]) < most);
    outside |= beyond;
    if (beyond) r[i] = g[i] = b[i] = Real(0);
    const auto rounded = [&](Real a) { return static_cast<int>(std::rint(a * finer[i])) * (1 << coarse[i]); };
    const int co = rounded((r[i] - b[i]) * part) * (1 << shift);
    const int cg = rounded((g[i] - (r[i] + b[i]) * Real(0.5)) * part) * (1 << shift);
    Real luma = r[i] + g[i] + b[i] - static_cast<Real>(cg + co - 2 * (co >> 1));
    luma = luma / Real(3) + static_cast<Real>(cg >> 1);
    const int t = rounded(luma) - (cg >> 1), blue = t - (co >> 1);
    decoded[0][i] = static_cast<float>(static_cast<double>(blue + co) * step);
    decoded[1][i] = static_cast<float>(static_cast<double>(cg + t) * step);
    decoded[2][i] = static_cast<float>(static_cast<double>(blue) * step);
  }
  for (int i = 0; i < n; i++)
    for (int c = 0; c < 3; c++) out[3 * i + c] = decoded[c][i];
  return outside != 0;
}

// Calls function(width) with a constant for the widths of quats, scales, and SH of degree 1 to 3.
template <typename Function>
void with_width(int64_t width, Function&& function) {
  switch (width) {
    case 3: return function(std::integral_constant<size_t, 3>());
    case 4: return function(std::integral_constant<size_t, 4>());
    case 9: return function(std::integral_constant<size_t, 9>());
    case 24: return function(std::integral_constant<size_t, 24>());
    case 45: return function(std::integral_constant<size_t, 45>());
    default: return function(static_cast<size_t>(width));
  }
}

// Returns the integer of a value, limited to ± `most`, where NaN has −most.
inline int integer_of(float value, float most) {
  const float n = std::rint(value);
  return static_cast<int>(n > -most ? (n < most ? n : most) : -most);
}

inline int limited(int n) { return n < -kReach ? -kReach : n > kReach ? kReach : n; }

}  // namespace
}  // namespace csplat

using namespace csplat;

// Decodes means [rows, 3], opacities [rows] and colours [rows, 3]; returns the number of runs with values to leave to
// NumPy. `tiles` is [tile_count, 7], as `Tile`.
CSPLAT_API int64_t csplat_dequantise_splats(int64_t threads, int64_t rows, int64_t tile_count, const Tile* tiles,
                                            int64_t opacity_levels, int64_t shift, const float* means,
                                            const float* alphas, const float* colours, float* decoded_means,
                                            float* decoded_alphas, float* decoded_colours) {
  return over_tiles(threads, rows, tile_count, tiles, [=](int64_t begin, int64_t end, const Tile& tile) {
    const int coarse[kColours] = {}, k = static_cast<int>(shift);
    const double most = std::fmin(1e38, 4503599627370496.0 * tile.mean_step);  // 2**52 steps
    bool outside = round_to_lattice<double>(3 * (end - begin), tile.mean_step, most, means + 3 * begin,
                                            decoded_means + 3 * begin);
    outside |= round_opacities(end - begin, static_cast<double>(opacity_levels), tile.opacity_multiple, alphas + begin,
                               decoded_alphas + begin);
    for (; begin < end; begin += kColours) {
      const int n = static_cast<int>(end - begin < kColours ? end - begin : kColours);
      const float* from = colours + 3 * begin;
      float* to = decoded_colours + 3 * begin;
      outside |= tile.in_double ? round_colours<double>(n, tile.colour_step, k, coarse, from, to)
                                : round_colours<float>(n, tile.colour_step, k, coarse, from, to);
    }
    return outside;
  });
}

// Decodes quats [rows, 4] and scales [rows, 3], of which the first `entries` rows are a codebook's; returns the number
// of runs with values to leave to NumPy.
CSPLAT_API int64_t csplat_dequantise_shapes(int64_t threads, int64_t rows, int64_t entries, int64_t tile_count,
                                            const Tile* tiles, int64_t quat_levels, const float* quats,
                                            const float* scales, float* decoded_quats, float* decoded_scales) {
  return over_tiles(threads, rows, tile_count, tiles, [=](int64_t begin, int64_t end, const Tile& tile) {
    const double levels = static_cast<double>(quat_levels), step = tile.scale_step, most = step * kMostSteps;
    const int64_t own = entries < begin ? begin : entries < end ? entries : end;
    return round_quats(end - begin, levels, tile.quat_multiple, quats + 4 * begin, decoded_quats + 4 * begin) |
           round_to_lattice<float>(3 * (own - begin), step, most, scales + 3 * begin, decoded_scales + 3 * begin) |
           round_to_lattice<double>(3 * (end - own), step, most, scales + 3 * own, decoded_scales + 3 * own);
  });
}

// Decodes SH [rows, width, 3], rounded to multiples of 2**coarse [rows] steps; returns the number of runs with values
// to leave to NumPy.
CSPLAT_API int64_t csplat_dequantise_sh(int64_t threads, int64_t rows, int64_t width, double step, int64_t shift,
                                        const int* coarse, const float* sh, float* decoded) {
  const Tile tile = {};
  return over_tiles(threads, rows, 1, &tile, [=](int64_t begin, int64_t end, const Tile&) {
    bool outside = false;
    for (const int64_t most = kColours / width; begin < end; begin += most) {
      const int64_t stop = begin + most < end ? begin + most : end;
      int exponents[kColours], n = 0;
      for (int64_t row = begin; row < stop; row++)
        for (int64_t k = 0; k < width; k++) exponents[n++] = coarse[row];
      const int64_t place = 3 * width * begin;
      outside |= round_colours<float>(n, step, static_cast<int>(shift), exponents, sh + place, decoded + place);
    }
    return outside;
  });
}

// Sets out [splats, width] to the rows of the splats.
CSPLAT_API int64_t csplat_take_rows(int64_t threads, int64_t splats, int64_t width, const int64_t* row,
                                    const float* rows, float* out) {
  parallel_runs(threads, splats, kRun, [=](int64_t begin, int64_t end, int) {
    with_width(width, [=](auto w) {
      for (int64_t i = begin; i < end; i++) std::memcpy(out + i * w, rows + row[i] * w, sizeof(float) * w);
    });
  });
  return 0;
}

// Rounds sizes [splats] to their lattice, and adds them to decoded log scales [splats, 3].
CSPLAT_API int64_t csplat_add_sizes(int64_t threads, int64_t splats, double step, const float* sizes, float* scales,
                                    float* decoded_sizes) {
  parallel_runs(threads, splats, kRun, [=](int64_t begin, int64_t end, int) {
    const float divisor = static_cast<float>(step);
    for (int64_t i = begin; i < end; i++) {
      const double size = std::rint(sizes[i] / divisor) + 0.0;
      decoded_sizes[i] = static_cast<float>(size * step);
      for (int64_t k = 3 * i; k < 3 * i + 3; k++)
        scales[k] = static_cast<float>((std::rint(scales[k] / step) + size) * step);
    }
  });
  return 0;
}

// Sets out [rows, width] to the sums of the values [splats, width] over the splats of each row. `starts` [rows + 1] is
// the number of splats of the rows before each.
CSPLAT_API int64_t csplat_sum_by_row(int64_t threads, int64_t splats, int64_t width, const int64_t* row,
                                     const float* values, int64_t rows, const int64_t* starts, float* out) {
  // Each thread goes through all splats, and adds those of its rows, which about 1 / threads of the splats use.
  parallel(threads, threads, [=](int64_t part, int) {
    const auto bound = [=](int64_t n) {
      return n == threads ? rows : std::lower_bound(starts, starts + rows, n * splats / threads) - starts;
    };
    const int64_t begin = bound(part), end = bound(part + 1);
    with_width(width, [=](auto w) {
      std::memset(out + begin * w, 0, sizeof(float) * w * static_cast<size_t>(end - begin));
      for (int64_t i = 0; i < splats; i++) {
        if (row[i] < begin || row[i] >= end) continue;
        for (int64_t c = 0; c < static_cast<int64_t>(w); c++) out[row[i] * w + c] += values[i * w + c];
      }
    });
  });
  return 0;
}

// Adds the slopes of columns that are quantised one by one to gradients [rows, width]. `tables` is [width − first,
// 257]; the columns before `first` have none.
CSPLAT_API int64_t csplat_add_slopes(int64_t threads, int64_t rows, int64_t width, int64_t first, double step,
                                     double per_bit, const float* tables, const float* seen, float* gradients) {
  const float over = static_cast<float>(1.0 / step), weight = static_cast<float>(per_bit) * over;
  int base[kColours], most = kColours - kColours % static_cast<int>(width);
  float weights[kColours];
  for (int i = 0; i < most; i++) {
    const int column = i % static_cast<int>(width) - static_cast<int>(first);
    base[i] = kReach + (column < 0 ? 0 : column * kTable);
    weights[i] = column < 0 ? 0.0f : weight;
  }
  parallel_runs(threads, rows * width, most * 16, [&](int64_t begin, int64_t end, int) {
    for (; begin < end; begin += most) {
      const int n = static_cast<int>(end - begin < most ? end - begin : most);
      int places[kColours];
      float slopes[kColours];
      for (int i = 0; i < n; i++) places[i] = base[i] + integer_of(seen[begin + i] * over, kReach);
      for (int i = 0; i < n; i++) slopes[i] = tables[places[i]];
      for (int i = 0; i < n; i++) gradients[begin + i] += weights[i] * slopes[i];
    }
  });
  return 0;
}

// Adds the slopes of decoded opacities [rows] to gradients of logits. The level is M √alpha, whose derivative by the
// logit is M √alpha (1 − alpha) / 2.
CSPLAT_API int64_t csplat_add_opacity_slopes(int64_t threads, int64_t rows, double levels, double per_bit,
                                             const float* table, const float* alphas, float* gradients) {
  const float most = static_cast<float>(levels), half = static_cast<float>(0.5 * levels);
  const float weight = static_cast<float>(per_bit);
  parallel_runs(threads, rows, kRun, [=](int64_t begin, int64_t end, int) {
    for (int64_t i = begin; i < end; i++) {
      const float root = std::sqrt(alphas[i]), chain = half * root * (1.0f - alphas[i]);
      gradients[i] += weight * chain * table[kReach + integer_of(root * most, kReach)];
    }
  });
  return 0;
}

// Adds the slopes of decoded colours to gradients [rows, width, 3]. `tables` is [3 width, 257], of Y, Co and Cg.
//
// Y = (R + 2 G + B) / 4, Co = R − B, Cg = G − (R + B) / 2, up to rounding.
CSPLAT_API int64_t csplat_add_colour_slopes(int64_t threads, int64_t rows, int64_t width, double step, int64_t shift,
                                            double per_bit, const float* tables, const float* seen,
                                            float* gradients) {
  const float over = static_cast<float>(1.0 / step), weight = static_cast<float>(per_bit) * over;
  const float chroma = static_cast<float>(std::ldexp(1.0, -static_cast<int>(shift)));
  const int64_t most = kColours / width;
  int first[kColours];  // places of the integer 0 of Y in the tables
  for (int i = 0; i < kColours; i++) first[i] = 3 * kTable * static_cast<int>(i % width) + kReach;
  parallel_runs(threads, rows, most * (kRun / most), [&](int64_t begin, int64_t end, int) {
    for (; begin < end; begin += most) {
      const int n = static_cast<int>(width * (begin + most < end ? most : end - begin));
      const float* values = seen + 3 * width * begin;
      float* to = gradients + 3 * width * begin;
      float r[kColours], g[kColours], b[kColours];
      int y[kColours], co[kColours], cg[kColours];
      split(n, values, over, r, g, b);
      for (int i = 0; i < n; i++) {
        const int red = integer_of(r[i], 1 << 24), green = integer_of(g[i], 1 << 24);
        const int blue = integer_of(b[i], 1 << 24);
        const int difference = red - blue, t = blue + (difference >> 1), rest = green - t;
        y[i] = first[i] + limited(t + (rest >> 1));
        co[i] = first[i] + kTable + limited(difference >> shift);
        cg[i] = first[i] + 2 * kTable + limited(rest >> shift);
      }
      for (int i = 0; i < n; i++) {
        r[i] = tables[y[i]];
        g[i] = chroma * tables[co[i]];
        b[i] = chroma * tables[cg[i]];
      }
      for (int i = 0; i < n; i++) {
        to[3 * i] += weight * (0.25f * r[i] + g[i] - 0.5f * b[i]);
        to[3 * i + 1] += weight * (0.5f * r[i] + b[i]);
        to[3 * i + 2] += weight * (0.25f * r[i] - g[i] - 0.5f * b[i]);
      }
    }
  });
  return 0;
}

// Restricts values to those that a file can represent: means [rows, 3] to their boxes, quats [shapes, 4] to w >= 0,
// and SH [coefficients, 3] to 0 where `zero` is true, if it is given.
CSPLAT_API int64_t csplat_constrain_values(int64_t threads, int64_t rows, const float* low, const float* high,
                                           float* means, int64_t shapes, float* quats, int64_t coefficients,
                                           const bool* zero, float* sh) {
  parallel_runs(threads, rows, kRun, [=](int64_t begin, int64_t end, int) {
    for (int64_t i = 3 * begin; i < 3 * end; i++)
      means[i] = means[i] < low[i] ? low[i] : means[i] > high[i] ? high[i] : means[i];
  });
  parallel_runs(threads, shapes, kRun, [=](int64_t begin, int64_t end, int) {
    for (int64_t i = begin; i < end; i++)
      for (float* q = quats + 4 * i, *stop = quats[4 * i] < 0.0f ? q + 4 : q; q < stop; q++) *q = -*q;
  });
  if (zero)
    parallel_runs(threads, coefficients, 16 * kRun, [=](int64_t begin, int64_t end, int) {
      for (int64_t i = begin; i < end; i++)
        for (int c = 0; c < 3; c++) sh[3 * i + c] = zero[i] ? 0.0f : sh[3 * i + c];
    });
  return 0;
}
