// SPDX-License-Identifier: Apache-2.0
// Numbers of workgroups of the passes that follow, from what has been counted; and the way from one step to the next.
// `groups` holds x y z of the sort of records, of blocks of ranks and of the sort of pairs, then what a draw of quads takes.

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read_write> counters: Counters;
@group(0) @binding(2) var<storage, read_write> groups: array<u32>;

fn set_groups(at: u32, count: u32) {
  groups[3u * at] = count;
  groups[3u * at + 1u] = 1u;
  groups[3u * at + 2u] = 1u;
}

@compute @workgroup_size(1)
fn after_compact() {
  let visible = min(counters.visible, view.records);
  set_groups(0u, (visible + 4095u) / 4096u);
  set_groups(1u, (visible + 255u) / 256u);
  groups[9] = 4u; // vertices
  groups[10] = visible; // instances
  groups[11] = 0u; // the first of each
  groups[12] = 0u;
  counters.first_block = 0u;
  counters.last_block = 0u;
}

@compute @workgroup_size(1)
fn after_scan() {
  set_groups(2u, (counters.pairs + 4095u) / 4096u);
}

@compute @workgroup_size(1)
fn next_step() {
  counters.first_block = counters.last_block;
}

@group(0) @binding(3) var<storage, read_write> pixels: array<vec4<f32>>;

@compute @workgroup_size(256)
fn clear_pixels(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) counts: vec3<u32>, @builtin(local_invocation_index) lane: u32) {
  let i = (group.y * counts.x + group.x) * 256u + lane;
  if (i < u32(view.size.x) * u32(view.size.y)) { pixels[i] = vec4<f32>(0.0, 0.0, 0.0, 1.0); }
}
