// SPDX-License-Identifier: Apache-2.0
// Where each screen tile begins and ends among the sorted pairs.

@group(0) @binding(0) var<storage, read> counters: Counters;
@group(0) @binding(1) var<storage, read> keys: array<u32>;
@group(0) @binding(2) var<storage, read_write> ranges: array<u32>; // first, and past the last; cleared before

@compute @workgroup_size(256)
fn find(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) lane: u32) {
  let n = counters.pairs;
  for (var r = 0u; r < 16u; r++) {
    let i = group.x * 4096u + r * 256u + lane;
    if (i >= n) { break; }
    let tile = keys[i];
    if (i == 0u || keys[i - 1u] != tile) { ranges[2u * tile] = i; }
    if (i + 1u == n || keys[i + 1u] != tile) { ranges[2u * tile + 1u] = i + 1u; }
  }
}
