// SPDX-License-Identifier: Apache-2.0
// .csplat in PlayCanvas 2.23: `app.loader.getHandler('gsplat').addParser(new CsplatParser(app))`. See playcanvas.d.ts.
// Textures hold the integers of the file; the shaders below convert them to values.

import * as pc from 'playcanvas';

import { FADE_EXCESS, FADE_STEPS } from '../levels/shown_tiles.mjs';
import { allTiles } from '../tile_records.mjs';
import { bandImagesOf, imagesOf } from './playcanvas-textures.mjs';
import { openScene } from './scene.mjs';
import { onceSaid } from './packed_values.mjs';

/**
 * @typedef {import('../decoder.d.ts').Packed} Packed
 * @typedef {import('./options.d.ts').LoadOptions} LoadOptions
 * @typedef {import('./playcanvas-textures.mjs').Image} Image
 * @typedef {import('./scene.mjs').SplatScene} SplatScene
 * @typedef {import('../decoder.d.ts').Header} Header
 * @typedef {import('../levels/level_scene.mjs').LoadedTile} LoadedTile
 * @typedef {import('playcanvas').Entity} Entity
 * @typedef {{tile: LoadedTile, resource: CsplatResource, children: Map<Entity, Entity>}} ShownTile
 */

const NAME = 'csplat in PlayCanvas';

const BANDS = [1, 2, 3];
const AXES = 'xyz';

