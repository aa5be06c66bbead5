// SPDX-License-Identifier: Apache-2.0
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
    double q[3];
    const auto length = [&]() { return (q[0] * q[0] + q[1] * q[1] + q[2] * q[2]) * multiple * multiple; };
    for (int c = 0; c < 3; c++) {
      const float scaled = quats[c + 1] * factor, whole = std::rint(scaled);
      outside |= !(std::fabs(scaled) < 1e9f);
      q[c] = whole < -most ? -most : whole > most ? most : whole;
    }
    if (length() > squared)
      for (int c = 0; c < 3; c++) q[c] = std::trunc(quats[c + 1] * factor);
    out[0] = static_cast<float>(std::sqrt(squared - length()) * over);
    for (int c = 0; c < 3; c++) out[c + 1] = static_cast<float>((q[c] * multiple + 0.0) * over);
  }
  return outside != 0;
}

// Splits n colours [n, 3] into three arrays, each value times a factor.
template <typename Real>
void split(int64_t n, const float* rgb, Real factor, Real* r, Real* g, Real* b) {
  for (int64_t i = 0; i < n; i++) {
    r[i] = rgb[3 * i] * factor;
    g[i] = rgb[3 * i + 1] * factor;
    b[i] = rgb[3 * i + 2] * factor;
  }
}

// Quantises colours `begin` to `end` to multiples of 2**coarse steps; `coarse` is null for 0.
template <typename Real>
bool round_colours(int64_t begin, int64_t end, double step, int shift, const int* coarse, const float* rgb,
                   float* out) {
  const Real part = static_cast<Real>(std::ldexp(1.0, -shift)), most = kMostSteps;
  int outside = 0;
  for (; begin < end; begin += kColours) {
    const int64_t n = std::min<int64_t>(end - begin, kColours);
    Real r[kColours], g[kColours], b[kColours];
    float decoded[3][kColours];
    int factors[kColours];
    for (int64_t i = 0; i < n; i++) factors[i] = coarse ? 1 << coarse[begin + i] : 1;
    split(n, rgb + 3 * begin, static_cast<Real>(1.0 / step), r, g, b);
    for (int64_t i = 0; i < n; i++) {
      const int beyond = !(std::fabs(r[i]) < most) | !(std::fabs(g[i]) < most) | !(std::fabs(b[i]) < most);
      outside |= beyond;
      if (beyond) r[i] = g[i] = b[i] = Real(0);
      const Real finer = static_cast<Real>(1.0f / static_cast<float>(factors[i]));
      const auto rounded = [&](Real a) { return static_cast<int>(std::rint(a * finer)) * factors[i]; };
      const int co = rounded((r[i] - b[i]) * part) * (1 << shift);
      const int cg = rounded((g[i] - (r[i] + b[i]) * Real(0.5)) * part) * (1 << shift);
      const Real luma = (r[i] + g[i] + b[i] - static_cast<Real>(cg + co - 2 * (co >> 1))) / Real(3);
      const int t = rounded(luma + static_cast<Real>(cg >> 1)) - (cg >> 1), blue = t - (co >> 1);
      decoded[0][i] = static_cast<float>(static_cast<double>(blue + co) * step);
      decoded[1][i] = static_cast<float>(static_cast<double>(cg + t) * step);
      decoded[2][i] = static_cast<float>(static_cast<double>(blue) * step);
    }
    for (int64_t i = 0; i < n; i++)
      for (int c = 0; c < 3; c++) out[3 * (begin + i) + c] = decoded[c][i];
  }
  return outside != 0;
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
    const int k = static_cast<int>(shift);
    const double most = std::fmin(1e38, 4503599627370496.0 * tile.mean_step);  // 2**52 steps
    bool outside = round_to_lattice<double>(3 * (end - begin), tile.mean_step, most, means + 3 * begin,
                                            decoded_means + 3 * begin);
    outside |= round_opacities(end - begin, static_cast<double>(opacity_levels), tile.opacity_multiple, alphas + begin,
                               decoded_alphas + begin);
    const auto round = tile.in_double ? round_colours<double> : round_colours<float>;
    return outside | round(begin, end, tile.colour_step, k, nullptr, colours, decoded_colours);
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

// Decodes n colours of SH, rounded to multiples of 2**coarse [n] steps; returns the number of runs with values to leave
// to NumPy.
CSPLAT_API int64_t csplat_dequantise_sh(int64_t threads, int64_t n, double step, int64_t shift, const int* coarse,
                                        const float* sh, float* decoded) {
  const Tile all = {};
  return over_tiles(threads, n, 1, &all, [=](int64_t begin, int64_t end, const Tile&) {
    return round_colours<float>(begin, end, step, static_cast<int>(shift), coarse, sh, decoded);
  });
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
    std::fill(out + begin * width, out + end * width, 0.0f);
    const auto add = [=](auto w) {
      for (int64_t i = 0; i < splats; i++)
        if (row[i] >= begin && row[i] < end)
          for (int64_t c = 0; c < w; c++) out[row[i] * w + c] += values[i * w + c];
    };
    switch (width) {
      case 3: return add(std::integral_constant<int64_t, 3>());
      case 4: return add(std::integral_constant<int64_t, 4>());
      case 45: return add(std::integral_constant<int64_t, 45>());
      default: add(width);
    }
  });
  return 0;
}

