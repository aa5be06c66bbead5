// Binning: a radix sort of the drawn splats by depth, then a stable counting sort into tiles, the order of blending.
//
// Chunks of the depth order are fixed, and each writes to a range that a prefix sum over all chunks has reserved. Each
// splat has its own run of records, a record for each of its tiles, so that gradients are gathered in a fixed order.
#include <algorithm>

#include "binning.h"

namespace csplat {
namespace {

// Bits and values of a digit of the radix sort; three passes cover a float.
constexpr int kDigitBits = 11, kDigits = 1 << kDigitBits;
constexpr int kChunks = 8;

void scatter(int64_t count, int shift, int32_t* places, const uint32_t* keys, const int32_t* order, uint32_t* keys2,
             int32_t* order2) {
  for (int64_t n = 0; n < count; n++) {
    const int32_t place = places[(keys[n] >> shift) & (kDigits - 1)]++;
    keys2[place] = keys[n];
    order2[place] = order[n];
  }
}

// Lists the drawn splats, and reserves their records.
void list_drawn(Engine& engine, int32_t counts[3][kDigits]) {
  int64_t drawn = 0, records = 0;
  for (int block = 0; block < engine.block_count; block++) {
    if (!engine.drawn[block]) continue;
    for (int i = block * kBlock; i < (block + 1) * kBlock; i++) {
      engine.offsets[i] = static_cast<int32_t>(records);
      if (!engine.tile_counts[i]) continue;
      records += engine.tile_counts[i];
      uint32_t key;
      std::memcpy(&key, &engine.depths[i], sizeof key);  // positive floats sort like their bits
      engine.keys[drawn] = key;
      engine.order[drawn++] = i;
      for (int digit = 0; digit < 3; digit++) counts[digit][(key >> (digit * kDigitBits)) & (kDigits - 1)]++;
    }
  }
  engine.drawn_count = drawn;
  engine.pair_count = records;
}

// Sorts splats of equal depth by the caller's index.
void sort_ties(Engine& engine) {
  int32_t* order = engine.order2.data();
  for (int64_t begin = 0, n = 1; n <= engine.drawn_count; n++) {
    if (n < engine.drawn_count && engine.keys2[n] == engine.keys2[begin]) continue;
    if (n - begin > 1)
      std::sort(order + begin, order + n, [&](int32_t a, int32_t b) { return engine.sources[a] < engine.sources[b]; });
    begin = n;
  }
}

}  // namespace

void bin(Engine& engine, const Image& image) {
  static thread_local int32_t counts[3][kDigits];
  std::memset(counts, 0, sizeof counts);
  list_drawn(engine, counts);
  for (auto& digit : counts) {
    int32_t total = 0;
    for (int32_t& count : digit) {
      const int32_t before = total;
      total += count;
      count = before;
    }
  }
  uint32_t *keys = engine.keys.data(), *keys2 = engine.keys2.data();
  int32_t *order = engine.order.data(), *order2 = engine.order2.data();
  const int64_t drawn = engine.drawn_count;
  scatter(drawn, 0, counts[0], keys, order, keys2, order2);
  scatter(drawn, kDigitBits, counts[1], keys2, order2, keys, order);
  scatter(drawn, 2 * kDigitBits, counts[2], keys, order, keys2, order2);
  sort_ties(engine);

  engine.pairs.reserve(engine.pair_count);
  engine.records.reserve(engine.pair_count);
  engine.record_tiles.reserve(engine.pair_count);
  int32_t* tiles = engine.record_tiles.data();
  for_each_block(engine, [&](int block) {
    for (int i = block * kBlock; engine.drawn[block] && i < (block + 1) * kBlock; i++) {
      if (!engine.tile_counts[i]) continue;
      int32_t* to = tiles + engine.offsets[i];
      for_each_span(engine.splats[i], engine.extents[i], [&](int row, int first, int last) {
        for (int column = first; column < last; column++) *to++ = row * image.tiles_x + column;
      });
    }
  });
  const auto chunk_begin = [drawn](int64_t chunk) { return drawn * chunk / kChunks; };
  engine.chunk_counts.fill_zeros(static_cast<size_t>(kChunks) * image.tile_count);
  engine.threads.run(kChunks, [&](int64_t chunk, int) {
    int32_t* places = engine.chunk_counts.data() + chunk * image.tile_count;
    for (int64_t n = chunk_begin(chunk); n < chunk_begin(chunk + 1); n++) {
      const int32_t* tile = tiles + engine.offsets[order2[n]];
      for (const int32_t* end = tile + engine.tile_counts[order2[n]]; tile < end; tile++) places[*tile]++;
    }
  });
  int32_t total = 0;
  for (int tile = 0; tile < image.tile_count; tile++) {
    engine.starts[tile] = total;
    for (int chunk = 0; chunk < kChunks; chunk++) {
      int32_t& place = engine.chunk_counts[static_cast<size_t>(chunk) * image.tile_count + tile];
      const int32_t count = place;
      place = total;
      total += count;
    }
  }
  engine.starts[image.tile_count] = total;
  engine.threads.run(kChunks, [&](int64_t chunk, int) {
    int32_t* places = engine.chunk_counts.data() + chunk * image.tile_count;
    for (int64_t n = chunk_begin(chunk); n < chunk_begin(chunk + 1); n++) {
      const int32_t i = order2[n], begin = engine.offsets[i];
      for (int32_t record = begin; record < begin + engine.tile_counts[i]; record++)
        engine.pairs[places[tiles[record]]++] = {i, record};
    }
  });
}

}  // namespace csplat