const GLSL = /* glsl */ `
uniform vec4 csShape; // lowest integer and step of scales, levels of alpha, whether alpha is squared
uniform vec4 csOther; // lowest integer and step of colours, lowest integer and unit of quats
uniform vec4 csLows;  // lowest integers of SH bands; whether splats are discs
uniform vec4 csSteps; // of these; share that is not drawn, see fadedAlpha
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
  alpha *= (1.0 - csSteps.w) * (1.0 + ${FADE_EXCESS} * alpha * csSteps.w);
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
  alpha *= (1.0 - uniform.csSteps.w) * (1.0 + ${FADE_EXCESS} * alpha * uniform.csSteps.w);
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
   * @param {Header} header of the tiles in the textures
   * @param {ReturnType<typeof imagesOf>} made
   * @param {object} options
   */
  constructor(device, scene, header, { images, parameters, centersOf }, options) {
    const corners = scene.corners(pc.Vec3, header);
    const calcAabb = (/** @type {any} */ aabb) => header.tiles.length && aabb.setMinMax(...corners);
    super(device, { numSplats: header.splatCount, shBands: 0, getCenters: centersOf, calcAabb }, options);
    this.header = header;
    this.scene = scene;
    /** @type {{name: string, format: number}[]} */
    this.described = [];
    /** @type {Set<import('playcanvas').Entity>} */
    this.entities = new Set();
    /** @type {import('./options.d.ts').SceneFacts | null} */
    this.csplat = null;
    /** Parameters of the shaders, of which the last fades. @type {number[]} */
    this.steps = [0, 0, 0, 0];
    /** What draws levels of detail. @type {TileEntities | null} */
    this.tiles = null;
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
    const hidden = this.steps[3];
    for (const [name, value] of Object.entries(parameters)) this.parameters.set(name, value);
    this.steps = /** @type {number[]} */ (this.parameters.get('csSteps'));
    this.steps[3] = hidden;
  }

  /** @param {number} shares that are drawn */
  fade(shares) {
    this.steps[3] = 1 - shares / FADE_STEPS; // the engine's materials refer to this array
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
    const { images, parameters } = bandImagesOf(this.header, layers, this.device.maxTextureSize);
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
    this.tiles?.stand(entity);
  }

  destroy() {
    if (this.csplat) this.scene.abort(); // it is the whole scene
    this.tiles?.destroy();
    this.entities.clear();
    super.destroy();
  }
}

/** Draws tiles as entities below those that stand in the scene. The engine sorts the splats of all components together. */
class TileEntities {
  /**
   * @param {import('playcanvas').AppBase} app
   * @param {SplatScene} scene
   * @param {object} options of the resources
   */
  constructor(app, scene, options) {
    this.app = app;
    this.scene = scene;
    this.options = options;
    /** @type {Map<number, ShownTile>} */
    this.shown = new Map();
    /** @type {ShownTile[]} */
    this.hidden = [];
    /** @type {Set<Entity>} */
    this.entities = new Set();
    this.look = this.look.bind(this);
    app.on('prerender', this.look);
  }

  /** @param {Entity} entity */
  stand(entity) {
    this.entities.add(entity);
    entity.once('destroy', () => {
      this.entities.delete(entity);
      for (const { children } of this.shown.values()) children.delete(entity);
    });
    this.flush();
  }

  /**
   * @param {number} index
   * @param {LoadedTile} tile
   * @param {number} shares
   */
  show(index, tile, shares) {
    const { scene, app, options } = this;
    const record = { ...allTiles(scene.file)[index], index: 0, first: 0 };
    const header = { ...scene.file, tiles: [record], splatCount: tile.count };
    const { graphicsDevice: device } = app;
    const resource = new CsplatResource(
      device,
      scene,
      header,
      imagesOf(header, [tile], device.maxTextureSize),
      options,
    );
    this.shown.set(index, { tile, resource, children: new Map() });
    this.fade(index, shares);
    this.band(index);
  }

  /**
   * @param {number} index
   * @param {number} shares
   */
  fade(index, shares) {
    const one = this.shown.get(index);
    one?.resource.fade(shares);
    for (const { gsplat } of one?.children.values() ?? [])
      if (gsplat) gsplat.workBufferUpdate = pc.WORKBUFFER_UPDATE_ONCE;
  }

  /** @param {number} index a tile to which a band was added: they are drawn when all of them are here */
  band(index) {
    const one = this.shown.get(index);
    if (!one || one.resource.gsplatData.shBands > 0) return; // they were added
    const { tile, resource, children } = one;
    const { degree } = this.scene;
    const has = (/** @type {number} */ layer) => resource.header.tiles[0].layers.some((place) => place.layer === layer);
    const layers = Array.from({ length: degree }, (_, i) => tile.sh[i]);
    if (layers.every((sh) => !sh) || layers.some((sh, i) => !sh && has(i + 1))) return;
    resource.addImages(layers.map((sh) => [sh]));
    for (const { gsplat } of children.values()) if (gsplat) gsplat.workBufferUpdate = pc.WORKBUFFER_UPDATE_ONCE;
  }

  /** @param {number} index */
  hide(index) {
    const one = this.shown.get(index);
    if (one) this.hidden.push(one);
    this.shown.delete(index);
  }

  flush() {
    for (const { children, resource } of this.hidden.splice(0)) {
      for (const child of children.values()) child.destroy();
      resource.destroy();
    }
    for (const { children, resource } of this.shown.values()) {
      for (const entity of this.entities) {
        if (!children.has(entity)) children.set(entity, childOf(entity, resource));
      }
    }
  }

  look() {
    const [entity] = this.entities;
    const [camera] = this.app.systems.camera.cameras;
    if (!entity || !camera) return;
    const { width, height } = this.app.graphicsDevice;
    const modelView = new pc.Mat4().mul2(camera.viewMatrix, entity.getWorldTransform());
    const picture = { width: width * camera.rect.z, height: height * camera.rect.w, near: camera.nearClip };
    this.scene.look(modelView.data, camera.projectionMatrix.data, picture);
  }

  destroy() {
    this.app.off('prerender', this.look);
    for (const index of [...this.shown.keys()]) this.hide(index);
    this.flush();
  }
}

/**
 * Return an entity that draws a resource where another one stands.
 *
 * @param {Entity} parent
 * @param {CsplatResource} resource
 */
function childOf(parent, resource) {
  const child = new pc.Entity();
  child.addComponent('gsplat', { resource, ...(parent.gsplat && { layers: parent.gsplat.layers }) });
  parent.addChild(child);
  return child;
}

/**
 * Return a scene of one splat that is invisible, which an asset holds while its levels of detail are entities.
 *
 * @param {SplatScene} scene
 */
function blankOf({ file }) {
  const columns = (/** @type {number} */ n) => ({ columns: new Uint8Array(n), offsets: new Array(n).fill(0), step: 1 });
  const three = columns(3);
  const tile = { count: 1, opacities: columns(1), scales: three, quats: three, means: three, sh0: three, sh: [] };
  const tiles = file.tiles.slice(0, 1).map((one) => ({ ...one, index: 0, first: 0, splatCount: 1, extent: [0, 0, 0] }));
  return { header: { ...file, tiles, splatCount: 1 }, tiles: [tile] };
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
    const prepareCenters = world?.gsplatCentersEnabled !== false;
    if (scene.levels) return this.streamed(scene, { prepareCenters });
    /** @type {import('../decoder.d.ts').PackedTile[]} */
    const tiles = [];
    for await (const tile of scene.tiles()) tiles[tile.index] = tile;
    if (header.antialiased && !world?.gsplat?.antiAlias) {
      onceSaid(NAME, 'trained with opacity compensation: set app.scene.gsplat.antiAlias = true');
    }
    const images = imagesOf(header, tiles, device.maxTextureSize);
    const resource = new CsplatResource(device, scene, header, images, { prepareCenters });
    const degree = scene.progressive ? 0 : scene.degree;
    resource.addImages(Array.from({ length: degree }, (_, i) => tiles.map(({ sh }) => sh[i])));
    resource.csplat = scene.facts(() => resource.addBands(), undefined);
    return resource;
  }

  /**
   * @param {SplatScene} scene
   * @param {object} options
   */
  async streamed(scene, options) {
    const { graphicsDevice: device } = this.app;
    const tiles = new TileEntities(this.app, scene, options);
    await scene.drawLevels(tiles).catch((error) => {
      tiles.destroy();
      throw error;
    });
    const blank = blankOf(scene);
    const images = imagesOf(blank.header, blank.tiles, device.maxTextureSize);
    const resource = new CsplatResource(device, scene, blank.header, images, options);
    resource.tiles = tiles;
    resource.csplat = scene.facts(async () => {}, undefined);
    return resource;
  }
}
