// The C interface: a render, gradients, and a step of a refit, one view at a time.
#include <algorithm>
#include <chrono>
#include <exception>
#include <memory>

#include "engine.h"

namespace csplat {
namespace {

// Copies values from blocks to rows of the caller, [N, values].
void to_rows(const Engine& engine, const Array<float>& blocks, float* rows) {
  for (int i = 0; i < engine.count; i++)
    for (int k = 0; k < engine.value_count; k++)
      rows[static_cast<size_t>(engine.sources[i]) * engine.value_count + k] =
          blocks[(static_cast<size_t>(i / kBlock) * engine.value_count + k) * kBlock + i % kBlock];
}

// Calls pass(), and adds its wall time to a phase.
template <typename Function>
void time_phase(Engine& engine, Phase phase, Function&& pass) {
  const auto begin = std::chrono::steady_clock::now();
  pass();
  engine.seconds[phase] += std::chrono::duration<double>(std::chrono::steady_clock::now() - begin).count();
}

}  // namespace
}  // namespace csplat

using namespace csplat;

extern "C" {

// Creates a refit of `count` splats. Each row of `rows` has the mean (3), quaternion (4, wxyz), log scales (3), logit,
// sh0 (3), and shN (K, 3) of a splat. Returns null if there is not enough memory, or for another degree than 0 to 3.
//
// `order` has the indices of neighbouring splats next to each other, such as those of a Morton order.
Engine* csplat_refit_new(int count, int degree, const float* rows, const int32_t* order, int threads) {
  if (degree < 0 || degree > kHighestDegree || count < 0 || threads < 1) return nullptr;
  try {
    auto engine = std::make_unique<Engine>(threads);
    engine->count = count;
    engine->degree = degree;
    engine->higher = (degree + 1) * (degree + 1) - 1;
    engine->value_count = kShN + 3 * engine->higher;
    engine->block_count = (count + kBlock - 1) / kBlock;
    const size_t places = static_cast<size_t>(engine->block_count) * kBlock;
    for (Array<float>* values : {&engine->values, &engine->first, &engine->second})
      values->fill_zeros(places * engine->value_count);
    engine->splats.fill_zeros(places);
    engine->extents.fill_zeros(places);
    engine->depths.fill_zeros(places);
    engine->drawn.fill_zeros(engine->block_count);
    for (Array<int32_t>* array : {&engine->tile_counts, &engine->offsets, &engine->sources, &engine->order,
                                  &engine->order2})
      array->fill_zeros(places);
    engine->keys.reserve(places);
    engine->keys2.reserve(places);
    std::copy(order, order + count, engine->sources.data());
    for (int i = 0; i < count; i++)
      for (int k = 0; k < engine->value_count; k++)
        engine->values[(static_cast<size_t>(i / kBlock) * engine->value_count + k) * kBlock + i % kBlock] =
            rows[static_cast<size_t>(engine->sources[i]) * engine->value_count + k];
    return engine.release();
  } catch (const std::exception&) {
    return nullptr;
  }
}

void csplat_refit_free(Engine* engine) { delete engine; }

void csplat_refit_read(const Engine* engine, float* rows) { to_rows(*engine, engine->values, rows); }

// Renders a view, and returns its squared error, 0 without a reference.
//
// view: [24], as `view_vector` of csplat_render.conventions; background: [3]; reference: [H, W, 3], or null.
// rgb: [H, W, 3], the image, or null. gradients: rows of the gradients of half the squared error, or null.
// rates: learning rates of quats, scales, logits, sh0 and shN, and beta2, to make a step of Adam; or null.
double csplat_refit_view(Engine* engine, const double* view, int width, int height, const float* background,
                         const float* reference, float* rgb, float* gradients, const float* rates) {
  const int tiles_x = (width + kTile - 1) / kTile, tile_count = tiles_x * ((height + kTile - 1) / kTile);
  const Image image = {width, height, tiles_x, tile_count, view, background, reference, rgb, 1.0 / 255.0, 1e-4f};
  engine->starts.reserve(static_cast<size_t>(tile_count) + 1);
  engine->errors.reserve(tile_count);
  if (gradients) engine->gradients.reserve(static_cast<size_t>(engine->block_count) * kBlock * engine->value_count);
  time_phase(*engine, kProjection, [&] { project(*engine, image); });
  time_phase(*engine, kBinning, [&] { bin(*engine, image); });
  time_phase(*engine, kBlending, [&] { blend(*engine, image, gradients || rates); });
  if (gradients || rates)
    time_phase(*engine, kProjectionBackward, [&] { project_backward(*engine, image, rates, gradients); });
  if (gradients) to_rows(*engine, engine->gradients, gradients);
  double error = 0.0;
  for (int tile = 0; tile < image.tile_count; tile++) error += engine->errors[tile];
  return error;
}

// Writes the seconds of wall time in each phase since the last call, [4], and the numbers of drawn splats and of pairs
// of splat and tile in the last view, [2].
void csplat_refit_measurements(Engine* engine, double* seconds, int64_t* counts) {
  std::copy(engine->seconds, engine->seconds + kPhases, seconds);
  std::fill(engine->seconds, engine->seconds + kPhases, 0.0);
  counts[0] = engine->drawn_count;
  counts[1] = engine->pair_count;
}
}
