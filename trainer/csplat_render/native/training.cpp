// SPDX-License-Identifier: Apache-2.0
// Small kernels of training: images in front of a background, noise of splats, pairs of splats.
#include <algorithm>
#include <cmath>

#include "library.h"
#include "threads.h"
#include "vectors.h"

namespace csplat {
namespace {

constexpr int64_t kRun = 4096, kGroup = 512;  // pixels, and splats, that a thread takes at a time

}  // namespace

// Converts pixels to floats: out = α c + (1 − α) background.
//
// pixels: [count, channels] uint8, RGB or RGBA; background: [3] float32; out: [count, 3] float32.
CSPLAT_API int64_t csplat_compose(int64_t threads, const uint8_t* pixels, int64_t count, int64_t channels,
                                  const float* background, float* out) {
  constexpr float over = 1.0f / 255.0f;
  parallel_runs(threads, count, kRun, [&](int64_t begin, int64_t end, int) {
    for (int64_t i = 3 * begin; channels == 3 && i < 3 * end; i++) out[i] = pixels[i] * over;
    if (channels == 3) return;
    const float behind[3] = {background[0], background[1], background[2]};
    for (int64_t i = begin; i < end; i++) {
      const float alpha = pixels[4 * i + 3] * over, rest = 1.0f - alpha;
      for (int k = 0; k < 3; k++) out[3 * i + k] = alpha * (pixels[4 * i + k] * over) + rest * behind[k];
    }
  });
  return 0;
}

// Adds noise to means: R min(g S, most) S Rᵀ n, with R the rotation and S the standard deviations of a splat.
//
// The gate is g = strength / (1 + exp(−slope (1 − α − centre))). Splats with a logit above logit_max are left out, and
// means that would overflow stay. means, scales, normals: [count, 3]; quats: [count, 4]; logits: [count]; all float32.
CSPLAT_API int64_t csplat_add_noise(int64_t threads, int64_t count, float* means, const float* quats,
                                    const float* scales, const float* logits, const float* normals, double strength,
                                    double logit_max, double slope, double centre, double most) {
  parallel_runs(threads, count, kGroup, [&](int64_t begin, int64_t end, int) {
    const int64_t group = end - begin;
    double deviations[3][kGroup] = {}, gates[kGroup] = {};  // their exponents first
    const auto limited = [](double power) { return std::min(std::max(power, -700.0), 700.0); };  // NaN stays
    for (int64_t n = 0; n < group; n++) {
      for (int k = 0; k < 3; k++) deviations[k][n] = limited(scales[3 * (begin + n) + k]);
      gates[n] = limited(-logits[begin + n]);
    }
    const Doubles one = all(1.0);
    for (int64_t n = 0; n < group; n += kDoubles) {
      for (double* row : deviations) store(row + n, exp(load(row + n)));
      const Doubles alpha = one / (one + exp(load(gates + n)));
      store(gates + n, all(strength) / (one + exp(all(-slope) * (one - alpha - all(centre)))));
    }
    for (int64_t i = begin, n = 0; i < end; i++, n++) {
      if (logits[i] > logit_max) continue;
      const double w = quats[4 * i], x = quats[4 * i + 1], y = quats[4 * i + 2], z = quats[4 * i + 3];
      const double rotation[3][3] = {
          {1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)},
          {2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)},
          {2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)},
      };
      double local[3];
      float moved[3];
      for (int k = 0; k < 3; k++) {
        const double along = rotation[0][k] * normals[3 * i] + rotation[1][k] * normals[3 * i + 1] +
                             rotation[2][k] * normals[3 * i + 2];
        local[k] = along * std::min(gates[n] * deviations[k][n], most) * deviations[k][n];
      }
      for (int k = 0; k < 3; k++)
        moved[k] = static_cast<float>(means[3 * i + k] + (rotation[k][0] * local[0] + rotation[k][1] * local[1] +
                                                          rotation[k][2] * local[2]));
      if (std::isfinite(moved[0]) && std::isfinite(moved[1]) && std::isfinite(moved[2]))
        std::copy_n(moved, 3, means + 3 * i);
    }
  });
  return 0;
}

// Pairs the splats of edges, in the given order, if neither has a partner; stops after `most` pairs.
//
// edges: [2, edge_count], two splats; order: [edge_count], indices of edges; partners: [number of splats], −1 on entry
// and for splats without a partner; all int64. Returns the number of pairs.
CSPLAT_API int64_t csplat_pair_up(int64_t, const int64_t* edges, const int64_t* order, int64_t edge_count, int64_t most,
                                  int64_t* partners) {
  int64_t count = 0;
  for (int64_t n = 0; n < edge_count && count < most; n++) {
    const int64_t i = edges[order[n]], j = edges[edge_count + order[n]];
    if (partners[i] >= 0 || partners[j] >= 0) continue;
    partners[i] = j, partners[j] = i;
    count++;
  }
  return count;
}

}  // namespace csplat
