// SPDX-License-Identifier: Apache-2.0
// Binning: a radix sort of the drawn splats by depth, then a stable counting sort into tiles, the order of blending.
//
// Chunks of the depth order are fixed, and each writes to a range that a prefix sum over all chunks has reserved. Each
// splat has its own run of records, a record for each of its tiles, so that gradients are gathered in a fixed order.
#include "spans.h"

namespace csplat {
namespace {

// Bits and values of a digit of the radix sort; three passes cover a float.
constexpr int kDigitBits = 11, kDigits = 1 << kDigitBits;

// Chunks of the depth order. With many tiles, counting them takes longer than sorting.
constexpr int64_t kChunks = 8, kChunksOfManyTiles = 2, kManyTiles = 1 << 16;

void scatter(int64_t count, int shift, int32_t* places, const uint32_t* keys, const int32_t* order, uint32_t* keys2,
             int32_t* order2) {
  for (int64_t n = 0; n < count; n++) {
    const int32_t place = places[(keys[n] >> shift) & (kDigits - 1)]++;
    keys2[place] = keys[n];
    order2[place] = order[n];
  }
}

// Lists the drawn splats, and reserves their records.
void list_drawn(Renderer& renderer, int64_t count, int32_t counts[3][kDigits]) {
  int64_t drawn = 0, records = 0;
  for (int64_t block = 0; block * kBlock < count; block++) {
    if (!renderer.drawn[block]) continue;
    for (int64_t i = block * kBlock; i < std::min((block + 1) * kBlock, count); i++) {
      renderer.offsets[i] = static_cast<int32_t>(records);
      if (!renderer.tile_counts[i]) continue;
      records += renderer.tile_counts[i];
      uint32_t key;
      std::memcpy(&key, &renderer.depths[i], sizeof key);  // positive floats sort like their bits
      renderer.keys[drawn] = key;
      renderer.order[drawn++] = static_cast<int32_t>(i);
      for (int digit = 0; digit < 3; digit++) counts[digit][(key >> (digit * kDigitBits)) & (kDigits - 1)]++;
    }
  }
}

// Sorts the drawn splats by depth, then by index, into `order2`.
void sort_by_depth(Renderer& renderer, int64_t count) {
  std::vector<int32_t> memory(3 * kDigits);
  auto counts = reinterpret_cast<int32_t(*)[kDigits]>(memory.data());
  list_drawn(renderer, count, counts);
  for (int digit = 0; digit < 3; digit++) {
    int32_t total = 0;
    for (int32_t& entry : *(counts + digit)) {
      const int32_t before = total;
      total += entry;
      entry = before;
    }
  }
  uint32_t *keys = renderer.keys.data(), *keys2 = renderer.keys2.data();
  int32_t *order = renderer.order.data(), *order2 = renderer.order2.data();
  const int64_t drawn = renderer.drawn_count;
  scatter(drawn, 0, counts[0], keys, order, keys2, order2);
  scatter(drawn, kDigitBits, counts[1], keys2, order2, keys, order);
  scatter(drawn, 2 * kDigitBits, counts[2], keys, order, keys2, order2);
}

}  // namespace

void bin(int64_t threads, Renderer& renderer, const View& view, int64_t count) {
  const int64_t drawn = renderer.drawn_count, tile_count = view.tile_count();
  const int tiles_x = view.tiles_x();
  renderer.offsets.reserve(count);
  renderer.keys.reserve(drawn);
  renderer.keys2.reserve(drawn);
  renderer.order.reserve(drawn);
  renderer.order2.reserve(drawn);
  renderer.pairs.reserve(renderer.pair_count);
  renderer.record_tiles.reserve(renderer.pair_count);
  renderer.starts.reserve(tile_count + 1);
  renderer.errors.reserve(tile_count);
  sort_by_depth(renderer, count);

  int32_t *tiles = renderer.record_tiles.data(), *order = renderer.order2.data();
  parallel_runs(threads, count, 16 * kBlock, [&](int64_t begin, int64_t end, int) {
    for (int64_t i = begin; i < end; i++) {
      if (!renderer.tile_counts[i]) continue;
      int32_t* to = tiles + renderer.offsets[i];
      for_each_span(renderer.splats[i], renderer.extents[i], [&](int row, int first, int last) {
        for (int column = first; column < last; column++) *to++ = row * tiles_x + column;
      });
    }
  });
  const int64_t chunks = tile_count < kManyTiles ? kChunks : kChunksOfManyTiles;
  renderer.chunk_counts.fill_zeros(chunks * tile_count);
  const auto for_each_drawn = [&](auto&& function) {  // calls function(splat, numbers of its chunk)
    parallel(threads, chunks, [&](int64_t chunk, int) {
      int32_t* places = renderer.chunk_counts.data() + chunk * tile_count;
      for (int64_t n = drawn * chunk / chunks; n < drawn * (chunk + 1) / chunks; n++) function(order[n], places);
    });
  };
  for_each_drawn([&](int32_t i, int32_t* places) {
    const int32_t* tile = tiles + renderer.offsets[i];
    for (const int32_t* end = tile + renderer.tile_counts[i]; tile < end; tile++) places[*tile]++;
  });
  int32_t total = 0;
  for (int64_t tile = 0; tile < tile_count; tile++) {
    renderer.starts[tile] = total;
    for (int64_t chunk = 0; chunk < chunks; chunk++) {
      int32_t& place = renderer.chunk_counts[chunk * tile_count + tile];
      const int32_t pairs = place;
      place = total;
      total += pairs;
    }
  }
  renderer.starts[tile_count] = total;
  for_each_drawn([&](int32_t i, int32_t* places) {
    const int32_t begin = renderer.offsets[i];
    for (int32_t record = begin; record < begin + renderer.tile_counts[i]; record++)
      renderer.pairs[places[tiles[record]]++] = {i, record};
  });
}

}  // namespace csplat
