// SPDX-License-Identifier: Apache-2.0
// Which splats of a page are in view: a bit each, and their number in each block. A scan of the numbers then gives every
// block its place among the records, so that the order of records never depends on timing.

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<uniform> page: Page;
@group(0) @binding(2) var<storage, read> tiles: array<vec4<u32>>;
@group(0) @binding(3) var<storage, read> words: array<u32>;
@group(0) @binding(4) var<storage, read_write> blocks: array<u32>; // for each block: number of splats in view, 8 words of bits
@group(0) @binding(5) var<storage, read_write> depths: array<atomic<u32>>; // splats in view by the upper bits of their keys

var<workgroup> bits: array<atomic<u32>, 8>;

fn centre_in_reach(block: u32, lane: u32) -> vec4<f32> { // centre, and 1 if in reach
  let index = tile_of_block(block);
  let tile = read_tile(index);
  if ((block - tile.first_block) * BLOCK + lane >= tile.splats) { return vec4<f32>(0.0); }
  open_splat(tile, block, lane);
  let centre = read_centre(tile, index);
  let opacity = read_opacity(tile);
  return vec4<f32>(centre, select(0.0, 1.0, is_in_reach(centre, opacity, read_log_scales(tile))));
}

@compute @workgroup_size(256)
fn cull(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) lane: u32) {
  let block = page.first_block + group.x;
  if (lane < 8u) { atomicStore(&bits[lane], 0u); } // not every driver clears workgroup memory
  workgroupBarrier();
  if (centre_in_reach(block, lane).w > 0.0) { atomicOr(&bits[lane >> 5u], 1u << (lane & 31u)); }
  workgroupBarrier();
  if (lane < 8u) { blocks[9u * block + 1u + lane] = atomicLoad(&bits[lane]); }
  if (lane == 8u) {
    var sum = 0u;
    for (var w = 0u; w < 8u; w++) { sum += countOneBits(atomicLoad(&bits[w])); }
    blocks[9u * block] = sum;
  }
}

@compute @workgroup_size(256)
fn count_depths(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) lane: u32) {
  let found = centre_in_reach(page.first_block + group.x, lane);
  if (found.w > 0.0) { atomicAdd(&depths[(bitcast<u32>(found.z) - view.first_key) >> view.depth_shift], 1u); }
}
