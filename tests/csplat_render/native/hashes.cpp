// SPDX-License-Identifier: Apache-2.0
// Prints hashes of what the renderer computes for made splats: images, gradients, pruning errors, sensitivities, and
// the values after 50 steps of a refit, once for each of 1, 2 and 8 threads. All lines must be equal, on every
// processor.
//
// Compile with the sources of the library.
#include <cmath>
#include <cstdio>
#include <vector>

#include "renderer.h"

using namespace csplat;

CSPLAT_API Renderer* csplat_new_renderer();
CSPLAT_API int64_t csplat_project(int64_t, Renderer*, const Splats*, const View*, float*, int64_t*);
CSPLAT_API int64_t csplat_render(int64_t, Renderer*, const View*, int64_t, float*, float*, float*, float*);
CSPLAT_API int64_t csplat_gradients(int64_t, Renderer*, const Splats*, const View*, const float*, const float*,
                                    const float*, float*, float*, float*, float*, float*, float*, float*);
CSPLAT_API int64_t csplat_measure_pruning(int64_t, Renderer*, const View*, int64_t, float*, double*, uint8_t*);
CSPLAT_API int64_t csplat_add_derivatives(int64_t, Renderer*, const Splats*, const View*, double*, float*, double*,
                                          double*, double*, float*, double*, int64_t*);
CSPLAT_API int64_t csplat_step(int64_t, Renderer*, const Splats*, const View*, const float*, const float*, const Step*,
                               double*);
CSPLAT_API int64_t csplat_photometric_loss(int64_t, const float*, const float*, int64_t, int64_t, double, double,
                                           float*, double*);

namespace {

constexpr int64_t kCount = 3001, kDegree = 4, kCoefficients = 24, kWidth = 123, kHeight = 90;
constexpr int64_t kPixels = kWidth * kHeight, kTriangle = 25 * 26 / 2;

using FloatArray = std::vector<float>;
using DoubleArray = std::vector<double>;

uint32_t state;

// Returns a number from low to high, exact in float.
float random(float low, float high) {
  state = state * 1664525u + 1013904223u;
  return low + (high - low) * (static_cast<float>(state >> 8) * 0x1p-24f);
}

FloatArray random_array(int64_t size, float low, float high) {
  FloatArray array(size);
  for (float& value : array) value = random(low, high);
  return array;
}

uint64_t hash;

template <typename T>
void add(const std::vector<T>& values) {
  const auto* bytes = reinterpret_cast<const unsigned char*>(values.data());
  for (size_t n = 0; n < values.size() * sizeof(T); n++) hash = (hash ^ bytes[n]) * 0x100000001B3u;
}

void report(const char* name) {
  std::printf(" %s %016llx", name, static_cast<unsigned long long>(hash));
  hash = 0xCBF29CE484222325u;
}

struct Scene {
  FloatArray means = random_array(3 * kCount, -2.0f, 2.0f), quats = random_array(4 * kCount, -1.0f, 1.0f);
  FloatArray scales = random_array(3 * kCount, -5.0f, -1.0f), opacities = random_array(kCount, 0.0f, 1.0f);
  FloatArray sh0 = random_array(3 * kCount, -1.0f, 1.5f), shN = random_array(72 * kCount, -0.3f, 0.3f);

