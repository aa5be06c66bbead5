// SPDX-License-Identifier: Apache-2.0
// Steps of Adam for arrays; see adam.h.
#include "adam.h"

#include "library.h"
#include "threads.h"
#include "vectors.h"

using namespace csplat;

// Makes a step for arrays of n floats: the values, gradients, and Adam's moments.
CSPLAT_API int64_t csplat_adam(int64_t threads, int64_t n, double rate, double over_root, double b2, float* value,
                               const float* gradient, float* first, float* second) {
  const float r = static_cast<float>(rate), o = static_cast<float>(over_root), b = static_cast<float>(b2);
  parallel_runs(threads, n, 1 << 14, [=](int64_t begin, int64_t end, int) {
    step_adam(r, o, b, end - begin, value + begin, gradient + begin, first + begin, second + begin);
  });
  return 0;
}

// Normalises quaternions [rows, 4], and limits n logits.
CSPLAT_API int64_t csplat_constrain_splats(int64_t threads, int64_t rows, float* quats, int64_t n, float* logits) {
  parallel_runs(threads, rows, 1 << 13, [=](int64_t begin, int64_t end, int) {
    constrain_quats(end - begin, quats + 4 * begin);
  });
  for (int64_t i = 0; i < n; i++) logits[i] = constrain_logit(logits[i]);
  return 0;
}

// Computes alpha = 1 / (1 + e^−logit) of n logits in double, rounded once.
CSPLAT_API int64_t csplat_sigmoid(int64_t threads, int64_t n, const float* logits, float* alphas) {
  parallel_runs(threads, n, 1 << 13, [=](int64_t begin, int64_t end, int) {
    const auto compute = [](Doubles x) {
      return all(1.0) / (all(1.0) + exp(-smaller(all(700.0), larger(all(-700.0), x))));
    };
    for (; begin + kDoubles <= end; begin += kDoubles)
      store_floats(alphas + begin, compute(load_doubles(logits + begin)));
    for (; begin < end; begin++)
      alphas[begin] = static_cast<float>(first_lane(compute(all(static_cast<double>(logits[begin])))));
  });
  return 0;
}
