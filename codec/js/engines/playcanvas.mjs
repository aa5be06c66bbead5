// SPDX-License-Identifier: Apache-2.0
// .csplat in PlayCanvas 2.23: `app.loader.getHandler('gsplat').addParser(new CsplatParser(app))`. See playcanvas.d.ts.
// Textures hold the integers of the file; the shaders below convert them to values.

import * as pc from 'playcanvas';

import { bandImagesOf, imagesOf } from './playcanvas-textures.mjs';
import { openScene } from './scene.mjs';
import { onceSaid } from './packed_values.mjs';

/**
 * @typedef {import('../decoder.d.ts').Packed} Packed
 * @typedef {import('./options.d.ts').LoadOptions} LoadOptions
 * @typedef {import('./playcanvas-textures.mjs').Image} Image
 * @typedef {import('./scene.mjs').SplatScene} SplatScene
 */

const NAME = 'csplat in PlayCanvas';

const BANDS = [1, 2, 3];
const AXES = 'xyz';

const GLSL = /* glsl */ `
uniform vec4 csShape; // lowest integer and step of scales, levels of alpha, whether alpha is squared
uniform vec4 csOther; // lowest integer and step of colours, lowest integer and unit of quats
uniform vec4 csLows;  // lowest integers of SH bands; whether splats are discs
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

/** A scene whose integers are in textures. */
class CsplatResource extends pc.GSplatResourceBase {
  /**
   * @param {object} device
   * @param {SplatScene} scene
   * @param {ReturnType<typeof imagesOf>} made
   * @param {object} options
   */
  constructor(device, scene, { images, parameters, centers }, options) {
    const { tiles, splatCount: numSplats } = scene.header;
    const box = (/** @type {'min' | 'max'} */ side) =>
      new pc.Vec3(...[0, 1, 2].map((axis) => Math[side](...tiles.map((tile) => tile[side][axis]))));
    const [low, high] = [box('min'), box('max')];
    if (scene.mirrored) [low.x, high.x] = [-high.x, -low.x];
    const calcAabb = (/** @type {any} */ aabb) => tiles.length && aabb.setMinMax(low, high);
    super(device, { numSplats, shBands: 0, getCenters: () => centers, calcAabb }, options);
    this.scene = scene;
    /** @type {{name: string, format: number}[]} */
    this.described = [];
    /** @type {Set<import('playcanvas').Entity>} */
    this.entities = new Set();
    /** @type {import('./options.d.ts').SceneFacts | null} */
    this.csplat = null;
    this.streams.textureDimensions.set(images.csMeans.width, images.csMeans.height);
    this.add(images, parameters, 0);
  }

  /**
   * @param {Record<string, Image>} images
   * @param {Record<string, number[]>} parameters
   * @param {number} degree SH degree now available
   */
  add(images, parameters, degree) {
    const { device } = this;
    for (const [name, { width, height, texels }] of Object.entries(images)) {
      const format = formatOf(texels);
      this.streams.textures.set(name, pc.Texture.createDataTexture2D(device, name, width, height, format, [texels]));
      this.described.push({ name, format });
    }
    this.gsplatData.shBands = degree;
    this._format = new pc.GSplatFormat(device, this.described, { readGLSL: GLSL, readWGSL: WGSL });
    for (const [name, value] of Object.entries(parameters)) this.parameters.set(name, value);
  }

  /** Add the SH bands of a progressive load. */
  async addBands() {
    const { scene } = this;
    const layers = [];
    for (let layer = 1; layer <= scene.degree; layer++) {
      /** @type {(Packed | undefined)[]} */
      const bands = [];
      for await (const { index, sh } of scene.bands(layer)) bands[index] = sh;
      layers.push(Array.from(scene.header.tiles, ({ index }) => bands[index]));
    }
    this.addImages(layers);
    for (const { gsplat } of this.entities) if (gsplat) gsplat.workBufferUpdate = pc.WORKBUFFER_UPDATE_ONCE;
  }

  /** @param {Parameters<typeof bandImagesOf>[1]} layers */
  addImages(layers) {
    if (layers.length === 0) return;
    const { images, parameters } = bandImagesOf(this.scene.header, layers, this.device.maxTextureSize);
    this.add(images, parameters, layers.length);
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
    const [a, b, c] = this.scene.upright;
    const matrix = new pc.Mat4();
    matrix.data.set([a[0], b[0], c[0], 0, a[1], b[1], c[1], 0, a[2], b[2], c[2], 0, 0, 0, 0, 1]);
    entity.setLocalRotation(new pc.Quat().setFromMat4(matrix));
    this.entities.add(entity);
  }

  destroy() {
    this.scene.abort();
    this.entities.clear();
    super.destroy();
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
   * @param {LoadOptions} [options]
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
   * @param {string | {load: string}} url
   * @param {(error: unknown, resource?: CsplatResource) => void} callback
   * @param {import('playcanvas').Asset} [asset]
   */
  load(url, callback, asset) {
    this.read(asset?.file?.contents ?? (typeof url === 'string' ? url : url.load), asset).then(
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
    const { graphicsDevice: device, scene: world } = this.app;
    /** @type {(received: number, size: number) => void} */
    const onProgress = (received, size) => {
      this.options.onProgress?.(received, size);
      asset?.fire('progress', received, size);
    };
    const budget = world?.gsplat?.splatBudget;
    const target = {
      ...{ name: NAME, engine: /** @type {const} */ ('RUB'), mirrors: false, shDegree: BANDS.length },
      maxSplats: budget === 0 ? Infinity : budget, // the engine draws everything at its finest level then
    };
    const scene = await openScene(from, { ...this.options, onProgress }, target);
    const { header } = scene;
    /** @type {import('../decoder.d.ts').PackedTile[]} */
    const tiles = [];
    for await (const tile of scene.tiles()) tiles[tile.index] = tile;
    if (header.antialiased && !world?.gsplat?.antiAlias) {
      onceSaid(NAME, 'trained with opacity compensation: set app.scene.gsplat.antiAlias = true');
    }
    const prepareCenters = world?.gsplatCentersEnabled !== false;
    const resource = new CsplatResource(device, scene, imagesOf(header, tiles, device.maxTextureSize), {
      prepareCenters,
    });
    const degree = scene.progressive ? 0 : scene.degree;
    resource.addImages(Array.from({ length: degree }, (_, i) => tiles.map(({ sh }) => sh[i])));
    resource.csplat = scene.facts(() => resource.addBands(), undefined);
    return resource;
  }
}
