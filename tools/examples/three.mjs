// SPDX-License-Identifier: Apache-2.0
// three.mjs
import * as THREE from 'three/webgpu';
import { OrbitControls } from 'three/addons/controls/OrbitControls.js';
import { GaussianSplat } from 'three/addons/objects/GaussianSplat.js';
import { CSPLATLoader } from 'csplat-decoder/three';

const words = document.querySelector('#words');
const renderer = new THREE.WebGPURenderer({ canvas: document.querySelector('canvas') });
renderer.outputColorSpace = THREE.LinearSRGBColorSpace; // colours of splats are those of the display already
renderer.setSize(innerWidth, innerHeight, false);
const camera = new THREE.PerspectiveCamera(45, innerWidth / innerHeight, 0.01, 1000);
const controls = new OrbitControls(camera, renderer.domElement);
addEventListener('resize', () => {
  renderer.setSize(innerWidth, innerHeight, false);
  camera.aspect = innerWidth / innerHeight;
  camera.updateProjectionMatrix();
});
const scene = new THREE.Scene();
try {
  const url = new URLSearchParams(location.search).get('scene') ?? 'scene.csplat';
  const geometry = await new CSPLATLoader().loadAsync(url, ({ loaded }) => (words.textContent = `${loaded} bytes`));
  const splats = new GaussianSplat(geometry);
  splats.applyMatrix4(geometry.userData.csplat.upright);
  scene.add(splats);
  const { center, radius } = geometry.userData.csplat.bounds;
  camera.position.copy(controls.target.fromArray(center)).add(new THREE.Vector3(0, radius, 3 * radius));
  renderer.setAnimationLoop(() => controls.update() | renderer.render(scene, camera));
  words.textContent = '';
} catch (error) {
  words.textContent = error.message;
}