  Splats splats(int64_t logits) const {
    return {kCount, kDegree, kCoefficients, logits, means.data(), quats.data(), scales.data(), opacities.data(),
            sh0.data(), shN.data()};
  }
};

View view_from(double angle) {
  View view = {};
  const double c = std::sqrt(1.0 - angle * angle), s = angle, distance = 5.0;
  const double camera[24] = {c, 0, s, 0, 1, 0, -s, 0, c, 0.1, -0.2, distance, 110, 105, 0.5 * kWidth, 0.5 * kHeight,
                             0.2, -0.7, 0.7, -0.6, 0.6, s * distance, 0.2, -c * distance};
  std::copy(camera, camera + 24, view.camera);
  view.alpha_min = 1.0 / 255.0;
  view.transmittance_min = 1e-4;
  for (int n = 0; n < 3; n++) view.background[n] = 0.25 * n;
  view.width = kWidth;
  view.height = kHeight;
  return view;
}

void run(int64_t threads) {
  state = 1;
  hash = 0xCBF29CE484222325u;
  Renderer* renderer = csplat_new_renderer();
  Scene scene;
  FloatArray rgb(3 * kPixels), transmittance(kPixels), depth(kPixels), radii(kCount);
  for (int64_t antialiased = 0; antialiased < 2; antialiased++) {
    View view = view_from(0.25);
    view.antialiased = antialiased;
    const Splats splats = scene.splats(0);
    csplat_project(threads, renderer, &splats, &view, radii.data(), nullptr);
    csplat_render(threads, renderer, &view, kCount, nullptr, rgb.data(), transmittance.data(), depth.data());
    add(rgb);
    add(transmittance);
    add(depth);
    add(radii);
    report("image");
    const FloatArray slopes = random_array(3 * kPixels, -1.0f, 1.0f), alpha = random_array(kPixels, -1.0f, 1.0f);
    FloatArray g[7];
    const int64_t widths[7] = {3, 4, 3, 1, 3, 72, 1};
    for (int n = 0; n < 7; n++) g[n].resize(widths[n] * kCount);
    csplat_gradients(threads, renderer, &splats, &view, slopes.data(), alpha.data(), alpha.data(), g[0].data(),
                     g[1].data(), g[2].data(), g[3].data(), g[4].data(), g[5].data(), g[6].data());
    for (const FloatArray& array : g) add(array);
    report("gradients");
    DoubleArray errors(kCount), forms(12 * kCount), net(7 * kCount), sizes(7 * kCount), squares(3 * kCount);
    DoubleArray shapes(21 * kCount);
    FloatArray colour(75 * kCount), metric(kTriangle * kCount);
    std::vector<uint8_t> seen(kCount);
    std::vector<int64_t> views(kCount);
    csplat_project(threads, renderer, &splats, &view, nullptr, nullptr);
    csplat_measure_pruning(threads, renderer, &view, kCount, rgb.data(), errors.data(), seen.data());
    add(errors);
    report("pruning");
    csplat_project(threads, renderer, &splats, &view, nullptr, nullptr);
    csplat_add_derivatives(threads, renderer, &splats, &view, forms.data(), colour.data(), net.data(), sizes.data(),
                           squares.data(), metric.data(), shapes.data(), views.data());
    for (const DoubleArray& array : {net, sizes, squares, shapes}) add(array);
    add(colour);
    add(metric);
    report("sensitivity");
  }
  const FloatArray reference = random_array(3 * kPixels, 0.0f, 1.0f);
  FloatArray* arrays[6] = {&scene.means, &scene.quats, &scene.scales, &scene.opacities, &scene.sh0, &scene.shN};
  FloatArray first[6], second[6], slopes(3 * kPixels), norms(kCount);
  for (int n = 0; n < 6; n++) {
    first[n].resize(arrays[n]->size());
    second[n].resize(arrays[n]->size());
  }
  const Splats splats = scene.splats(1);
  double power1 = 1.0, power2 = 1.0, error = 0.0, sums[3] = {};
  for (int number = 0; number < 50; number++) {
    power1 *= 0.9;
    power2 *= 0.98;
    Step step = {};
    for (int n = 0; n < 6; n++)
      step.groups[n] = {arrays[n]->data(), first[n].data(), second[n].data(), 0.01 / (1.0 - power1)};
    step.over_root = 1.0 / std::sqrt(1.0 - power2);
    step.beta2 = 0.98;
    step.opacity_weight = step.scale_weight = number % 3 * 0.001;
    step.means2d = norms.data();
    const View view = view_from(0.01 * number - 0.25);
    csplat_project(threads, renderer, &splats, &view, nullptr, nullptr);
    if (number % 2) {
      csplat_step(threads, renderer, &splats, &view, reference.data(), nullptr, &step, &error);
    } else {
      csplat_render(threads, renderer, &view, kCount, nullptr, rgb.data(), transmittance.data(), depth.data());
      csplat_photometric_loss(threads, rgb.data(), reference.data(), kHeight, kWidth, 1e-4, -1e-4, slopes.data(), sums);
      csplat_step(threads, renderer, &splats, &view, nullptr, slopes.data(), &step, &error);
    }
    add(DoubleArray(sums, sums + 3));
  }
  for (const FloatArray* array : arrays) add(*array);
  add(norms);
  report("steps");
  std::printf("\n");
}

}  // namespace

int main() {
  for (const int64_t threads : {1, 2, 8}) run(threads);
}
