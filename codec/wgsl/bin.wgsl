// SPDX-License-Identifier: Apache-2.0
// Lists the screen tiles of each splat, in the order of depth. A step takes as many blocks of 256 splats as the buffer of
// pairs holds; the host asks for further steps until all are drawn.
//
// `emit` writes exactly as many pairs as `count` found, even if a driver rounds differently in both: it leaves out what is
// too much, which touches a screen tile by a rounding error, and fills up with a record that draws nothing.

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read_write> counters: Counters;
@group(0) @binding(2) var<storage, read> order: array<u32>; // records by depth
@group(0) @binding(3) var<storage, read> ellipses: array<vec4<f32>>;
@group(0) @binding(4) var<storage, read> looks: array<vec4<u32>>;
@group(0) @binding(5) var<storage, read_write> sums: array<u32>; // pairs of each block, then place of its first pair
@group(0) @binding(6) var<storage, read_write> pair_counts: array<u32>; // by rank; WHOLE_BOX: of all screen tiles of the box
@group(0) @binding(7) var<storage, read_write> pair_keys: array<u32>; // screen tiles
@group(0) @binding(8) var<storage, read_write> pair_values: array<u32>; // records

struct Box { low: vec2<u32>, high: vec2<u32> } // screen tiles; high is past the last

struct Extent { // the ellipse in which alpha is at least ALPHA_MIN
  centre: vec2<f32>,
  box: Box,
  shear: f32, // x of the middle of a row, per y
  half_width: f32, // of the row through the centre
  over_height: f32,
  top_right: f32, // y at which x is largest
}

fn extent_of(record: u32) -> Extent {
  let look = looks[record];
  let opacity = bitcast<f32>(look.y);
  if (!(opacity > 0.0)) { return Extent(vec2<f32>(0.0), Box(vec2<u32>(0u), vec2<u32>(0u)), 0.0, 0.0, 0.0, 0.0); }
  let ellipse = ellipses[record];
  let longer2 = dot(ellipse.zw, ellipse.zw);
  let shorter2 = bitcast<f32>(look.x) * bitcast<f32>(look.x);
  let axis = ellipse.zw * inverseSqrt(longer2);
  let a = ellipse.z * ellipse.z + shorter2 * axis.y * axis.y;
  let c = ellipse.w * ellipse.w + shorter2 * axis.x * axis.x;
  let b = axis.x * axis.y * (longer2 - shorter2);
  let reach = sqrt(2.0 * log(max(opacity / ALPHA_MIN, 1.0))) * 1.0001 + 1e-3;
  let extent = reach * sqrt(vec2<f32>(a, c));
  let most = vec2<f32>(f32(view.screen_tiles_x), f32(view.screen_tiles / view.screen_tiles_x));
  let low = vec2<u32>(clamp(floor((ellipse.xy - extent) / f32(SCREEN_TILE)), vec2<f32>(0.0), most));
  let high = vec2<u32>(clamp(floor((ellipse.xy + extent) / f32(SCREEN_TILE)) + 1.0, vec2<f32>(0.0), most));
  return Extent(
    ellipse.xy, Box(low, max(low, high)), b / c, reach * sqrt(longer2 * (shorter2 / c)), 1.0 / extent.y,
    reach * b * inverseSqrt(a),
  );
}

fn row_end(e: Extent, y: f32, side: f32) -> f32 {
  let t = y * e.over_height;
  return e.centre.x + y * e.shear + side * e.half_width * sqrt(max(0.0, 1.0 - t * t));
}

fn row_of(e: Extent, row: u32) -> vec2<u32> { // first screen tile, and past the last
  let low = f32(row * SCREEN_TILE) - e.centre.y;
  let high = low + f32(SCREEN_TILE);
  let right = row_end(e, clamp(e.top_right, low, high), 1.0);
  let left = row_end(e, clamp(-e.top_right, low, high), -1.0);
  if (!(left <= right)) { return vec2<u32>(e.box.low.x, e.box.high.x); }
  let least = f32(e.box.low.x);
  let most = f32(e.box.high.x);
  let first = clamp(floor(left / f32(SCREEN_TILE)), least, most);
  return vec2<u32>(u32(first), u32(clamp(floor(right / f32(SCREEN_TILE)) + 1.0, first, most)));
}

const FEW = 64u; // screen tiles of a box that one thread goes through, row by row

fn area_of(e: Extent) -> u32 { return (e.box.high.x - e.box.low.x) * (e.box.high.y - e.box.low.y); }

const WHOLE_BOX = 0x80000000u;

fn pairs_of(e: Extent) -> u32 {
  let area = area_of(e);
  if (area > FEW) { return area | WHOLE_BOX; }
  if (e.box.high.x - e.box.low.x < 2u) { return area; }
  var sum = 0u;
  for (var row = e.box.low.y; row < e.box.high.y; row++) {
    let ends = row_of(e, row);
    sum += ends.y - ends.x;
  }
  return sum;
}

