// SPDX-License-Identifier: Apache-2.0
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

namespace csplat {

// Makes a step for `count` values.
inline void step_adam(float rate, float over_root, float b2, int64_t count, float* value, const float* gradient,
                      float* first, float* second) {
  for (int64_t n = 0; n < count; n++) {
    float mean = std::fma(0.9f, first[n], 0.1f * gradient[n]);
    float square = std::fma(b2, second[n], (1.0f - b2) * gradient[n] * gradient[n]);
    mean = std::fabs(mean) >= 1e-30f ? mean : 0.0f;
    square = square >= 1e-30f ? square : 0.0f;
    first[n] = mean;
    second[n] = square;
    value[n] -= rate * mean / std::fma(std::sqrt(square), over_root, 1e-15f);
  }
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
