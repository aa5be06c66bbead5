// SPDX-License-Identifier: Apache-2.0
// The nearest neighbours of points in space.
//
// A balanced k-d tree: each node halves its points along the longest side of their box, by coordinate and then by row,
// until at most 16 are left. The neighbours of a point are ordered by (squared distance, difference of rows, row). A
// node is left out if (squared distance of its box, least difference of its rows) does not come before the last of the
// neighbours found so far, which is exact because each rounding is monotonic. The rows also tell points at one place
// apart: a search visits few of them.
#include <algorithm>
#include <cmath>
#include <limits>
#include <vector>

#include "library.h"
#include "threads.h"
#include "vectors.h"

namespace csplat {
namespace {

constexpr int64_t kLeaf = 16;  // most points of a leaf
constexpr int64_t kRun = 32;   // leaves that a thread takes at once

struct Point { double at[4]; };  // coordinates and row
struct Box { double low[4], high[4]; };

// A point, or the least that a point of a box can be, in the order of neighbours.
struct Candidate {
  double squared;
  int64_t rank;  // twice the difference of rows, plus 1 for a higher row; 0 is the point itself
  bool operator<(const Candidate& other) const {
    return squared < other.squared || (squared == other.squared && rank < other.rank);
  }
};

// The tree of a group of points, in memory of the caller. Node n of a level has the points from begin(level, n).
struct Tree {
  double* points;  // [4 · count], in the order of leaves; within a leaf x, y, z and row of all points
  Box* boxes;      // level by level
  int64_t count, depth;

  Tree(double* points, Box* boxes, int64_t count) : points(points), boxes(boxes), count(count), depth(0) {
    while (begin(depth, 1) + 1 > kLeaf) depth++;
  }

  int64_t begin(int64_t level, int64_t node) const { return count * node >> level; }
  Box& box(int64_t level, int64_t node) const { return boxes[(int64_t(1) << level) - 1 + node]; }

  void build(int64_t threads) {
    for (int64_t level = 0; level <= depth; level++)
      parallel(threads, int64_t(1) << level, [&](int64_t node, int) { split(level, node); });
  }

  void split(int64_t level, int64_t node) {
    Point* const all_points = reinterpret_cast<Point*>(points);
    Point *first = all_points + begin(level, node), *last = all_points + begin(level, node + 1);
    Doubles low = load(first->at), high = low;
    for (const Point* point = first + 1; point < last; point++) {
      low = smaller(low, load(point->at));
      high = larger(high, load(point->at));
    }
    Box& bounds = box(level, node);
    store(bounds.low, low);
    store(bounds.high, high);
    if (level == depth) {
      Point leaf[kLeaf];
      std::copy(first, last, leaf);
      for (int64_t n = 0; n < last - first; n++)
        for (int64_t axis = 0; axis < 4; axis++)
          points[4 * begin(level, node) + axis * (last - first) + n] = leaf[n].at[axis];
      return;
    }
    double sides[4];
    store(sides, high - low);
    const int64_t axis = std::max_element(sides, sides + 3) - sides;
    std::nth_element(first, all_points + begin(level + 1, 2 * node + 1), last, [axis](const Point& a, const Point& b) {
      return a.at[axis] < b.at[axis] || (a.at[axis] == b.at[axis] && a.at[3] < b.at[3]);
    });
  }
};

// A search for the `wanted` nearest neighbours of a point, which keeps the candidates sorted.
struct Search {
  const Tree& tree;
  double at[4];
  Candidate *found, *last;  // the candidates, in order

  Candidate least(int64_t level, int64_t node) const {
    const Box& box = tree.box(level, node);
    const Doubles point = load(at);
    double outside[4];
    store(outside, larger(larger(load(box.low) - point, point - load(box.high)), all(0.0)));
    return {outside[0] * outside[0] + outside[1] * outside[1] + outside[2] * outside[2],
            2 * static_cast<int64_t>(outside[3])};
  }

