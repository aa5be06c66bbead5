// SPDX-License-Identifier: Apache-2.0
// babylon.mjs
import { ArcRotateCamera } from '@babylonjs/core/Cameras/arcRotateCamera.js';
import { Engine } from '@babylonjs/core/Engines/engine.js';
import { ImportMeshAsync } from '@babylonjs/core/Loading/sceneLoader.js';
import { Color4 } from '@babylonjs/core/Maths/math.color.js';
import { Vector3 } from '@babylonjs/core/Maths/math.vector.js';
import { Scene } from '@babylonjs/core/scene.js';
import 'csplat-decoder/babylon'; // registers a plugin for .csplat

const words = document.querySelector('#words');
const engine = new Engine(document.querySelector('canvas'), false);
const scene = new Scene(engine);
scene.clearColor = new Color4(0, 0, 0, 1);
const camera = new ArcRotateCamera('camera', 0, 0, 1, Vector3.Zero(), scene);
camera.attachControl();
try {
  const url = new URLSearchParams(location.search).get('scene') ?? 'scene.csplat';
  const onProgress = ({ loaded }) => (words.textContent = `${loaded} bytes`);
  const {
    meshes: [splats],
  } = await ImportMeshAsync(url, scene, { onProgress });
  const { view } = splats.metadata.csplat;
  camera.setTarget(Vector3.FromArray(view.target));
  camera.setPosition(Vector3.FromArray(view.position));
  Object.assign(camera, { minZ: 0.01, wheelDeltaPercentage: 0.01 });
  const fit = () => {
    engine.resize();
    camera.fov = (view.fov(innerWidth / innerHeight) * Math.PI) / 180;
  };
  addEventListener('resize', fit);
  fit();
  engine.runRenderLoop(() => scene.render());
  words.textContent = '';
} catch (error) {
  words.textContent = (error.innerError ?? error).message;
}
