// SPDX-License-Identifier: Apache-2.0
// The nearest entries of a codebook: of all, or of those in groups whose centres are near.
//
// |x − c|² is |x|² − s with the score s = x·2c − |c|², so the nearest entry has the highest score. All numbers are
// integers of 16 bits, and sums stay below 2**26, so every order of additions gives the same 32 bits. The lanes of a
// vector are points; each pair of coordinates of 8 entries in turn is multiplied with all of them, and scores are
// compared as soon as they are complete. Groups and entries are visited in ascending order, and only a higher score
// replaces another, so the first of several entries at the same distance is found.
#include <algorithm>
#include <cstring>
#include <limits>
#include <vector>

#include "library.h"
#include "threads.h"
#include "vectors.h"

namespace csplat {
namespace {

constexpr int kLanes = kFloats;
constexpr int kTogether = 8;                                    // entries whose scores are computed together
constexpr int64_t kRun = 4096;                                  // points that a thread takes at a time
constexpr int32_t kNone = std::numeric_limits<int32_t>::min();  // below every score

int32_t pair_at(const int16_t* row, int64_t pair) {
  int32_t both;
  std::memcpy(&both, row + 2 * pair, sizeof both);
  return both;
}

// Rows of integers, with a 0 at the end of an odd width.
struct Rows {
  int64_t count, pairs;
  std::vector<int16_t> data;     // [count + kTogether - 1, 2 · pairs], zeros at the end
  std::vector<int64_t> squares;  // [count + kTogether - 1], squared norms of the values, zeros at the end

  // Copies values [count, width], multiplied by a factor.
  Rows(const int16_t* values, int64_t count, int64_t width, int factor)
      : count(count), pairs((width + 1) / 2), data((count + kTogether - 1) * 2 * pairs), squares(count + kTogether - 1) {
    for (int64_t n = 0; n < count; n++)
      for (int64_t i = 0; i < width; i++, values++) {
        data[n * 2 * pairs + i] = static_cast<int16_t>(*values * factor);
        squares[n] += *values * *values;
      }
  }

  const int16_t* row(int64_t n) const { return data.data() + n * 2 * pairs; }

  // Gathers rows `which` [count] into lanes, [pairs, kLanes]; a lane beyond `count` repeats the last.
  void gather(const int32_t* which, int64_t count, int32_t* lanes) const {
    for (int l = 0; l < kLanes; l++) {
      const int16_t* from = row(which[std::min<int64_t>(l, count - 1)]);
      for (int64_t p = 0; p < pairs; p++) lanes[p * kLanes + l] = pair_at(from, p);
    }
  }
};

// The highest scores of the point of each lane so far, and their entries, the best first.
struct Best {
  std::vector<Ints> scores, entries;

  explicit Best(int64_t kept) : scores(kept, all(kNone)), entries(kept, all(-1)) {}

  void add(Ints score, Ints entry) {
    for (size_t k = scores.size() - 1; k > 0; k--) {
      const Mask before = above(score, scores[k - 1]), here = above(score, scores[k]);
      scores[k] = select(before, scores[k - 1], select(here, score, scores[k]));
      entries[k] = select(before, entries[k - 1], select(here, entry, entries[k]));
    }
    const Mask first = above(score, scores[0]);
    scores[0] = select(first, score, scores[0]);
    entries[0] = select(first, entry, entries[0]);
  }
};

// Compares the points in `lanes` with the entries `begin` to `end`, except the entries `own` [kLanes] of the points.
void compare(const Rows& entries, int64_t begin, int64_t end, const int32_t* lanes, const int32_t* own, Best& best) {
  for (; begin < end; begin += kTogether) {
    const int64_t count = std::min<int64_t>(end - begin, kTogether), width = 2 * entries.pairs;
    int32_t scores[kTogether][kLanes];
    {
      Ints sums[kTogether];  // in registers, because the bounds of loops over them are constant
      for (int e = 0; e < kTogether; e++) sums[e] = all(static_cast<int32_t>(-entries.squares[begin + e]));
      const int16_t* row = entries.row(begin);
      for (int64_t p = 0; p < entries.pairs; p++) {
        const Ints x = load(lanes + p * kLanes);
        for (int e = 0; e < kTogether; e++) sums[e] = add_products(sums[e], x, all(pair_at(row + e * width, p)));
      }
      for (int e = 0; e < kTogether; e++) store(scores[e], sums[e]);
    }
    for (int64_t e = 0; e < count; e++) {
      const Ints entry = all(static_cast<int32_t>(begin + e)), score = load(scores[e]);
      best.add(own ? select(equal(load(own), entry), all(kNone), score) : score, entry);
    }
  }
}

struct Codebook {
  Rows entries, centres;  // twice their values
  const int64_t* ends;    // [groups + 1], the entries of each group
  int64_t groups, near;

