// Spark, over three.js: its own loader, and the adapter for .csplat.
import { SparkRenderer, SplatMesh } from '@sparkjsdev/spark';
import * as THREE from 'three';

export const version = '2.2';

export async function show(canvas, url, camera, { progressive = false } = {}) {
  const renderer = new THREE.WebGLRenderer({ canvas, antialias: false });
  renderer.setPixelRatio(1);
  renderer.setSize(camera.width, camera.height, false);
  renderer.setClearColor(0x000000, 1);
  const scene = new THREE.Scene();
  // Without opacity compensation, as these scenes want it, and with colours that are not cut to bytes on their way.
  scene.add(new SparkRenderer({ renderer, preBlurAmount: 0.3, blurAmount: 0, accumExtSplats: true }));
  const splats = await load(url, progressive);
  scene.add(splats);
  scene.updateMatrixWorld(true);
  const world = splats.matrixWorld;
  const eye = new THREE.PerspectiveCamera(camera.fovY, camera.width / camera.height, camera.near, camera.far);
  const pose = new THREE.Matrix4().fromArray(camera.view).multiply(world.clone().invert());
  new THREE.Matrix4().makeScale(1, -1, -1).multiply(pose).invert().decompose(eye.position, eye.quaternion, eye.scale);
  renderer.setAnimationLoop(() => renderer.render(scene, eye));
  return { world: world.toArray(), whole: splats.userData.csplat?.complete };
}

async function load(url, progressive) {
  if (url.endsWith('.csplat')) {
    const { loadCsplat } = await import('csplat-decoder/spark');
    return loadCsplat(url, { progressive });
  }
  const mesh = new SplatMesh({ url, extSplats: true });
  await mesh.initialized;
  return mesh;
}
