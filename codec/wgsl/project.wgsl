// SPDX-License-Identifier: Apache-2.0
// Projects the splats in view of a page, as csplat_render/projection.py does: a record of 32 bytes and a depth key each.

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<uniform> page: Page;
@group(0) @binding(2) var<storage, read> tiles: array<vec4<u32>>;
@group(0) @binding(3) var<storage, read> words: array<u32>;
@group(0) @binding(4) var<storage, read> rows: array<u32>; // indices and rows of coefficients of the page's tiles
@group(0) @binding(5) var<storage, read> tables: array<u32>; // codebooks
@group(0) @binding(6) var<storage, read> blocks: array<u32>; // for each block: place of the first record, 8 words of bits
@group(0) @binding(7) var<storage, read_write> ellipses: array<vec4<f32>>; // centre, the longer half-axis; pixels
@group(0) @binding(8) var<storage, read_write> looks: array<vec4<u32>>; // shorter half-axis, opacity (0: not drawn), colour
@group(0) @binding(9) var<storage, read_write> keys: array<u32>;

const PIXELS_MAX = 1e8; // the longest standard deviation on the picture, so that fourth powers stay finite

fn axes_of(quat: vec4<f32>) -> mat3x3<f32> { // columns: axes of the splat
  let u = normalize(quat / max(max(abs(quat.x), abs(quat.y)), max(abs(quat.z), abs(quat.w))));
  let w = u.x; let x = u.y; let y = u.z; let z = u.w;
  return mat3x3<f32>(
    1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y),
    2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + w * x),
    2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y));
}

// Rows of SH coefficients: r g b of each in turn, fields of equal width that do not cross words.
var<private> row_word: u32;
var<private> row_bits: u32;
var<private> row_held: u32;
var<private> row_fields: u32; // that are left of the word
var<private> row_offset: f32;
var<private> row_step: f32;
var<private> row_is_table: bool;

fn open_row(word: u32, bits: u32, offset: f32, step: f32, is_table: bool) {
  row_word = word;
  row_bits = bits;
  row_fields = 0u;
  row_offset = offset;
  row_step = step;
  row_is_table = is_table;
}

fn coefficient() -> f32 {
  if (row_fields == 0u) {
    if (row_is_table) { row_held = tables[row_word]; } else { row_held = rows[row_word]; }
    row_word += 1u;
    row_fields = 32u / row_bits;
  }
  row_fields -= 1u;
  if (row_bits == 32u) { return bitcast<f32>(row_held); }
  let n = row_held & ((1u << row_bits) - 1u);
  row_held = row_held >> row_bits;
  return (f32(n) + row_offset) * row_step;
}

fn coefficients() -> vec3<f32> {
  let r = coefficient();
  let g = coefficient();
  return vec3<f32>(r, g, coefficient());
}

fn row_words(columns: u32, bits: u32) -> u32 {
  let fields = 32u / bits;
  return (columns + fields - 1u) / fields;
}

fn open_band(tile: Tile, local: u32, band: u32) -> bool { // false: the tile has none
  let head = tiles[tile.row + 2u + 2u * band]; // kind and bits, index, table, rows
  let more = tiles[tile.row + 3u + 2u * band]; // offset of the table, of the rows, step, entries of the table
  let kind = head.x & 3u;
  if (kind == BAND_NONE) { return false; }
  let columns = 3u * (2u * band + 1u);
  let bits = (head.x >> 16u) & 63u;
  var at = local;
  if (kind == BAND_CODEBOOK) {
    let index_bits = (head.x >> 2u) & 63u;
    let fields = 32u / index_bits;
    let index = extractBits(rows[head.y + local / fields], index_bits * (local % fields), index_bits);
    if (index < more.w) {
      let table_bits = (head.x >> 8u) & 63u;
      open_row(head.z + index * row_words(columns, table_bits), table_bits, bitcast<f32>(more.x), bitcast<f32>(more.z), true);
      return true;
    }
    at = index - more.w;
  }
  open_row(head.w + at * row_words(columns, bits), bits, bitcast<f32>(more.y), bitcast<f32>(more.z), false);
  return true;
}

