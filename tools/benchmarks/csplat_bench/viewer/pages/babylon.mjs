// Babylon.js: its loaders append to a scene, in a world of left-handed axes as they have it by themselves.
import '@babylonjs/core/Loading/loadingScreen.js';
import { FreeCamera } from '@babylonjs/core/Cameras/freeCamera.js';
import { AppendSceneAsync } from '@babylonjs/core/Loading/sceneLoader.js';
import { Color4 } from '@babylonjs/core/Maths/math.color.js';
import { Matrix, Quaternion, Vector3 } from '@babylonjs/core/Maths/math.vector.js';
import { Engine } from '@babylonjs/core/Engines/engine.js';
import { Scene } from '@babylonjs/core/scene.js';
import '@babylonjs/loaders/SPLAT/index.js';
import '@babylonjs/loaders/glTF/2.0/index.js';
import 'csplat-decoder/babylon';
import * as fflate from 'three/addons/libs/fflate.module.js';

export const version = Engine.Version;

export async function show(canvas, url, camera, { progressive = false } = {}) {
  canvas.width = camera.width;
  canvas.height = camera.height;
  const engine = new Engine(canvas, false, { preserveDrawingBuffer: true });
  const scene = new Scene(engine);
  scene.clearColor = new Color4(0, 0, 0, 1);
  const eye = new FreeCamera('eye', Vector3.Zero(), scene);
  const spzLibraryUrl = new URL('/node_modules/@adobe/spz/dist/spz.js', location.href).href;
  await AppendSceneAsync(url, scene, { pluginOptions: { splat: { fflate, spzLibraryUrl }, csplat: { progressive } } });
  const splats = scene.meshes.find((mesh) => mesh.getClassName().startsWith('GaussianSplatting'));
  const world = splats.computeWorldMatrix(true);
  // Matrices of row vectors lie in memory as ours of columns do; products are the other way round.
  const view = world.clone().invert().multiply(Matrix.FromArray(camera.view)).multiply(Matrix.Scaling(1, -1, 1));
  const position = new Vector3(), rotation = new Quaternion();
  view.invert().decompose(undefined, rotation, position);
  eye.position = position;
  eye.rotationQuaternion = rotation;
  eye.fov = (camera.fovY * Math.PI) / 180;
  eye.minZ = camera.near;
  eye.maxZ = camera.far;
  engine.runRenderLoop(() => scene.render());
  return { world: Array.from(world.asArray()), whole: splats.metadata?.csplat?.complete };
}
