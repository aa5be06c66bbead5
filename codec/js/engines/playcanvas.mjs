// .csplat in PlayCanvas 2.23: `app.loader.getHandler('gsplat').addParser(new CsplatParser(app))`. See playcanvas.d.ts.
// The file's integers lie in textures as they are; the shaders below make values of them.

import * as pc from 'playcanvas';

import { CsplatReader } from '../decoder.mjs';
import { imagesOf } from './playcanvas-textures.mjs';
import { onceSaid, uprightIn } from './unpack.mjs';

/**
 * @typedef {import('../decoder.d.ts').Header} Header
 * @typedef {import('./playcanvas.d.ts').ParserOptions} ParserOptions
 * @typedef {import('./playcanvas-textures.mjs').Image} Image
 */

const WORKERS = 2;
const say = onceSaid('csplat in PlayCanvas');

const BANDS = [1, 2, 3];
const AXES = 'xyz';

const GLSL = /* glsl */ `
uniform vec4 csShape; // lowest integer and step of scales, levels of alpha, whether it is a square
uniform vec4 csOther; // lowest integer and step of colours, lowest of quats and their unit
uniform vec4 csLows;  // of SH bands; whether splats are discs
uniform vec4 csSteps;
#ifndef GSPLAT_WORKBUFFER_GEOMETRY
vec3 getCenter() {
  uvec4 mean = loadCsMeans();
  uint line = uint(textureSize(csTiles, 0).x);
  vec4 tile = texelFetch(csTiles, ivec2(int(mean.w % line), int(mean.w / line)), 0);
  return tile.xyz + vec3(mean.xyz) * tile.w;
}
vec4 getRotation() {
  vec3 axis = (vec3(loadCsQuats().xyz) + csOther.z) * csOther.w;
  return vec4(sqrt(max(0.0, 1.0 - dot(axis, axis))), axis);
}
vec3 getScale() {
  vec3 scale = exp((vec3(loadCsShapes().xyz) + csShape.x) * csShape.y);
  if (csLows.w > 0.5) {
    if (scale.x <= scale.y && scale.x <= scale.z) scale.x = 0.0;
    else if (scale.y <= scale.z) scale.y = 0.0;
    else scale.z = 0.0;
  }
  return scale;
}
#endif
vec4 getColor() {
  float alpha = float(loadCsShapes().w) / csShape.z;
  if (csShape.w > 0.5) alpha *= alpha;
  return vec4(0.5 + 0.28209479177387814 * (vec3(loadCsColours().xyz) + csOther.x) * csOther.y, alpha);
}
#if SH_BANDS > 0
void readSHData(out vec3 sh[SH_COEFFS], out float scale) {
  uvec4 rows = loadCsRows();
  uint line;
  ivec2 at;
${BANDS.map((band) => {
  const [axis, terms] = [AXES[band - 1], 2 * band + 1];
  return `  #if SH_BANDS >= ${band}
  line = uint(textureSize(csBand${band}, 0).x) / ${terms}u;
  at = ivec2(int(rows.${axis} % line) * ${terms}, int(rows.${axis} / line));
  for (int m = 0; m < ${terms}; m++) {
    sh[${band * band - 1} + m] = (vec3(texelFetch(csBand${band}, at + ivec2(m, 0), 0).xyz) + csLows.${axis}) * csSteps.${axis};
  }
  #endif`;
}).join('\n')}
  scale = 1.0;
}
#endif
`;

const WGSL = /* wgsl */ `
uniform csShape: vec4f;
uniform csOther: vec4f;
uniform csLows: vec4f;
uniform csSteps: vec4f;
#ifndef GSPLAT_WORKBUFFER_GEOMETRY
fn getCenter() -> vec3f {
  let mean = loadCsMeans();
  let line = textureDimensions(csTiles).x;
  let tile = textureLoad(csTiles, vec2i(i32(mean.w % line), i32(mean.w / line)), 0);
  return tile.xyz + vec3f(mean.xyz) * tile.w;
}
fn getRotation() -> vec4f {
  let axis = (vec3f(loadCsQuats().xyz) + uniform.csOther.z) * uniform.csOther.w;
  return vec4f(sqrt(max(0.0, 1.0 - dot(axis, axis))), axis);
}
fn getScale() -> vec3f {
  var scale = exp((vec3f(loadCsShapes().xyz) + uniform.csShape.x) * uniform.csShape.y);
  if (uniform.csLows.w > 0.5) {
    if (scale.x <= scale.y && scale.x <= scale.z) { scale.x = 0.0; }
    else if (scale.y <= scale.z) { scale.y = 0.0; }
    else { scale.z = 0.0; }
  }
  return scale;
}
#endif
fn getColor() -> vec4f {
  var alpha = f32(loadCsShapes().w) / uniform.csShape.z;
  if (uniform.csShape.w > 0.5) { alpha *= alpha; }
  return vec4f(0.5 + 0.28209479177387814 * (vec3f(loadCsColours().xyz) + uniform.csOther.x) * uniform.csOther.y, alpha);
}
#if SH_BANDS > 0
fn readSHData(sh: ptr<function, array<half3, SH_COEFFS>>, scale: ptr<function, f32>) {
  let rows = loadCsRows();
  var line: u32;
  var at: vec2i;
${BANDS.map((band) => {
  const [axis, terms] = [AXES[band - 1], 2 * band + 1];
  return `  #if SH_BANDS >= ${band}
  line = textureDimensions(csBand${band}).x / ${terms}u;
  at = vec2i(i32(rows.${axis} % line) * ${terms}, i32(rows.${axis} / line));
  for (var m: i32 = 0; m < ${terms}; m++) {
    sh[${band * band - 1} + m] = half3((vec3f(textureLoad(csBand${band}, at + vec2i(m, 0), 0).xyz) + uniform.csLows.${axis}) * uniform.csSteps.${axis});
  }
  #endif`;
}).join('\n')}
  *scale = 1.0;
}
#endif
`;

/** A scene whose integers lie in textures. */
class CsplatResource extends pc.GSplatResourceBase {
  /**
   * @param {object} device
   * @param {Header} header
   * @param {Record<string, unknown> | null} metadata
   * @param {number} shBands
   * @param {ReturnType<typeof imagesOf>} made
   * @param {object} options
   */
  constructor(device, header, metadata, shBands, { images, parameters, centers }, options) {
    const { tiles, splatCount: numSplats } = header;
    const box = (/** @type {'min' | 'max'} */ side) =>
      new pc.Vec3(...[0, 1, 2].map((axis) => Math[side](...tiles.map((tile) => tile[side][axis]))));
    const calcAabb = (/** @type {any} */ aabb) => tiles.length && aabb.setMinMax(box('min'), box('max'));
    super(device, { numSplats, shBands, getCenters: () => centers, calcAabb }, options);
    this.csplat = { header, metadata };
    const streams = [];
    for (const [name, { width, height, texels }] of Object.entries(images)) {
      const format = formatOf(texels);
      this.streams.textures.set(name, pc.Texture.createDataTexture2D(device, name, width, height, format, [texels]));
      streams.push({ name, format });
    }
    this.streams.textureDimensions.set(images.csMeans.width, images.csMeans.height);
    this._format = new pc.GSplatFormat(device, streams, { readGLSL: GLSL, readWGSL: WGSL });
    for (const [name, value] of Object.entries(parameters)) this.parameters.set(name, value);
  }

  /** @param {Map<string, unknown>} defines */
  configureMaterialDefines(defines) {
    defines.set('SH_BANDS', this.gsplatData.shBands);
  }

  get supportsWorkBufferGeometry() {
    return true;
  }

  /** @param {import('playcanvas').Entity} entity */
  stand(entity) {
    const { header, metadata } = this.csplat;
    const [a, b, c] = uprightIn(header, metadata, 'RUB');
    const left = a[0] * (b[1] * c[2] - b[2] * c[1]) - a[1] * (b[0] * c[2] - b[2] * c[0]) + a[2] * (b[0] * c[1] - b[1] * c[0]) < 0; // prettier-ignore
    if (left) say(`axes ${header.axes} are left-handed, and splats are not mirrored here: left and right are exchanged`);
    const x = left ? -1 : 1;
    const matrix = new pc.Mat4();
    matrix.data.set([x * a[0], x * b[0], x * c[0], 0, a[1], b[1], c[1], 0, a[2], b[2], c[2], 0, 0, 0, 0, 1]);
    entity.setLocalRotation(new pc.Quat().setFromMat4(matrix));
  }
}

/** @param {Image['texels']} texels */
function formatOf(texels) {
  if (texels instanceof Float32Array) return pc.PIXELFORMAT_RGBA32F;
  if (texels instanceof Uint8Array) return pc.PIXELFORMAT_RGBA8U;
  return texels instanceof Uint16Array ? pc.PIXELFORMAT_RGBA16U : pc.PIXELFORMAT_RGBA32U;
}

export class CsplatParser {
  /**
   * @param {import('playcanvas').AppBase} app
   * @param {ParserOptions} [options]
   */
  constructor(app, options = {}) {
    this.app = app;
    this.options = options;
  }

  /** @param {{ext: string}} context */
  canParse({ ext }) {
    return ext === 'csplat';
  }

  /**
   * @param {{load: string}} url
   * @param {(error: unknown, resource?: CsplatResource) => void} callback
   * @param {import('playcanvas').Asset} [asset]
   */
  load(url, callback, asset) {
    this.read(asset?.file?.contents ?? url.load, asset).then(
      (resource) => callback(null, resource),
      (error) => callback(error),
    );
  }

  /**
   * @param {string} _url
   * @param {unknown} data
   */
  open(_url, data) {
    return data;
  }

  /**
   * @param {string | ArrayBuffer} from
   * @param {import('playcanvas').Asset} [asset]
   */
  async read(from, asset) {
    const { shDegree, ...options } = this.options;
    /** @type {(received: number, size: number) => void} */
    const onProgress = (received, size) => {
      options.onProgress?.(received, size);
      asset?.fire('progress', received, size);
    };
    const reader = await CsplatReader.open(from, { ...options, onProgress });
    const { header } = reader;
    const { signal } = options;
    const degree = Math.min(shDegree ?? header.shDegree, header.shDegree);
    const tiles = [];
    for await (const tile of reader.readTiles({ form: 'packed', shDegree: degree, workers: WORKERS, signal })) {
      tiles[tile.index] = tile;
    }
    const { metadata } = await reader.describe({ signal });
    const { graphicsDevice: device, scene } = this.app;
    const made = imagesOf(header, tiles, degree, device.maxTextureSize);
    tell(header, scene);
    const prepareCenters = scene?.gsplatCentersEnabled !== false;
    return new CsplatResource(device, header, metadata, degree, made, { prepareCenters });
  }
}

/**
 * @param {Header} header
 * @param {import('playcanvas').AppBase['scene']} scene
 */
function tell({ antialiased, extras }, scene) {
  if (antialiased && !scene?.gsplat?.antiAlias) say('trained with opacity compensation: set app.scene.gsplat.antiAlias = true');
  if (extras.length) say(`extra columns are not drawn: ${extras.map(({ name }) => name).join(', ')}`);
}
