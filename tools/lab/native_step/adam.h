// A step of Adam without weight decay for a block of splats; then quaternions are normalised, and logits clipped.
//
//     mean ← b1 mean + (1 − b1) g
//     square ← b2 square + (1 − b2) g²
//     value ← value − rate / (1 − b1^t) · mean / (√square / √(1 − b2^t) + epsilon)
//
// Splats that a view does not show take the step with g = 0. Their moments become 0 below 1e-30, because denormal
// numbers are slow.
#pragma once

#include <cmath>

#include "engine.h"

namespace csplat {

class Adam {
  static constexpr int kGroups = 5;

 public:
  Adam() = default;
  // `rates` are the learning rates of quats, scales, logits, sh0 and shN, and b2; `step` is 1 for the first step.
  Adam(const float* rates, int64_t step) : beta2_(rates[kGroups]), rest2_(1.0f - rates[kGroups]) {
    const double t = static_cast<double>(step), correction = 1.0 - std::pow(kBeta1, t);
    over_ = static_cast<float>(1.0 / std::sqrt(1.0 - std::pow(static_cast<double>(beta2_), t)));
    for (int n = 0; n < kGroups; n++) rates_[n] = static_cast<float>(rates[n] / correction);
  }

  // Steps the values of a block from kQuat on.
  void step(int value_count, float* values, const float* gradients, float* first, float* second) const {
    const int begins[] = {kQuat, kScale, kLogit, kSh0, kShN, value_count};
    for (int group = 0; group < kGroups; group++)
      for (int n = begins[group] * kBlock; n < begins[group + 1] * kBlock; n += kFloats)
        move(rates_[group], load(gradients + n), values + n, first + n, second + n);
    for (int lane = 0; lane < kBlock; lane += kFloats) constrain(values + lane);
  }

 private:
  void move(float rate, Floats gradient, float* value, float* first, float* second) const {
    const Floats tiny = all(1e-30f);
    Floats mean = fma(all(static_cast<float>(kBeta1)), load(first), all(static_cast<float>(1.0 - kBeta1)) * gradient);
    Floats square = fma(all(beta2_), load(second), all(rest2_) * gradient * gradient);
    mean = keep(at_least(magnitude(mean), tiny), mean);
    square = keep(at_least(square, tiny), square);
    store(first, mean);
    store(second, square);
    const Floats size = fma(square_root(square), all(over_), all(kEpsilon));
    store(value, load(value) - all(rate) * mean / size);
  }

  static void constrain(float* values) {
    const Floats limit = all(kLogitLimit);
    float* logits = values + kLogit * kBlock;
    store(logits, smaller(larger(load(logits), all(-kLogitLimit)), limit));
    float* quats = values + kQuat * kBlock;
    Floats q[4], squared = all(0.0f);
    for (int n = 0; n < 4; n++) {
      q[n] = load(quats + n * kBlock);
      squared = fma(q[n], q[n], squared);
    }
    const Mask valid = at_least(squared, all(1e-24f));
    const Floats over = keep(valid, all(1.0f) / square_root(squared));
    for (int n = 0; n < 4; n++) store(quats + n * kBlock, select(valid, q[n] * over, all(n == 0 ? 1.0f : 0.0f)));
  }

  static constexpr double kBeta1 = 0.9;
  static constexpr float kEpsilon = 1e-15f, kLogitLimit = 14.0f;
  float beta2_ = 0.0f, rest2_ = 0.0f, over_ = 0.0f, rates_[kGroups] = {};
};

}  // namespace csplat
