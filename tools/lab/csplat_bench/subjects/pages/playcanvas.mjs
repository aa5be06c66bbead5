// SPDX-License-Identifier: Apache-2.0
// PlayCanvas: a component with an asset; SPZ by the parser in its package.
import * as pc from 'playcanvas';
import { CsplatParser } from 'csplat-decoder/playcanvas';
import { SpzParser } from '/node_modules/playcanvas/scripts/esm/parsers/spz-parser.mjs';
import { ZSTDDecoder } from 'three/addons/libs/zstddec.module.js';

export const { version } = pc;

export const show = async (canvas, url, camera, options) => (await start(canvas, camera, options)).show(url, camera, options);

export async function start(canvas, { width, height }, { webgpu = false } = {}) {
  canvas.width = width;
  canvas.height = height;
  const deviceTypes = [webgpu ? 'webgpu' : 'webgl2'];
  const device = await pc.createGraphicsDevice(canvas, { deviceTypes, antialias: false });
  const options = new pc.AppOptions();
  options.graphicsDevice = device;
  options.componentSystems = [pc.CameraComponentSystem, pc.RenderComponentSystem, pc.GSplatComponentSystem];
  options.resourceHandlers = [pc.ContainerHandler, pc.GSplatHandler, pc.TextureHandler];
  const app = new pc.AppBase(canvas);
  app.init(options);
  addSpz(app);
  const parser = new CsplatParser(app);
  app.loader.getHandler('gsplat').addParser(parser);
  app.start();
  app.scene.gsplat.lodUnderfillLimit = 10; // streamed SOG is drawn coarsely until finer levels are here
  const eye = new pc.Entity();
  eye.addComponent('camera', { clearColor: new pc.Color(0, 0, 0, 1), toneMapping: pc.TONEMAP_NONE });
  app.root.addChild(eye);
  return {
    show: async (url, camera, loading = {}) => {
      parser.options = loading;
      const asset = await loaded(app, url);
      const splats = entityOf(asset);
      app.root.addChild(splats);
      const world = splats.findComponent('gsplat').entity.getWorldTransform().clone();
      if (camera) look(eye, camera, world);
      const remove = () => {
        splats.destroy();
        app.assets.remove(asset);
        asset.unload();
      };
      const { csplat, numSplats: count } = asset.resource;
      return { world: Array.from(world.data), count, whole: csplat?.complete, levels: csplat?.levels, remove };
    },
    look: (camera, world) => look(eye, camera, Object.assign(new pc.Mat4(), { data: Float32Array.from(world) })),
    close: () => app.destroy(),
  };
}

function addSpz(app) {
  // The application provides the decoder: three's, wrapped in the functions that the parser calls.
  const glue = `window.ZstdDecoderModule = async () => window.zstd;`;
  const decoder = new ZSTDDecoder();
  window.zstd = decoder.init().then(() => ({ decompress: (bytes, size) => decoder.decode(bytes, size) }));
  const glueUrl = URL.createObjectURL(new Blob([glue], { type: 'text/javascript' }));
  pc.WasmModule.setConfig('ZstdDecoderModule', { glueUrl, wasmUrl: glueUrl });
  app.loader.getHandler('gsplat').addParser(new SpzParser(app));
}

function loaded(app, url) {
  const asset = new pc.Asset('splats', url.endsWith('.glb') ? 'container' : 'gsplat', { url });
  return new Promise((resolve, reject) => {
    asset.once('load', () => resolve(asset));
    asset.once('error', (error) => reject(error instanceof Error ? error : new Error(error)));
    app.assets.add(asset);
    app.assets.load(asset);
  });
}

function entityOf(asset) {
  if (asset.type === 'container') return asset.resource.instantiateRenderEntity();
  const entity = new pc.Entity();
  entity.addComponent('gsplat', { asset });
  asset.resource.stand?.(entity); // .csplat alone
  return entity;
}

function look(eye, { view: columns, fovY, near, far }, world) {
  const flip = new pc.Mat4().setScale(1, -1, -1);
  const view = new pc.Mat4();
  view.data.set(columns);
  const pose = flip.mul(view).mul(world.clone().invert()).invert();
  Object.assign(eye.camera, { fov: fovY, nearClip: near, farClip: far });
  eye.setPosition(pose.getTranslation());
  eye.setRotation(new pc.Quat().setFromMat4(pose));
}
