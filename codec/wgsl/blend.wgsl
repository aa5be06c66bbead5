// SPDX-License-Identifier: Apache-2.0
// Blends a screen tile of 16 x 16 pixels front to back, in binary32: 64 threads, four pixels of a column each. Pixels go
// on from what earlier steps left. A finished pixel has its transmittance with the sign reversed.

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> ellipses: array<vec4<f32>>;
@group(0) @binding(2) var<storage, read> looks: array<vec4<u32>>;
@group(0) @binding(3) var<storage, read> records: array<u32>; // by screen tile, then by depth
@group(0) @binding(4) var<storage, read> ranges: array<vec2<u32>>;
@group(0) @binding(5) var<storage, read_write> pixels: array<vec4<f32>>; // red, green, blue, transmittance

const THREADS = 64u;
const HALF_LOG2_E = 0.8493218002880191; // the root of log2(e) / 2
const LOG2_ALPHA_MIN = -7.994353436858858;

var<workgroup> places: array<vec4<f32>, 64>; // centre from the middle of the first pixel, form of the first axis
var<workgroup> forms: array<vec4<f32>, 64>; // form of the second axis, log2 of the opacity, red
var<workgroup> colours: array<vec2<f32>, 64>; // green, blue
var<workgroup> open: atomic<u32>; // threads with pixels that are not finished
var<workgroup> open_now: u32;

fn pixel_at(i: u32, inside: bool) -> vec4<f32> {
  if (!inside) { return vec4<f32>(0.0); }
  return pixels[i];
}

@compute @workgroup_size(16, 4)
fn blend(
  @builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_id) at: vec3<u32>,
  @builtin(local_invocation_index) lane: u32,
) {
  let width = u32(view.size.x);
  let column = group.x * SCREEN_TILE + at.x;
  let rows = group.y * SCREEN_TILE + at.y + vec4<u32>(0u, 4u, 8u, 12u);
  let inside = (rows < vec4<u32>(u32(view.size.y))) & vec4<bool>(column < width);
  let range = ranges[group.y * view.screen_tiles_x + group.x];
  if (range.x == range.y) { return; } // the same for the whole workgroup
  let origin = vec2<f32>(group.xy * SCREEN_TILE) + 0.5;
  let x = f32(at.x);
  let y = f32(at.y) + vec4<f32>(0.0, 4.0, 8.0, 12.0);
  let first_pixel = rows * width + column; // of its four pixels
  let p0 = pixel_at(first_pixel.x, inside.x);
  let p1 = pixel_at(first_pixel.y, inside.y);
  let p2 = pixel_at(first_pixel.z, inside.z);
  let p3 = pixel_at(first_pixel.w, inside.w);
  var red = vec4<f32>(p0.x, p1.x, p2.x, p3.x);
  var green = vec4<f32>(p0.y, p1.y, p2.y, p3.y);
  var blue = vec4<f32>(p0.z, p1.z, p2.z, p3.z);
  var t = vec4<f32>(p0.w, p1.w, p2.w, p3.w);
  var is_open = t > vec4<f32>(0.0);
  if (lane == 0u) { atomicStore(&open, 0u); }
  for (var first = range.x; first < range.y; first += THREADS) {
    workgroupBarrier();
    if (first + lane < range.y) {
      let record = records[first + lane];
      let ellipse = ellipses[record];
      let look = looks[record];
      let longer2 = dot(ellipse.zw, ellipse.zw);
      let axis1 = ellipse.zw * (HALF_LOG2_E / longer2);
      let axis2 = vec2<f32>(-ellipse.w, ellipse.z) * (HALF_LOG2_E * inverseSqrt(longer2) / bitcast<f32>(look.x));
      let colour = unpack_colour(look.zw);
      places[lane] = vec4<f32>(ellipse.xy - origin, axis1);
      forms[lane] = vec4<f32>(axis2, log2(bitcast<f32>(look.y)), colour.x);
      colours[lane] = colour.yz;
    }
    workgroupBarrier();
    let n = min(THREADS, range.y - first);
    if (any(is_open)) {
      for (var k = 0u; k < n; k++) {
        let place = places[k];
        let form = forms[k];
        let dx = x - place.x;
        let dy = y - place.y;
        let u = dx * place.z + dy * place.w;
        let v = dx * form.x + dy * form.y;
        let e = form.z - (u * u + v * v);
        let seen = is_open & (e >= vec4<f32>(LOG2_ALPHA_MIN));
        if (!any(seen)) { continue; }
        let alpha = min(exp2(e), vec4<f32>(ALPHA_CAP));
        let after = t * (1.0 - alpha);
        let ends = seen & (after < vec4<f32>(TRANSMITTANCE_MIN));
        let adds = seen & !ends;
        let weight = select(vec4<f32>(0.0), t * alpha, adds);
        let gb = colours[k];
        red += weight * form.w;
        green += weight * gb.x;
        blue += weight * gb.y;
        t = select(t, after, adds);
        is_open = is_open & !ends;
        if (!any(is_open)) { break; }
      }
    }
    if (any(is_open)) { atomicOr(&open, 1u); }
    workgroupBarrier();
    if (lane == 0u) { open_now = atomicExchange(&open, 0u); }
    if (workgroupUniformLoad(&open_now) == 0u) { break; }
  }
  t = select(-abs(t), abs(t), is_open);
  if (inside.x) { pixels[first_pixel.x] = vec4<f32>(red.x, green.x, blue.x, t.x); }
  if (inside.y) { pixels[first_pixel.y] = vec4<f32>(red.y, green.y, blue.y, t.y); }
  if (inside.z) { pixels[first_pixel.z] = vec4<f32>(red.z, green.z, blue.z, t.z); }
  if (inside.w) { pixels[first_pixel.w] = vec4<f32>(red.w, green.w, blue.w, t.w); }
}
