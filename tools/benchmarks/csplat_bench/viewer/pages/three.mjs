// three.js: GaussianSplat and its loaders. Colours go through as they are: what is SH to us, three takes for linear light.
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

export async function show(canvas, url, camera, { progressive = false } = {}) {
  const renderer = new THREE.WebGPURenderer({ canvas, forceWebGL: true, antialias: false });
  renderer.setPixelRatio(1);
  renderer.setSize(camera.width, camera.height, false);
  renderer.setClearColor(0x000000, 1);
  renderer.outputColorSpace = THREE.LinearSRGBColorSpace;
  await renderer.init();
  const { splats, complete } = await load(url, progressive);
  const scene = new THREE.Scene();
  scene.add(splats);
  scene.updateMatrixWorld(true);
  let world;
  splats.traverse((one) => { world = one.isGaussianSplat ? one.matrixWorld : world; });
  const eye = new THREE.PerspectiveCamera(camera.fovY, camera.width / camera.height, camera.near, camera.far);
  const pose = new THREE.Matrix4().fromArray(camera.view).multiply(world.clone().invert());
  new THREE.Matrix4().makeScale(1, -1, -1).multiply(pose).invert().decompose(eye.position, eye.quaternion, eye.scale);
  renderer.setAnimationLoop(() => renderer.render(scene, eye));
  const whole = complete?.then((geometry) => {
    scene.remove(splats);
    scene.add(standing(geometry));
    splats.dispose?.();
  });
  return { world: world.toArray(), whole };
}

async function load(url, progressive) {
  const ending = url.split('.').pop();
  if (ending === 'glb') {
    const loader = new GLTFLoader().register((parser) => new GLTFGaussianSplatLoaderExtension(parser));
    return { splats: (await loader.loadAsync(url)).scene };
  }
  if (!loaders[ending]) throw new Error('no loader');
  const loader = new loaders[ending]();
  loader.setOptions?.({ progressive });
  const geometry = await loader.loadAsync(url);
  return { splats: standing(geometry), complete: geometry.userData.complete };
}

function standing(geometry) {
  const splats = new GaussianSplat(geometry);
  if (geometry.userData.upright) splats.applyMatrix4(geometry.userData.upright);
  return splats;
}
