// SPDX-License-Identifier: Apache-2.0
// Spark on three.js: its own loader, and the adapter for .csplat.
import { SparkRenderer, SplatMesh } from '@sparkjsdev/spark';
import { loadCsplat } from 'csplat-decoder/spark';
import * as THREE from 'three';

export const version = '2.2';

export const show = async (canvas, url, camera, options) => (await start(canvas, camera, options)).show(url, camera, options);

export async function start(canvas, { width, height }) {
  const renderer = new THREE.WebGLRenderer({ canvas, antialias: false });
  renderer.setPixelRatio(1);
  renderer.setSize(width, height, false);
  renderer.setClearColor(0x000000, 1);
  const scene = new THREE.Scene();
  // Without opacity compensation, which these scenes require, and with colours that are not rounded to bytes.
  const spark = new SparkRenderer({ renderer, preBlurAmount: 0.3, blurAmount: 0, accumExtSplats: true });
  scene.add(spark);
  const eye = new THREE.PerspectiveCamera(50, width / height);
  renderer.setAnimationLoop(() => renderer.render(scene, eye));
  return {
    show: async (url, camera, options = {}) => {
      const splats = await load(url, options);
      scene.add(splats);
      scene.updateMatrixWorld(true);
      if (camera) look(eye, camera, splats.matrixWorld);
      const remove = () => {
        scene.remove(splats);
        splats.dispose();
      };
      const { matrixWorld, userData } = splats;
      const { complete: whole, levels } = userData.csplat ?? {};
      return { world: matrixWorld.toArray(), count: splats.splats.getNumSplats(), whole, levels, remove };
    },
    look: (camera, world) => look(eye, camera, new THREE.Matrix4().fromArray(world)),
    close: () => {
      renderer.setAnimationLoop(null);
      spark.dispose?.();
      renderer.dispose();
    },
  };
}

async function load(url, options) {
  if (url.endsWith('.csplat')) return loadCsplat(url, options);
  const mesh = new SplatMesh({ url, extSplats: true });
  await mesh.initialized;
  return mesh;
}

function look(eye, { view, fovY, near, far }, world) {
  Object.assign(eye, { fov: fovY, near, far });
  eye.updateProjectionMatrix();
  const pose = new THREE.Matrix4().fromArray(view).multiply(world.clone().invert());
  new THREE.Matrix4().makeScale(1, -1, -1).multiply(pose).invert().decompose(eye.position, eye.quaternion, eye.scale);
}
