// SPDX-License-Identifier: Apache-2.0
// three.mjs
import * as THREE from 'three/webgpu';
import { OrbitControls } from 'three/addons/controls/OrbitControls.js';
import { GaussianSplat } from 'three/addons/objects/GaussianSplat.js';
import { CSPLATLoader } from 'csplat-decoder/three';

const words = document.querySelector('#words');
const renderer = new THREE.WebGPURenderer({ canvas: document.querySelector('canvas') });
renderer.outputColorSpace = THREE.LinearSRGBColorSpace; // colours of splats are those of the display already
const camera = new THREE.PerspectiveCamera(45, 1, 0.01, 1000);
const scene = new THREE.Scene();
try {
  const url = new URLSearchParams(location.search).get('scene') ?? 'scene.csplat';
  const geometry = await new CSPLATLoader().loadAsync(url, ({ loaded }) => (words.textContent = `${loaded} bytes`));
  const splats = new GaussianSplat(geometry);
  const { refine, upright, view } = geometry.userData.csplat;
  splats.applyMatrix4(upright);
  refine(splats);
  scene.add(splats);
  camera.up.fromArray(view.up);
  camera.position.fromArray(view.position);
  const controls = new OrbitControls(camera, renderer.domElement);
  controls.target.fromArray(view.target);
  const fit = () => {
    renderer.setSize(innerWidth, innerHeight, false);
    camera.aspect = innerWidth / innerHeight;
    camera.fov = view.fov(camera.aspect);
    camera.updateProjectionMatrix();
  };
  addEventListener('resize', fit);
  fit();
  renderer.setAnimationLoop(() => controls.update() | renderer.render(scene, camera));
  words.textContent = '';
} catch (error) {
  words.textContent = error.message;
}
