// SPDX-License-Identifier: Apache-2.0
// The shaders. A fragment pass projects the splats in order, one per pixel, into records; quads are drawn from the records.

import { FADE_EXCESS, FADE_STEPS } from '../../codec/js/levels/shown_tiles.mjs';
import { BLOCK_SPLATS } from './texels.mjs';
import { COLOUR, FADE_SHIFT, READ_BANDS, READ_GEOMETRY, RECORD_COLUMNS } from './shader_attributes.mjs';

const HEAD = `#version 300 es
precision highp float;
precision highp int;
precision highp usampler2D;
precision highp sampler2D;
`;

/** One triangle that covers the target. */
export const COVER_VERTEX = `${HEAD}
void main() {
  gl_Position = vec4(gl_VertexID == 1 ? 3.0 : -1.0, gl_VertexID == 2 ? 3.0 : -1.0, 0.0, 1.0);
}`;

/** Projects one splat per record; follows csplat_render/projection.py, in single precision. */
export const PROJECT_FRAGMENT = `${HEAD}
${READ_GEOMETRY}
${READ_BANDS}
${COLOUR}
uniform usampler2D uOrder;
uniform uint uBegin; // position of the first record in the order
uniform uint uEnd;
uniform mat3 uRotation; // world to camera
uniform vec4 uFocal; // fx fy cx cy
uniform vec4 uSlopes; // limits of x/z, y/z
uniform vec2 uSize; // pixels of the picture
uniform float uNear;
uniform float uOpacityLevels;
uniform bool uOpacitySquare;
uniform int uQuatLevels;
uniform bool uAntialiased;

layout(location = 0) out uvec4 oPlace; // centre x y, the longer half-axis x y (pixels, one standard deviation)
layout(location = 1) out uvec4 oLook; // the shorter half-axis, opacity, colour in halves

const float LOG_SCALE_LIMIT = 60.0;
const float PIXELS_MAX = 1e8; // maximum standard deviation on the picture, so that fourth powers stay finite

// Columns: axes of the splat.
mat3 axesOf(vec3 n) {
  ivec3 q = ivec3(n) - uQuatLevels;
  int rest = 2 * uQuatLevels * uQuatLevels - q.x * q.x - q.y * q.y - q.z * q.z; // at most 2^31 − 1
  vec4 u = normalize(vec4(sqrt(float(max(rest, 0))), vec3(q)));
  float w = u.x, x = u.y, y = u.z, z = u.w;
  return mat3(
    1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y),
    2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + w * x),
    2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y));
}

// The projected ellipse without dilation: variances and covariance, and the determinant as a sum of squares, which is
// accurate for long and thin splats.
vec4 ellipseOf(vec3 p, vec3 logScales, mat3 axes) {
  vec2 slope = clamp(p.xy / p.z, uSlopes.xz, uSlopes.yw);
  vec2 j = uFocal.xy / p.z;
  vec2 jz = -j * slope;
  vec3 s = min(exp(clamp(logScales, -LOG_SCALE_LIMIT, LOG_SCALE_LIMIT)), PIXELS_MAX / max(j.x, j.y));
  mat3 r = uRotation * axes;
  vec3 alongX = vec3(r[0].x, r[1].x, r[2].x), alongY = vec3(r[0].y, r[1].y, r[2].y), alongZ = vec3(r[0].z, r[1].z, r[2].z);
  vec3 u = s * (j.x * alongX + jz.x * alongZ);
  vec3 v = s * (j.y * alongY + jz.y * alongZ);
  vec3 w = (j.x * s.yzx) * (j.y * s.zxy) * (slope.x * alongX + slope.y * alongY + alongZ);
  return vec4(dot(u, u), dot(u, v), dot(v, v), dot(w, w));
}

void main() {
  oPlace = uvec4(0u);
  oLook = uvec4(0u);
  uint i = uBegin + uint(gl_FragCoord.y) * ${RECORD_COLUMNS}u + uint(gl_FragCoord.x);
  if (i >= uEnd) return;
  uint slot = texelFetch(uOrder, place(i), 0).x;
  uint tile = texelFetch(uBlocks, place(slot / ${BLOCK_SPLATS}u), 0).x;
  uint row = tile * uTileTexels;
  uvec4 layout0 = texelFetch(uTiles, place(row), 0); // bits, bits, texel of the store, number of words | first slot
  uvec4 scaleLattice = texelFetch(uTiles, place(row + 1u), 0);
  uvec4 colourLattice = texelFetch(uTiles, place(row + 2u), 0);
  vec4 corner = texelFetch(uPlaces, place(tile), 0);
  uint local = slot - (layout0.w >> 4) * ${BLOCK_SPLATS}u;
  gFirst = texelFetch(uFirst, place(slot), 0);
  gWord = 0u;
  gMore = 4u * layout0.z + local * (layout0.w & 15u);
  gBuffer = 0u;
  gBuffered = 0u;

  float nx = float(field(layout0.x & 31u));
  float ny = float(field((layout0.x >> 5) & 31u));
  float nz = float(field((layout0.x >> 10) & 31u));
  vec3 p = corner.xyz + uRotation * (vec3(nx, ny, nz) * corner.w);
  if (!(p.z > uNear)) return;
  float opacity = float(field((layout0.x >> 20) & 31u)) / uOpacityLevels;
  if (uOpacitySquare) opacity *= opacity;
  float hidden = float(layout0.x >> ${FADE_SHIFT}) / ${FADE_STEPS}.0; // of a tile that fades, see fadedAlpha
  opacity *= (1.0 - hidden) * (1.0 + ${FADE_EXCESS} * opacity * hidden);
  if (!(opacity >= ${1 / 255})) return;
  vec3 logScales = values(layout0.y & 63u, scaleLattice);
  vec3 quat = field3((layout0.x >> 15) & 31u);

  vec4 e = ellipseOf(p, logScales, axesOf(quat));
  float a = e.x + 0.3, b = e.y, c = e.z + 0.3;
  float determinant = e.w + 0.3 * (e.x + e.z) + 0.09;
  if (uAntialiased) opacity *= sqrt(max(e.w / determinant, 0.000025));
  vec2 centre = uFocal.xy * (p.xy / p.z) + uFocal.zw;
  float spread = 0.5 * (a - c);
  float radius = sqrt(spread * spread + b * b);
  float longer = 0.5 * (a + c) + radius; // variances along the axes of the ellipse
  float shorter = determinant / longer;
  vec2 axis = spread >= 0.0 ? vec2(spread + radius, b) : vec2(b, radius - spread);
  axis = radius > 0.0 ? normalize(axis / max(abs(axis.x), abs(axis.y))) : vec2(1.0, 0.0);
  vec2 reach = sqrt(2.0 * log(max(255.0 * opacity, 1.0))) * sqrt(vec2(a, c)) + 0.5;
  bool isSeen = opacity >= ${1 / 255} && all(greaterThan(centre + reach, vec2(0.0))) && all(lessThan(centre - reach, uSize));
  if (!isSeen) return; // also for NaN and infinity

  vec3 d = transpose(uRotation) * p;
  d /= max(max(abs(d.x), abs(d.y)), abs(d.z));
  uint shBits = (layout0.y >> 8) & 63u;
  vec3 colour = colourOf(tile, local, values(shBits, colourLattice), normalize(d));
  oPlace = floatBitsToUint(vec4(centre, axis * sqrt(longer)));
  oLook = uvec4(floatBitsToUint(vec2(sqrt(shorter), opacity)), packHalf2x16(colour.rg), packHalf2x16(vec2(colour.b, 0.0)));
}`;