fn colour_of(tile: Tile, local: u32, sh0: vec3<f32>, d: vec3<f32>) -> vec3<f32> {
  var sum = 0.5 + 0.28209479177387814 * sh0;
  let degree = min(tile.degree, view.sh_degree);
  let s = d * d;
  if (degree >= 1u && open_band(tile, local, 1u)) {
    sum += -0.4886025119029199 * d.y * coefficients();
    sum += 0.4886025119029199 * d.z * coefficients();
    sum += -0.4886025119029199 * d.x * coefficients();
  }
  if (degree >= 2u && open_band(tile, local, 2u)) {
    sum += 1.0925484305920792 * d.x * d.y * coefficients();
    sum += -1.0925484305920792 * d.y * d.z * coefficients();
    sum += 0.31539156525252005 * (2.0 * s.z - s.x - s.y) * coefficients();
    sum += -1.0925484305920792 * d.x * d.z * coefficients();
    sum += 0.5462742152960396 * (s.x - s.y) * coefficients();
  }
  if (degree >= 3u && open_band(tile, local, 3u)) {
    sum += -0.5900435899266435 * d.y * (3.0 * s.x - s.y) * coefficients();
    sum += 2.890611442640554 * d.x * d.y * d.z * coefficients();
    sum += -0.4570457994644658 * d.y * (4.0 * s.z - s.x - s.y) * coefficients();
    sum += 0.3731763325901154 * d.z * (2.0 * s.z - 3.0 * s.x - 3.0 * s.y) * coefficients();
    sum += -0.4570457994644658 * d.x * (4.0 * s.z - s.x - s.y) * coefficients();
    sum += 1.445305721320277 * d.z * (s.x - s.y) * coefficients();
    sum += -0.5900435899266435 * d.x * (s.x - 3.0 * s.y) * coefficients();
  }
  if (degree >= 4u && open_band(tile, local, 4u)) {
    sum += 2.5033429417967046 * d.x * d.y * (s.x - s.y) * coefficients();
    sum += -1.7701307697799304 * d.y * d.z * (3.0 * s.x - s.y) * coefficients();
    sum += 0.9461746957575601 * d.x * d.y * (7.0 * s.z - 1.0) * coefficients();
    sum += -0.6690465435572892 * d.y * d.z * (7.0 * s.z - 3.0) * coefficients();
    sum += 0.10578554691520431 * (s.z * (35.0 * s.z - 30.0) + 3.0) * coefficients();
    sum += -0.6690465435572892 * d.x * d.z * (7.0 * s.z - 3.0) * coefficients();
    sum += 0.47308734787878004 * (s.x - s.y) * (7.0 * s.z - 1.0) * coefficients();
    sum += -1.7701307697799304 * d.x * d.z * (s.x - 3.0 * s.y) * coefficients();
    sum += 0.6258357354491761 * (s.x * (s.x - 3.0 * s.y) - s.y * (3.0 * s.x - s.y)) * coefficients();
  }
  return clamp(sum, vec3<f32>(0.0), vec3<f32>(1e30));
}

@compute @workgroup_size(256)
fn project(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) lane: u32) {
  let block = page.first_block + group.x;
  let bits = blocks[9u * block + 1u + (lane >> 5u)];
  if ((bits & (1u << (lane & 31u))) == 0u) { return; }
  var at = blocks[9u * block] + countOneBits(bits & ((1u << (lane & 31u)) - 1u));
  for (var w = 0u; w < (lane >> 5u); w++) { at += countOneBits(blocks[9u * block + 1u + w]); }
  if (at >= view.records) { return; }

  let index = tile_of_block(block);
  let tile = read_tile(index);
  open_splat(tile, block, lane);
  let p = read_centre(tile, index);
  var opacity = read_opacity(tile);
  let log_scales = read_log_scales(tile);
  let axes = axes_of(read_quat(tile));
  let sh0 = read_sh0(tile);
  keys[at] = bitcast<u32>(p.z);
  looks[at] = vec4<u32>(0u);

  // The ellipse without dilation: variances, covariance, and the determinant as a sum of squares, which is accurate for
  // long and thin splats.
  let over = 1.0 / p.z;
  let j = view.focal.xy * over;
  let slope = clamp(p.xy * over, view.slopes.xz, view.slopes.yw);
  let jz = -j * slope;
  let s = min(vec3<f32>(deviation(log_scales.x), deviation(log_scales.y), deviation(log_scales.z)),
              vec3<f32>(PIXELS_MAX / max(j.x, j.y)));
  let along_x = view.row0.xyz * axes;
  let along_y = view.row1.xyz * axes;
  let along_z = view.row2.xyz * axes;
  let u = s * (j.x * along_x + jz.x * along_z);
  let v = s * (j.y * along_y + jz.y * along_z);
  let w = (j.x * s.yzx) * (j.y * s.zxy) * (slope.x * along_x + slope.y * along_y + along_z);
  let bare_a = dot(u, u);
  let bare_c = dot(v, v);
  let b = dot(u, v);
  let bare = dot(w, w);
  let a = bare_a + DILATION;
  let c = bare_c + DILATION;
  let determinant = bare + DILATION * (bare_a + bare_c) + DILATION * DILATION;
  if ((tile.flags & ANTIALIASED) != 0u) { opacity *= sqrt(max(bare / determinant, COMPENSATION_MIN)); }
  let spread = 0.5 * (a - c);
  let radius = sqrt(spread * spread + b * b);
  let longer = 0.5 * (a + c) + radius;
  let shorter = determinant / longer;
  var axis = select(vec2<f32>(b, radius - spread), vec2<f32>(spread + radius, b), spread >= 0.0);
  axis = select(vec2<f32>(1.0, 0.0), normalize(axis / max(max(abs(axis.x), abs(axis.y)), 1e-30)), radius > 0.0);
  let centre = view.focal.xy * (p.xy * over) + view.focal.zw;
  let reach = sqrt(2.0 * log(max(opacity / ALPHA_MIN, 1.0)) * vec2<f32>(a, c)) + 0.5;
  if (!(opacity >= ALPHA_MIN && all(centre + reach > vec2<f32>(0.0)) && all(centre - reach < view.size))) { return; }
  ellipses[at] = vec4<f32>(centre, axis * sqrt(longer));

  let d = p.x * view.row0.xyz + p.y * view.row1.xyz + p.z * view.row2.xyz;
  let direction = normalize(d / max(max(abs(d.x), abs(d.y)), abs(d.z)));
  let local = (block - tile.first_block) * BLOCK + lane;
  let colour = pack_colour(colour_of(tile, local, sh0, direction));
  looks[at] = vec4<u32>(bitcast<u32>(sqrt(shorter)), bitcast<u32>(opacity), colour);
}