  // Returns the points of each group, for all points among whose `near` nearest it is, and where they begin.
  std::vector<int32_t> group_points(const Rows& points, std::vector<int64_t>& begins) const {
    std::vector<int32_t> chosen(points.count * near), which(kLanes), lanes(points.pairs * kLanes);
    for (int64_t first = 0; centres.count && first < points.count; first += kLanes) {
      const int64_t count = std::min<int64_t>(points.count - first, kLanes);
      for (int l = 0; l < kLanes; l++) which[l] = static_cast<int32_t>(first + l);
      points.gather(which.data(), count, lanes.data());
      Best best(near);
      compare(centres, 0, groups, lanes.data(), nullptr, best);
      for (int64_t k = 0; k < near; k++) {
        int32_t group[kLanes];
        store(group, best.entries[k]);
        for (int64_t l = 0; l < count; l++) chosen[(first + l) * near + k] = group[l];
      }
    }
    begins.assign(groups + 1, 0);
    for (const int32_t group : chosen) begins[group + 1]++;
    for (int64_t group = 0; group < groups; group++) begins[group + 1] += begins[group];
    std::vector<int64_t> next(begins);
    std::vector<int32_t> grouped(chosen.size());
    for (size_t n = 0; n < chosen.size(); n++) grouped[next[chosen[n]]++] = static_cast<int32_t>(n / near);
    return grouped;
  }

  // Replaces the entries `found` so far, −1 for none, by the nearest; `own` may be null.
  void search(const Rows& points, const int32_t* own, int32_t* found, double* squared) const {
    std::vector<int64_t> begins;
    const std::vector<int32_t> grouped = group_points(points, begins);
    std::vector<int32_t> score(points.count, kNone), lanes(points.pairs * kLanes);
    for (int64_t n = 0; n < points.count; n++)
      if (found[n] >= 0) {
        const int16_t *x = points.row(n), *c = entries.row(found[n]);
        score[n] = static_cast<int32_t>(-entries.squares[found[n]]);
        for (int64_t i = 0; i < 2 * points.pairs; i++) score[n] += x[i] * c[i];
      }
    Best best(1);
    for (int64_t group = 0; group < groups; group++)
      for (int64_t at = begins[group]; at < begins[group + 1]; at += kLanes) {
        const int32_t* which = &grouped[at];
        const int64_t count = std::min<int64_t>(begins[group + 1] - at, kLanes);
        int32_t scores[kLanes], places[kLanes], owns[kLanes];
        for (int64_t l = 0; l < kLanes; l++) {
          const int32_t n = which[std::min(l, count - 1)];
          scores[l] = score[n], places[l] = found[n], owns[l] = own ? own[n] : -1;
        }
        best.scores[0] = load(scores), best.entries[0] = load(places);
        points.gather(which, count, lanes.data());
        compare(entries, ends[group], ends[group + 1], lanes.data(), own ? owns : nullptr, best);
        store(scores, best.scores[0]), store(places, best.entries[0]);
        for (int64_t l = 0; l < count; l++) score[which[l]] = scores[l], found[which[l]] = places[l];
      }
    for (int64_t n = 0; n < points.count; n++) {
      squared[n] = std::numeric_limits<double>::infinity();
      if (found[n] >= 0) squared[n] = static_cast<double>(points.squares[n] - score[n]);
    }
  }
};

}  // namespace
}  // namespace csplat

using namespace csplat;

// Finds the nearest entry of each point, the first of several at the same distance.
//
// points: [n, width]; entries: [ends[groups], width], group by group, of which the entries from ends[g] to ends[g + 1]
// are group g; centres: [groups, width]. The groups with the `near` nearest centres are searched, 0 < near <= groups;
// with one group, centres may be null. For every point and entry, the product of their norms and half of the entry's
// squared norm are together below 2**23.
// found: [n], an entry near each point, which only a nearer one replaces, or −1; then the entries found, −1 if there
// are none. own: [n], entries not to be found, or null. squared: [n], squared distances, infinite without an entry.
CSPLAT_API int64_t csplat_nearest_entries(int64_t threads, const int16_t* points, int64_t n, int64_t width,
                                          const int16_t* entries, const int64_t* ends, const int16_t* centres,
                                          int64_t groups, int64_t near, const int32_t* own, int32_t* found,
                                          double* squared) {
  return guarded([&]() -> int64_t {
    const Codebook codebook{Rows(entries, ends[groups], width, 2), Rows(centres, centres ? groups : 0, width, 2), ends,
                            groups, near};
    parallel_runs(threads, n, kRun, [&](int64_t begin, int64_t end, int) {
      const Rows run(points + begin * width, end - begin, width, 1);
      codebook.search(run, own ? own + begin : nullptr, found + begin, squared + begin);
    });
    return 0;
  });
}
