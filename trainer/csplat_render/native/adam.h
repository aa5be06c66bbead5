// Adam without weight decay (Kingma & Ba 2015, https://arxiv.org/abs/1412.6980), and the limits of values after a step.
//
//     mean ← b1 mean + (1 − b1) g
//     square ← b2 square + (1 − b2) g²
//     value ← value − rate · mean / (√square · over_root + epsilon)
//
// `rate` is the learning rate over 1 − b1^t, `over_root` is 1 / √(1 − b2^t). Moments below 1e-30 become 0: those of a
// splat that no image shows decay towards denormal numbers, which are slow. So do moments that are NaN.
#pragma once

#include <cmath>
#include <cstdint>
#include <cstring>

#include "vectors.h"

namespace csplat {

// Makes a step for `count` values.
inline void step_adam(float rate, float over_root, float b2, int64_t count, float* value, const float* gradient,
                      float* first, float* second) {
  const auto step = [=](float* p, const float* g, float* m, float* v) {
    const Floats slope = load(g), tiny = all(1e-30f);
    Floats mean = fma(all(0.9f), load(m), all(0.1f) * slope);
    Floats square = fma(all(b2), load(v), all(1.0f - b2) * slope * slope);
    mean = keep(at_least(magnitude(mean), tiny), mean);
    square = keep(at_least(square, tiny), square);
    store(m, mean);
    store(v, square);
    store(p, load(p) - all(rate) * mean / fma(square_root(square), all(over_root), all(1e-15f)));
  };
  int64_t n = 0;
  for (; n + kFloats <= count; n += kFloats) step(value + n, gradient + n, first + n, second + n);
  const size_t left = static_cast<size_t>(count - n) * sizeof(float);
  if (!left) return;
  float p[kFloats] = {}, g[kFloats] = {}, m[kFloats] = {}, v[kFloats] = {};
  std::memcpy(p, value + n, left);
  std::memcpy(g, gradient + n, left);
  std::memcpy(m, first + n, left);
  std::memcpy(v, second + n, left);
  step(p, g, m, v);
  std::memcpy(value + n, p, left);
  std::memcpy(first + n, m, left);
  std::memcpy(second + n, v, left);
}

// Normalises quaternions w x y z, [count, 4]; those that are shorter than 1e-12 or NaN become the identity.
inline void constrain_quats(int64_t count, float* quats) {
  for (float *q = quats, *end = quats + 4 * count; q < end; q += 4) {
    const float length = std::sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]);
    const float over = 1.0f / length;
    for (int n = 0; n < 4; n++) q[n] = length >= 1e-12f ? q[n] * over : n ? 0.0f : 1.0f;
  }
}

// Returns a logit within ±14; beyond, alpha has few digits in float.
inline float constrain_logit(float a) { return a < -14.0f ? -14.0f : a > 14.0f ? 14.0f : a; }

}  // namespace csplat
