// SPDX-License-Identifier: Apache-2.0
// Squared error of two images in the range 0 to 1 before a background, summed over runs of 4,096 pixels: of all pixels,
// of the covered pixels of the first image (csplat_render/metrics.py), and the number of these.

struct Backdrop { colour: vec4<f32>, pixels: u32, unused0: u32, unused1: u32, unused2: u32 }

@group(0) @binding(0) var<uniform> backdrop: Backdrop;
@group(0) @binding(1) var<storage, read> first: array<vec4<f32>>;
@group(0) @binding(2) var<storage, read> second: array<vec4<f32>>;
@group(0) @binding(3) var<storage, read_write> sums: array<vec4<f32>>;

const COVERED_ALPHA = 0.5;

var<workgroup> partial: array<vec4<f32>, 256>;

fn colour_of(pixel: vec4<f32>) -> vec3<f32> {
  return clamp(pixel.rgb + abs(pixel.w) * backdrop.colour.rgb, vec3<f32>(0.0), vec3<f32>(1.0));
}

@compute @workgroup_size(256)
fn difference(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) lane: u32) {
  var sum = vec4<f32>(0.0);
  for (var r = 0u; r < 16u; r++) {
    let i = group.x * 4096u + r * 256u + lane;
    if (i >= backdrop.pixels) { break; }
    let error = colour_of(first[i]) - colour_of(second[i]);
    let squared = dot(error, error);
    let covered = select(0.0, 1.0, 1.0 - abs(first[i].w) >= COVERED_ALPHA);
    sum += vec4<f32>(squared, squared * covered, covered, 0.0);
  }
  partial[lane] = sum;
  workgroupBarrier();
  for (var reach = 128u; reach > 0u; reach >>= 1u) {
    if (lane < reach) { partial[lane] += partial[lane + reach]; }
    workgroupBarrier();
  }
  if (lane == 0u) { sums[group.x] = partial[0]; }
}
