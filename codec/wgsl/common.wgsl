// SPDX-License-Identifier: Apache-2.0
// Shared by all passes: what the host sets for a picture, what the GPU counts, and the constants of the renderer.

struct View {
  // World to camera, row by row. Translations are in the places of the tiles, which the host computes in binary64.
  row0: vec4<f32>,
  row1: vec4<f32>,
  row2: vec4<f32>,
  focal: vec4<f32>, // fx fy cx cy, pixels, of this band of the picture
  slopes: vec4<f32>, // bounds of x/z (x y) and y/z (z w) within which the perspective is linearised
  size: vec2<f32>, // pixels of the band
  near: f32,
  first_key: u32, // the depth slice: keys of this pass, both included
  last_key: u32,
  screen_tiles_x: u32,
  screen_tiles: u32,
  records: u32, // the most records that the buffers hold
  pairs: u32, // the same of pairs
  blocks: u32, // blocks of splats of all pages
  block_table: u32, // row of the table of tiles at which the tiles of blocks begin
  tile_table: u32, // the same of the constants of tiles; places come first
  depth_shift: u32, // bits of a key that `count_depths` leaves out
  sh_degree: u32, // the highest that is shown
}

struct Counters {
  visible: u32, // splats in view in this depth slice; more than `records` if they do not fit
  pairs: u32, // of splat and screen tile, in this step
  first_block: u32, // of 256 depth ranks, the first of this step
  last_block: u32, // past the last of this step
}

const ALPHA_MIN = 0.00392156862745098;
const ALPHA_CAP = 0.99;
const TRANSMITTANCE_MIN = 1e-4;
const DILATION = 0.3;
const COMPENSATION_MIN = 0.000025;

const BLOCK = 256u; // splats of a workgroup, all of one tile
const SCREEN_TILE = 16u; // pixels, width and height

// Colours of records: three floats of 21 bits, without signs, an exponent of 8 bits and a mantissa of 13.
fn pack_colour(colour: vec3<f32>) -> vec2<u32> {
  let n = (bitcast<vec3<u32>>(colour) + 512u) >> vec3<u32>(10u);
  return vec2<u32>(n.x | (n.y << 21u), (n.y >> 11u) | (n.z << 10u));
}

fn unpack_colour(n: vec2<u32>) -> vec3<f32> {
  let green = (n.x >> 21u) | ((n.y & 0x3ffu) << 11u);
  return bitcast<vec3<f32>>(vec3<u32>(n.x & 0x1fffffu, green, n.y >> 10u) << vec3<u32>(10u));
}
