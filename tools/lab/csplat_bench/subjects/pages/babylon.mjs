// SPDX-License-Identifier: Apache-2.0
// Babylon.js: its loaders append to a scene whose world has left-handed axes, the default.
import '@babylonjs/core/Loading/loadingScreen.js';
import { FreeCamera } from '@babylonjs/core/Cameras/freeCamera.js';
import { ImportMeshAsync } from '@babylonjs/core/Loading/sceneLoader.js';
import { Color4 } from '@babylonjs/core/Maths/math.color.js';
import { Matrix, Quaternion, Vector3 } from '@babylonjs/core/Maths/math.vector.js';
import { Engine } from '@babylonjs/core/Engines/engine.js';
import { WebGPUEngine } from '@babylonjs/core/Engines/webgpuEngine.js';
import { Scene } from '@babylonjs/core/scene.js';
import '@babylonjs/loaders/SPLAT/index.js';
import '@babylonjs/loaders/glTF/2.0/index.js';
import 'csplat-decoder/babylon';
import * as fflate from 'three/addons/libs/fflate.module.js';

export const version = Engine.Version;

export const show = async (canvas, url, camera, options) => (await start(canvas, camera, options)).show(url, camera, options);

export async function start(canvas, { width, height }, { webgpu = false } = {}) {
  canvas.width = width;
  canvas.height = height;
  const engine = webgpu ? new WebGPUEngine(canvas) : new Engine(canvas, false, { preserveDrawingBuffer: true });
  await engine.initAsync?.();
  const scene = new Scene(engine);
  scene.clearColor = new Color4(0, 0, 0, 1);
  const eye = new FreeCamera('eye', Vector3.Zero(), scene);
  const spzLibraryUrl = new URL('/node_modules/@adobe/spz/dist/spz.js', location.href).href;
  engine.runRenderLoop(() => scene.render());
  return {
    show: async (url, camera, options = {}) => {
      const pluginOptions = { splat: { fflate, spzLibraryUrl }, csplat: options };
      const { meshes } = await ImportMeshAsync(url, scene, { pluginOptions });
      const splats = meshes.find((mesh) => mesh.getClassName().startsWith('GaussianSplatting'));
      const world = splats.computeWorldMatrix(true);
      if (camera) look(eye, camera, world);
      const remove = () => splats.dispose(false, true);
      const { complete: whole, levels } = splats.metadata?.csplat ?? {};
      return { world: Array.from(world.asArray()), count: splats.splatCount, whole, levels, remove };
    },
    look: (camera, world) => look(eye, camera, Matrix.FromArray(world)),
    close: () => engine.dispose(),
  };
}

function look(eye, { view: columns, fovY, near, far }, world) {
  // Matrices of row vectors have the same memory layout as ours of column vectors; products are reversed.
  const view = world.clone().invert().multiply(Matrix.FromArray(columns)).multiply(Matrix.Scaling(1, -1, 1));
  const position = new Vector3(), rotation = new Quaternion();
  view.invert().decompose(undefined, rotation, position);
  Object.assign(eye, { position, rotationQuaternion: rotation, fov: (fovY * Math.PI) / 180, minZ: near, maxZ: far });
}
