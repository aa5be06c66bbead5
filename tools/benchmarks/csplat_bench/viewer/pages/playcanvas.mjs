// PlayCanvas: a component with an asset, of SPZ by the parser that comes with its package.
import * as pc from 'playcanvas';
import { CsplatParser } from 'csplat-decoder/playcanvas';
import { SpzParser } from '/node_modules/playcanvas/scripts/esm/parsers/spz-parser.mjs';
import { ZSTDDecoder } from 'three/addons/libs/zstddec.module.js';

export const version = pc.version;

export async function show(canvas, url, camera, { progressive = false } = {}) {
  canvas.width = camera.width;
  canvas.height = camera.height;
  const device = await pc.createGraphicsDevice(canvas, { deviceTypes: ['webgl2'], antialias: false });
  const options = new pc.AppOptions();
  options.graphicsDevice = device;
  options.componentSystems = [pc.CameraComponentSystem, pc.RenderComponentSystem, pc.GSplatComponentSystem];
  options.resourceHandlers = [pc.ContainerHandler, pc.GSplatHandler, pc.TextureHandler];
  const app = new pc.AppBase(canvas);
  app.init(options);
  addSpz(app);
  app.loader.getHandler('gsplat').addParser(new CsplatParser(app, { progressive }));
  app.start();

  const { splats, whole } = await load(app, url);
  app.root.addChild(splats);
  const world = splats.findComponent('gsplat').entity.getWorldTransform().clone();
  const flip = new pc.Mat4().setScale(1, -1, -1);
  const view = new pc.Mat4();
  view.data.set(camera.view);
  const pose = flip.mul(view).mul(world.clone().invert()).invert();
  const eye = new pc.Entity();
  eye.addComponent('camera', {
    clearColor: new pc.Color(0, 0, 0, 1), fov: camera.fovY, nearClip: camera.near, farClip: camera.far,
    toneMapping: pc.TONEMAP_NONE,
  });
  eye.setPosition(pose.getTranslation());
  eye.setRotation(new pc.Quat().setFromMat4(pose));
  app.root.addChild(eye);
  return { world: Array.from(world.data), whole };
}

function addSpz(app) {
  // The decoder is the application's to bring: three's, behind the functions that are called.
  const glue = `window.ZstdDecoderModule = async () => window.zstd;`;
  const decoder = new ZSTDDecoder();
  window.zstd = decoder.init().then(() => ({ decompress: (bytes, size) => decoder.decode(bytes, size) }));
  const glueUrl = URL.createObjectURL(new Blob([glue], { type: 'text/javascript' }));
  pc.WasmModule.setConfig('ZstdDecoderModule', { glueUrl, wasmUrl: glueUrl });
  app.loader.getHandler('gsplat').addParser(new SpzParser(app));
}

async function load(app, url) {
  const container = url.endsWith('.glb');
  const asset = new pc.Asset('splats', container ? 'container' : 'gsplat', { url });
  await new Promise((resolve, reject) => {
    asset.once('load', resolve);
    asset.once('error', (message) => reject(new Error(message)));
    app.assets.add(asset);
    app.assets.load(asset);
  });
  if (container) return { splats: asset.resource.instantiateRenderEntity() };
  const entity = new pc.Entity();
  entity.addComponent('gsplat', { asset });
  asset.resource.stand?.(entity); // of .csplat
  return { splats: entity, whole: asset.resource.csplat?.complete };
}
