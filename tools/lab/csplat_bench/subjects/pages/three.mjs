// SPDX-License-Identifier: Apache-2.0
// three.js: GaussianSplat and its loaders. Colours pass unchanged: three takes SH colours for linear light.
import * as THREE from 'three';
import { CSPLATLoader } from 'csplat-decoder/three';
import { GLTFGaussianSplatLoaderExtension } from 'three/addons/loaders/GLTFGaussianSplatLoaderExtension.js';
import { GLTFLoader } from 'three/addons/loaders/GLTFLoader.js';
import { GaussianSplatPLYLoader } from 'three/addons/loaders/GaussianSplatPLYLoader.js';
import { SPLATLoader } from 'three/addons/loaders/SPLATLoader.js';
import { SPZLoader } from 'three/addons/loaders/SPZLoader.js';
import { GaussianSplat } from 'three/addons/objects/GaussianSplat.js';

export const version = `0.${THREE.REVISION}`;

const loaders = { csplat: CSPLATLoader, ply: GaussianSplatPLYLoader, spz: SPZLoader, splat: SPLATLoader };

export const show = async (canvas, url, camera, options) => (await start(canvas, camera, options)).show(url, camera, options);

export async function start(canvas, { width, height }, { webgpu = false } = {}) {
  const renderer = new THREE.WebGPURenderer({ canvas, forceWebGL: !webgpu, antialias: false });
  renderer.setPixelRatio(1);
  renderer.setSize(width, height, false);
  renderer.setClearColor(0x000000, 1);
  renderer.outputColorSpace = THREE.LinearSRGBColorSpace;
  await renderer.init();
  const scene = new THREE.Scene();
  const eye = new THREE.PerspectiveCamera(50, width / height);
  renderer.setAnimationLoop(() => renderer.render(scene, eye));
  return {
    show: async (url, camera, options = {}) => {
      let splats = await load(url, options);
      scene.add(splats);
      scene.updateMatrixWorld(true);
      let inner;
      splats.traverse((one) => { inner = one.isGaussianSplat ? one : inner; });
      const { matrixWorld, splatGeometry } = inner;
      const { complete, fromFile, levels, refine } = splatGeometry.userData.csplat ?? {};
      const world = fromFile ? fromFile.clone().premultiply(matrixWorld) : matrixWorld;
      if (camera) look(eye, camera, world);
      refine?.(inner);
      const whole = complete?.then((geometry) => {
        if (geometry === splatGeometry) return;
        take(scene, splats);
        scene.add((splats = standing(geometry)));
      });
      const remove = () => take(scene, splats);
      return { world: world.toArray(), count: splatGeometry.getAttribute('position').count, whole, levels, remove };
    },
    look: (camera, world) => look(eye, camera, new THREE.Matrix4().fromArray(world)),
    close: () => {
      renderer.setAnimationLoop(null);
      renderer.dispose();
    },
  };
}

async function load(url, options) {
  const ending = url.split('.').pop();
  if (ending === 'glb') {
    const loader = new GLTFLoader().register((parser) => new GLTFGaussianSplatLoaderExtension(parser));
    return (await loader.loadAsync(url)).scene;
  }
  if (!loaders[ending]) throw new Error('no loader');
  const loader = new loaders[ending]();
  loader.setOptions?.(options);
  return standing(await loader.loadAsync(url));
}

function standing(geometry) {
  const splats = new GaussianSplat(geometry);
  if (geometry.userData.csplat) splats.applyMatrix4(geometry.userData.csplat.upright);
  return splats;
}

function take(scene, splats) {
  scene.remove(splats);
  splats.traverse((one) => {
    one.splatGeometry?.dispose();
    one.geometry?.dispose();
    one.material?.dispose();
  });
}

function look(eye, { view, fovY, near, far }, world) {
  Object.assign(eye, { fov: fovY, near, far });
  eye.updateProjectionMatrix();
  const pose = new THREE.Matrix4().fromArray(view).multiply(world.clone().invert());
  new THREE.Matrix4().makeScale(1, -1, -1).multiply(pose).invert().decompose(eye.position, eye.quaternion, eye.scale);
}
