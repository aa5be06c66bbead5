// SPDX-License-Identifier: Apache-2.0
// The place of each block's first record, in place of the number of its splats in view.

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read_write> counters: Counters;
@group(0) @binding(2) var<storage, read_write> blocks: array<u32>;

@compute @workgroup_size(256)
fn compact(@builtin(local_invocation_index) lane: u32) {
  var carry = 0u;
  for (var first = 0u; first < view.blocks; first += 2048u) {
    var counts: array<u32, 8>;
    var sum = 0u;
    let at = first + 8u * lane;
    for (var k = 0u; k < 8u; k++) {
      counts[k] = 0u;
      if (at + k < view.blocks) { counts[k] = blocks[9u * (at + k)]; }
      sum += counts[k];
    }
    var place = carry + sum_before(lane, sum);
    carry += partial[255];
    for (var k = 0u; k < 8u; k++) {
      if (at + k < view.blocks) { blocks[9u * (at + k)] = place; }
      place += counts[k];
    }
  }
  if (lane == 0u) { counters.visible = carry; }
}