// Adds the slopes of columns that are quantised one by one to gradients [rows, width]. `tables` is [width − first,
// 257]; the columns before `first` have none.
CSPLAT_API int64_t csplat_add_slopes(int64_t threads, int64_t rows, int64_t width, int64_t first, double step,
                                     double per_bit, const float* tables, const float* seen, float* gradients) {
  const float over = static_cast<float>(1.0 / step), weight = static_cast<float>(per_bit) * over;
  const int64_t most = kColours / width * width;
  int places[kColours];  // of the integer 0 in the tables
  float weights[kColours];
  for (int64_t i = 0; i < most; i++) {
    const int64_t column = i % width - first;
    places[i] = static_cast<int>(std::max<int64_t>(column, 0)) * kTable + kReach;
    weights[i] = column < 0 ? 0.0f : weight;
  }
  parallel_runs(threads, rows * width, most * 16, [&](int64_t begin, int64_t end, int) {
    for (; begin < end; begin += most) {
      const int64_t n = std::min(most, end - begin);
      int own[kColours];
      float slopes[kColours];
      for (int64_t i = 0; i < n; i++) own[i] = places[i] + integer_of(seen[begin + i] * over, kReach);
      for (int64_t i = 0; i < n; i++) slopes[i] = tables[own[i]];
      for (int64_t i = 0; i < n; i++) gradients[begin + i] += weights[i] * slopes[i];
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
  const int64_t most = kColours / width * width;
  int places[kColours];  // of the integer 0 of Y in the tables
  for (int i = 0; i < kColours; i++) places[i] = 3 * kTable * static_cast<int>(i % width) + kReach;
  parallel_runs(threads, rows * width, most * 16, [&](int64_t begin, int64_t end, int) {
    for (; begin < end; begin += most) {
      const int64_t n = std::min(most, end - begin);
      float r[kColours], g[kColours], b[kColours], *to = gradients + 3 * begin;
      int y[kColours], co[kColours], cg[kColours];
      split(n, seen + 3 * begin, over, r, g, b);
      for (int64_t i = 0; i < n; i++) {
        const int red = integer_of(r[i], 1 << 24), green = integer_of(g[i], 1 << 24), blue = integer_of(b[i], 1 << 24);
        const int difference = red - blue, t = blue + (difference >> 1), rest = green - t;
        y[i] = places[i] + limited(t + (rest >> 1));
        co[i] = places[i] + kTable + limited(difference >> shift);
        cg[i] = places[i] + 2 * kTable + limited(rest >> shift);
      }
      for (int64_t i = 0; i < n; i++) {
        r[i] = tables[y[i]];
        g[i] = chroma * tables[co[i]];
        b[i] = chroma * tables[cg[i]];
      }
      for (int64_t i = 0; i < n; i++) {
        to[3 * i] += weight * (0.25f * r[i] + g[i] - 0.5f * b[i]);
        to[3 * i + 1] += weight * (0.5f * r[i] + b[i]);
        to[3 * i + 2] += weight * (0.25f * r[i] - g[i] - 0.5f * b[i]);
      }
    }
  });
  return 0;
}
