// Steps of Adam for arrays; see adam.h.
#include "adam.h"

#include "library.h"
#include "threads.h"

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
    const auto compute = [](const float* from, float* to) {
      const Doubles x = smaller(all(700.0), larger(all(-700.0), load_doubles(from)));
      store_floats(to, all(1.0) / (all(1.0) + exp(-x)));
    };
    for (; begin + kDoubles <= end; begin += kDoubles) compute(logits + begin, alphas + begin);
    float lanes[kDoubles] = {};
    std::memcpy(lanes, logits + begin, static_cast<size_t>(end - begin) * sizeof(float));
    compute(lanes, lanes);
    std::memcpy(alphas + begin, lanes, static_cast<size_t>(end - begin) * sizeof(float));
  });
  return 0;
}
