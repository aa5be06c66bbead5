// SPDX-License-Identifier: Apache-2.0
// Shows blended pixels before a background, which may be transparent, as a triangle that covers the target. Colours are
// premultiplied by alpha.

struct Backdrop { colour: vec4<f32>, width: u32, first_row: u32, unused0: u32, unused1: u32 }

@group(0) @binding(0) var<uniform> backdrop: Backdrop;
@group(0) @binding(1) var<storage, read> pixels: array<vec4<f32>>; // of this band, from screen tiles
@group(0) @binding(2) var quads: texture_2d<f32>;

@vertex
fn cover(@builtin(vertex_index) corner: u32) -> @builtin(position) vec4<f32> {
  return vec4<f32>(select(-1.0, 3.0, corner == 1u), select(-1.0, 3.0, corner == 2u), 0.0, 1.0);
}

fn before_backdrop(colour: vec3<f32>, transmittance: f32) -> vec4<f32> {
  let sum = vec4<f32>(colour, 1.0 - transmittance) + transmittance * backdrop.colour;
  return vec4<f32>(clamp(sum.rgb, vec3<f32>(0.0), vec3<f32>(sum.a)), sum.a);
}

@fragment
fn present(@builtin(position) at: vec4<f32>) -> @location(0) vec4<f32> {
  let pixel = pixels[(u32(at.y) - backdrop.first_row) * backdrop.width + u32(at.x)];
  return before_backdrop(pixel.rgb, abs(pixel.w));
}

@fragment
fn present_quads(@builtin(position) at: vec4<f32>) -> @location(0) vec4<f32> {
  let pixel = textureLoad(quads, vec2<u32>(at.xy), 0);
  return before_backdrop(pixel.rgb, 1.0 - pixel.a);
}