fn visible() -> u32 { return min(counters.visible, view.records); }

@compute @workgroup_size(256)
fn count(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) lane: u32) {
  let block = group.x;
  let rank = block * BLOCK + lane;
  var pairs = 0u;
  if (block >= counters.first_block && rank < visible()) {
    pairs = pairs_of(extent_of(order[rank]));
    pair_counts[rank] = pairs;
  }
  let before = sum_before(lane, pairs & ~WHOLE_BOX);
  if (lane == 255u) { sums[block] = partial[255]; }
}

var<workgroup> block_count: u32;
var<workgroup> end_of_step: atomic<u32>;
var<workgroup> pairs_of_step: atomic<u32>;

@compute @workgroup_size(256)
fn scan(@builtin(local_invocation_index) lane: u32) {
  if (lane == 0u) {
    block_count = (visible() + BLOCK - 1u) / BLOCK;
    atomicStore(&end_of_step, block_count);
    atomicStore(&pairs_of_step, 0u);
  }
  let blocks = workgroupUniformLoad(&block_count);
  let first_block = counters.first_block;
  var carry = 0u;
  for (var first = 0u; first < blocks; first += 2048u) {
    var n: array<u32, 8>;
    var sum = 0u;
    let at = first + 8u * lane;
    for (var k = 0u; k < 8u; k++) {
      n[k] = 0u;
      if (at + k < blocks) { n[k] = sums[at + k]; }
      sum = saturating(sum, n[k]);
    }
    var place = saturating(carry, sum_before(lane, sum));
    carry = saturating(carry, partial[255]);
    for (var k = 0u; k < 8u; k++) {
      if (at + k < blocks) {
        sums[at + k] = place;
        let next = saturating(place, n[k]);
        if (next > view.pairs) { atomicMin(&end_of_step, at + k); }
        else { atomicMax(&pairs_of_step, next); }
        place = next;
      }
    }
    workgroupBarrier();
  }
  if (lane == 0u) {
    counters.last_block = max(atomicLoad(&end_of_step), first_block);
    counters.pairs = atomicLoad(&pairs_of_step);
  }
}

fn put(at: u32, column: u32, row: u32, record: u32) {
  pair_keys[at] = row * view.screen_tiles_x + column;
  pair_values[at] = record;
}

fn put_nothing(at: u32) {
  pair_keys[at] = 0u;
  pair_values[at] = view.records; // the record after the last, which is empty
}

var<workgroup> large: atomic<u32>;
var<workgroup> large_count: u32;
var<workgroup> large_box: array<vec4<u32>, 256>; // low, width, record
var<workgroup> large_run: array<vec3<u32>, 256>; // first pair, pairs, screen tiles of the box

// A thread writes the pairs of its splat; those of large splats are written by all threads together.
@compute @workgroup_size(256)
fn emit(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) lane: u32) {
  if (lane == 0u) { atomicStore(&large, 0u); }
  let block = group.x;
  let rank = block * BLOCK + lane;
  var e = Extent(vec2<f32>(0.0), Box(vec2<u32>(0u), vec2<u32>(0u)), 0.0, 0.0, 0.0, 0.0);
  var record = 0u;
  var pairs = 0u;
  if (block >= counters.first_block && block < counters.last_block && rank < visible()) {
    record = order[rank];
    e = extent_of(record);
    pairs = pair_counts[rank];
  }
  let first = sums[block] + sum_before(lane, pairs & ~WHOLE_BOX);
  let width = e.box.high.x - e.box.low.x;
  if ((pairs & WHOLE_BOX) != 0u) {
    let k = atomicAdd(&large, 1u);
    large_box[k] = vec4<u32>(e.box.low, width, record);
    large_run[k] = vec3<u32>(first, pairs & ~WHOLE_BOX, area_of(e));
  } else {
    let end = first + pairs;
    var at = first;
    for (var row = e.box.low.y; row < e.box.high.y && at < end; row++) {
      var ends = vec2<u32>(e.box.low.x, e.box.high.x);
      if (width >= 2u) { ends = row_of(e, row); }
      for (var column = ends.x; column < ends.y && at < end; column++) {
        put(at, column, row, record);
        at += 1u;
      }
    }
    for (; at < end; at++) { put_nothing(at); }
  }
  workgroupBarrier();
  if (lane == 0u) { large_count = atomicLoad(&large); }
  let count = workgroupUniformLoad(&large_count);
  for (var k = 0u; k < count; k++) {
    let box = large_box[k];
    let run = large_run[k];
    for (var i = lane; i < run.y; i += 256u) {
      if (i < run.z) { put(run.x + i, box.x + i % box.z, box.y + i / box.z, box.w); } else { put_nothing(run.x + i); }
    }
  }
}
