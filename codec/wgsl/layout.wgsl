// SPDX-License-Identifier: Apache-2.0
// Reads splats from the packed layout, which `csplat_render.gpu.packing` describes and writes.

const TILE_ROWS = 12u;
const BAND_NONE = 0u;
const BAND_CODEBOOK = 2u;
const OPACITY_SQUARED = 0x1000000u;
const ANTIALIASED = 0x2000000u;

struct Page { first_block: u32, unused0: u32, unused1: u32, unused2: u32 }

struct Tile {
  word: u32, // of the page, where the geometry begins
  words: u32, // of a splat
  first_block: u32, // of all pages
  splats: u32,
  flags: u32,
  mean_bits: vec3<u32>,
  opacity_bits: u32,
  scale_bits: u32,
  quat_bits: u32,
  sh0_bits: u32,
  degree: u32,
  opacity_levels: f32,
  quat_levels: i32,
  row: u32, // of the table, where the tile's constants begin
}

fn tile_of_block(block: u32) -> u32 {
  return tiles[view.block_table + (block >> 2u)][block & 3u];
}

fn read_tile(index: u32) -> Tile {
  let row = view.tile_table + TILE_ROWS * index;
  let place = tiles[row];
  let bits = tiles[row + 1u];
  return Tile(
    place.x, place.y, place.z, place.w & 0xffffffu, place.w & 0xff000000u,
    vec3<u32>(bits.x & 255u, (bits.x >> 8u) & 255u, (bits.x >> 16u) & 255u), bits.x >> 24u,
    bits.y & 255u, (bits.y >> 8u) & 255u, (bits.y >> 16u) & 255u, bits.y >> 24u,
    f32(bits.z), i32(bits.w), row,
  );
}

// A splat's string of bits: word k of a block's 256 splats is a run of 256 words.
var<private> next_word: u32;
var<private> held: u32;
var<private> held_bits: u32;

fn open_splat(tile: Tile, block: u32, lane: u32) {
  next_word = tile.word + (block - tile.first_block) * BLOCK * tile.words + lane;
  held_bits = 0u;
  held = 0u;
}

fn field(bits: u32) -> u32 { // 1 to 32 bits
  var value = held;
  if (held_bits < bits) {
    let word = words[next_word];
    next_word += BLOCK;
    value |= word << held_bits;
    let used = bits - held_bits;
    held = select(word >> (used & 31u), 0u, used == 32u);
    held_bits = 32u - used;
  } else {
    held = held >> bits; // bits is at most held_bits, which is below 32
    held_bits -= bits;
  }
  return select(value & ((1u << (bits & 31u)) - 1u), value, bits == 32u);
}

fn number(bits: u32) -> f32 { // an integer, or a binary32 pattern
  let value = field(bits);
  return select(f32(value), bitcast<f32>(value), bits == 32u);
}

fn values(bits: u32, lattice: vec4<f32>) -> vec3<f32> { // offset + integer * step, or patterns
  let a = number(bits);
  let b = number(bits);
  let c = number(bits);
  return select(lattice.xyz + vec3<f32>(a, b, c) * lattice.w, vec3<f32>(a, b, c), bits == 32u);
}

// The first three fields: the centre in camera coordinates.
fn read_centre(tile: Tile, index: u32) -> vec3<f32> {
  let place = bitcast<vec4<f32>>(tiles[index]); // the tile's corner in camera coordinates, and its step
  let x = number(tile.mean_bits.x);
  let y = number(tile.mean_bits.y);
  let n = vec3<f32>(x, y, number(tile.mean_bits.z)) * place.w;
  return place.xyz + vec3<f32>(dot(view.row0.xyz, n), dot(view.row1.xyz, n), dot(view.row2.xyz, n));
}

fn read_opacity(tile: Tile) -> f32 {
  var opacity = number(tile.opacity_bits);
  if (tile.opacity_bits != 32u) {
    opacity /= tile.opacity_levels;
    if ((tile.flags & OPACITY_SQUARED) != 0u) { opacity *= opacity; }
  }
  let hidden = f32(tile.flags >> 26u) / 8.0; // of a tile that fades, see `fadedAlpha` in codec/js/levels/shown_tiles.mjs
  return opacity * (1.0 - hidden) * (1.0 + 0.34 * opacity * hidden);
}

fn read_log_scales(tile: Tile) -> vec3<f32> {
  return values(tile.scale_bits, bitcast<vec4<f32>>(tiles[tile.row + 2u]));
}

fn read_quat(tile: Tile) -> vec4<f32> { // w x y z, of any length
  if (tile.quat_bits == 32u) {
    let w = number(32u);
    let x = number(32u);
    let y = number(32u);
    return vec4<f32>(w, x, y, number(32u));
  }
  let x = i32(field(tile.quat_bits)) - tile.quat_levels;
  let y = i32(field(tile.quat_bits)) - tile.quat_levels;
  let z = i32(field(tile.quat_bits)) - tile.quat_levels;
  let rest = 2 * tile.quat_levels * tile.quat_levels - x * x - y * y - z * z;
  return vec4<f32>(sqrt(f32(max(rest, 0))), f32(x), f32(y), f32(z));
}

fn read_sh0(tile: Tile) -> vec3<f32> {
  return values(tile.sh0_bits, bitcast<vec4<f32>>(tiles[tile.row + 3u]));
}

// Whether a splat may be seen: a bound by its longest axis, from fields at the beginning of its bits.
fn is_in_reach(centre: vec3<f32>, opacity: f32, log_scales: vec3<f32>) -> bool {
  if (!(centre.z > view.near && opacity >= ALPHA_MIN)) { return false; }
  let key = bitcast<u32>(centre.z);
  if (key < view.first_key || key > view.last_key) { return false; }
  let over = 1.0 / centre.z;
  let pixel = view.focal.xy * (centre.xy * over) + view.focal.zw;
  let slope = clamp(centre.xy * over, view.slopes.xz, view.slopes.yw);
  let longest = view.focal.xy * over * deviation(max(log_scales.x, max(log_scales.y, log_scales.z))) * sqrt(1.0 + slope * slope);
  let reach = sqrt(2.0 * log(max(opacity / ALPHA_MIN, 1.0)) * (min(longest * longest, vec2<f32>(1e30)) + DILATION)) + 1.0;
  return all(pixel + reach > vec2<f32>(0.0)) && all(pixel - reach < view.size);
}

fn deviation(log_scale: f32) -> f32 {
  return exp(clamp(log_scale, -60.0, 60.0));
}