  void visit(int64_t level, int64_t node) {
    if (level == tree.depth) return scan(node);
    int64_t nearer = 2 * node;
    Candidate near = least(level + 1, nearer), far = least(level + 1, nearer + 1);
    if (far < near) std::swap(near, far), nearer++;
    if (near < *last) visit(level + 1, nearer);
    if (far < *last) visit(level + 1, nearer ^ 1);
  }

  void scan(int64_t leaf) const {
    const int64_t begin = tree.begin(tree.depth, leaf), count = tree.begin(tree.depth, leaf + 1) - begin;
    const double *x = tree.points + 4 * begin, *y = x + count, *z = y + count, *rows = z + count;
    double squared[kLeaf];
    for (int64_t n = 0; n < count; n++) {
      const double a = x[n] - at[0], b = y[n] - at[1], c = z[n] - at[2];
      squared[n] = a * a + b * b + c * c;
    }
    for (int64_t n = 0; n < count; n++)
      if (squared[n] <= last->squared && rows[n] != at[3]) {
        const int64_t apart = static_cast<int64_t>(rows[n] - at[3]);
        const Candidate candidate{squared[n], apart > 0 ? 2 * apart + 1 : -2 * apart};
        if (!(candidate < *last)) continue;
        Candidate* place = last;
        for (; place > found && candidate < place[-1]; place--) *place = place[-1];
        *place = candidate;
      }
  }
};

void search(const Tree& tree, int64_t threads, int64_t wanted, int64_t* neighbours, double* distances) {
  const Candidate none{std::numeric_limits<double>::infinity(), std::numeric_limits<int64_t>::max()};
  parallel_runs(threads, int64_t(1) << tree.depth, kRun, [&](int64_t first, int64_t last, int) {
    std::vector<Candidate> found(wanted);
    for (int64_t leaf = first; leaf < last; leaf++) {
      const int64_t begin = tree.begin(tree.depth, leaf), count = tree.begin(tree.depth, leaf + 1) - begin;
      for (int64_t n = 0; n < count; n++) {
        const double* from = tree.points + 4 * begin + n;
        std::fill(found.begin(), found.end(), none);
        Search{tree, {from[0], from[count], from[2 * count], from[3 * count]}, found.data(), &found.back()}.visit(0, 0);
        const int64_t row = static_cast<int64_t>(from[3 * count]);
        for (int64_t k = 0; k < wanted; k++) {
          const int64_t rank = found[k].rank, apart = rank & 1 ? rank / 2 : -(rank / 2);
          neighbours[row * wanted + k] = rank == none.rank ? -1 : row + apart;
          distances[row * wanted + k] = std::sqrt(found[k].squared);
        }
      }
    }
  });
}

}  // namespace
}  // namespace csplat

using namespace csplat;

// Finds the `wanted` >= 1 nearest other points of each point within its group.
//
// points: [n, 3], finite; sizes: [groups], at least 1, the number of points of each group, in the order of points;
// neighbours: [n, wanted], rows of points, the nearest first, −1 after the last; distances: [n, wanted], then infinite.
CSPLAT_API int64_t csplat_nearest_neighbours(int64_t threads, const double* points, const int64_t* sizes,
                                             int64_t groups, int64_t wanted, int64_t* neighbours, double* distances) {
  return guarded([&]() -> int64_t {
    std::vector<int64_t> begins(groups + 1, 0);
    for (int64_t group = 0; group < groups; group++) begins[group + 1] = begins[group] + sizes[group];
    std::vector<double> copies(4 * begins[groups]);
    std::vector<Box> boxes(begins[groups] / 4 + groups);  // a leaf has at least 8 points, or is the only node
    const int64_t within = groups < threads ? threads : 1;
    parallel(threads / within, groups, [&](int64_t group, int) {
      const int64_t begin = begins[group], end = begins[group + 1];
      for (int64_t row = begin; row < end; row++) {
        std::copy_n(points + 3 * row, 3, copies.data() + 4 * row);
        copies[4 * row + 3] = static_cast<double>(row);
      }
      Tree tree(copies.data() + 4 * begin, boxes.data() + begin / 4 + group, end - begin);
      tree.build(within);
      search(tree, within, wanted, neighbours, distances);
    });
    return 0;
  });
}
