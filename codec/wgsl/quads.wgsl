// SPDX-License-Identifier: Apache-2.0
// Draws records as quads into half floats, farthest first, so that what is drawn later dims earlier rounding errors, too.

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> counters: Counters;
@group(0) @binding(2) var<storage, read> order: array<u32>; // records by depth
@group(0) @binding(3) var<storage, read> ellipses: array<vec4<f32>>;
@group(0) @binding(4) var<storage, read> looks: array<vec4<u32>>;

const COLOUR_MAX = 60000.0; // half floats end at 65,504

struct Corner {
  @builtin(position) position: vec4<f32>,
  @location(0) @interpolate(flat) centre: vec2<f32>, // pixels
  @location(1) @interpolate(flat) axes: vec4<f32>, // of the ellipse, over the squares of their lengths
  @location(2) @interpolate(flat) colour: vec4<f32>, // and the opacity
}

@vertex
fn corner(@builtin(vertex_index) vertex: u32, @builtin(instance_index) instance: u32) -> Corner {
  let record = order[min(counters.visible, view.records) - 1u - instance];
  let ellipse = ellipses[record];
  let look = looks[record];
  let opacity = bitcast<f32>(look.y);
  if (!(opacity > 0.0)) { return Corner(vec4<f32>(2.0, 2.0, 2.0, 1.0), vec2<f32>(0.0), vec4<f32>(0.0), vec4<f32>(0.0)); }
  let longer = length(ellipse.zw);
  let shorter = bitcast<f32>(look.x);
  let axis = ellipse.zw / longer;
  let across = vec2<f32>(-axis.y, axis.x);
  // Nothing is drawn beyond the farthest corner of the picture, so that quads stay small enough to be clipped exactly.
  let farthest = length(abs(ellipse.xy - 0.5 * view.size) + 0.5 * view.size);
  let reach = sqrt(2.0 * log(max(opacity / ALPHA_MIN, 1.0))) * 1.0001 + 1e-3;
  let half_axes = min(reach * vec2<f32>(longer, shorter), vec2<f32>(farthest));
  let side = vec2<f32>(f32(vertex & 1u), f32(vertex >> 1u)) * 2.0 - 1.0;
  let pixel = ellipse.xy + side.x * half_axes.x * axis + side.y * half_axes.y * across;
  let position = vec4<f32>(2.0 * pixel.x / view.size.x - 1.0, 1.0 - 2.0 * pixel.y / view.size.y, 0.0, 1.0);
  let colour = min(unpack_colour(look.zw), vec3<f32>(COLOUR_MAX));
  return Corner(position, ellipse.xy, vec4<f32>(axis / longer, across / shorter), vec4<f32>(colour, opacity));
}

@fragment
fn splat(at: Corner) -> @location(0) vec4<f32> {
  let d = at.position.xy - at.centre;
  let u = dot(d, at.axes.xy);
  let v = dot(d, at.axes.zw);
  let alpha = min(at.colour.a * exp(-0.5 * (u * u + v * v)), ALPHA_CAP);
  if (!(alpha >= ALPHA_MIN)) { discard; }
  return vec4<f32>(at.colour.rgb * alpha, alpha);
}
