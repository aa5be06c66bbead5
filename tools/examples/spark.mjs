// SPDX-License-Identifier: Apache-2.0
// spark.mjs
import * as THREE from 'three';
import { OrbitControls } from 'three/addons/controls/OrbitControls.js';
import { SparkRenderer } from '@sparkjsdev/spark';
import { loadCsplat } from 'csplat-decoder/spark';

const words = document.querySelector('#words');
const renderer = new THREE.WebGLRenderer({ canvas: document.querySelector('canvas'), antialias: false });
const camera = new THREE.PerspectiveCamera(45, 1, 0.01, 1000);
const scene = new THREE.Scene();
try {
  const url = new URLSearchParams(location.search).get('scene') ?? 'scene.csplat';
  const splats = await loadCsplat(url, { onProgress: (loaded) => (words.textContent = `${loaded} bytes`) });
  const { header, view } = splats.userData.csplat;
  const plain = { preBlurAmount: 0.3, blurAmount: 0 }; // Spark draws every scene as antialiased by default
  scene.add(new SparkRenderer({ renderer, ...(header.antialiased ? {} : plain) }), splats);
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