/** A quad around the ellipse in which a splat's alpha is at least 1/255. An instance is a row of records. */
export const SPLAT_VERTEX = `${HEAD}
uniform usampler2D uRecordPlace;
uniform usampler2D uRecordLook;
uniform vec2 uSize;
out vec2 vLocal; // in standard deviations
out vec4 vColour;

void main() {
  ivec2 at = ivec2(gl_VertexID >> 2, gl_InstanceID);
  uvec4 look = texelFetch(uRecordLook, at, 0);
  float opacity = uintBitsToFloat(look.y);
  vLocal = vec2(0.0);
  vColour = vec4(0.0);
  gl_Position = vec4(2.0, 2.0, 2.0, 1.0);
  if (opacity <= 0.0) return;
  vec4 record = uintBitsToFloat(texelFetch(uRecordPlace, at, 0));
  float longer = length(record.zw), shorter = uintBitsToFloat(look.x);
  vec2 axis = record.zw / longer;
  // Nothing is drawn beyond the farthest corner of the picture, so that quads stay small enough to be clipped exactly.
  float farthest = length(abs(record.xy - 0.5 * uSize) + 0.5 * uSize);
  float reach = sqrt(2.0 * log(max(255.0 * opacity, 1.0))) * 1.0001 + 1e-4;
  vec2 corner = vec2(gl_VertexID & 1, (gl_VertexID >> 1) & 1) * 2.0 - 1.0;
  vLocal = corner * min(vec2(reach), farthest / vec2(longer, shorter));
  vec2 pixel = record.xy + vLocal.x * record.zw + vLocal.y * shorter * vec2(-axis.y, axis.x);
  vColour = vec4(unpackHalf2x16(look.z), unpackHalf2x16(look.w).x, opacity);
  gl_Position = vec4(2.0 * pixel.x / uSize.x - 1.0, 1.0 - 2.0 * pixel.y / uSize.y, 0.0, 1.0);
}`;

export const SPLAT_FRAGMENT = `${HEAD}
in vec2 vLocal;
in vec4 vColour;
layout(location = 0) out vec4 oColour;

void main() {
  float alpha = min(vColour.a * exp(-0.5 * dot(vLocal, vLocal)), 0.99);
  if (!(alpha >= ${1 / 255})) discard;
  oColour = vec4(vColour.rgb * alpha, alpha);
}`;

/** Adds the background behind the blended splats. */
export const RESOLVE_FRAGMENT = `${HEAD}
uniform sampler2D uPicture;
uniform vec4 uBackground; // premultiplied
out vec4 oColour;

void main() {
  vec4 sum = texelFetch(uPicture, ivec2(gl_FragCoord.xy), 0);
  sum += (1.0 - sum.a) * uBackground;
  oColour = vec4(clamp(sum.rgb, 0.0, sum.a), sum.a);
}`;
