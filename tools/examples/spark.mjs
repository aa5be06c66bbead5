// SPDX-License-Identifier: Apache-2.0
// spark.mjs
import * as THREE from 'three';
import { OrbitControls } from 'three/addons/controls/OrbitControls.js';
import { SparkRenderer } from '@sparkjsdev/spark';
import { loadCsplat } from 'csplat-decoder/spark';

const words = document.querySelector('#words');
const renderer = new THREE.WebGLRenderer({ canvas: document.querySelector('canvas'), antialias: false });
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
  const splats = await loadCsplat(url, { onProgress: (loaded) => (words.textContent = `${loaded} bytes`) });
  const {
    header,
    bounds: { center, radius },
  } = splats.userData.csplat;
  const plain = { preBlurAmount: 0.3, blurAmount: 0 }; // Spark draws every scene as antialiased by default
  scene.add(new SparkRenderer({ renderer, ...(header.antialiased ? {} : plain) }), splats);
  camera.position.copy(controls.target.fromArray(center)).add(new THREE.Vector3(0, radius, 3 * radius));
  renderer.setAnimationLoop(() => controls.update() | renderer.render(scene, camera));
  words.textContent = '';
} catch (error) {
  words.textContent = error.message;
}
