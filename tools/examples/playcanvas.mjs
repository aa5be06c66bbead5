// SPDX-License-Identifier: Apache-2.0
// playcanvas.mjs
import * as pc from 'playcanvas';
import { CameraControls } from 'playcanvas/scripts/esm/camera-controls.mjs';
import { CsplatParser } from 'csplat-decoder/playcanvas';

const words = document.querySelector('#words');
const app = new pc.Application(document.querySelector('canvas'), { graphicsDeviceOptions: { antialias: false } });
app.setCanvasFillMode(pc.FILLMODE_FILL_WINDOW);
app.setCanvasResolution(pc.RESOLUTION_AUTO);
app.loader.getHandler('gsplat').addParser(new CsplatParser(app));
app.start();
const url = new URLSearchParams(location.search).get('scene') ?? 'scene.csplat';
const asset = new pc.Asset('splats', 'gsplat', { url });
asset.on('progress', (loaded) => (words.textContent = `${loaded} bytes`));
asset.on('error', (error) => (words.textContent = error.message));
asset.ready(({ resource }) => {
  const splats = new pc.Entity();
  splats.addComponent('gsplat', { asset });
  resource.stand(splats);
  app.root.addChild(splats);
  const { header, view } = resource.csplat;
  app.scene.gsplat.antiAlias = header.antialiased;
  const camera = new pc.Entity();
  camera.addComponent('camera', { clearColor: pc.Color.BLACK, nearClip: 0.01, toneMapping: pc.TONEMAP_NONE });
  camera.setPosition(...view.position);
  const focusPoint = new pc.Vec3(view.target);
  camera.addComponent('script').create(CameraControls, { properties: { focusPoint } });
  const fit = () => {
    app.resizeCanvas();
    camera.camera.fov = view.fov(innerWidth / innerHeight);
  };
  addEventListener('resize', fit);
  fit();
  app.root.addChild(camera);
  words.textContent = '';
});
app.assets.add(asset);
app.assets.load(asset);
