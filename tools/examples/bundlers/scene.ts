// SPDX-License-Identifier: Apache-2.0
// scene.ts
import { LinearSRGBColorSpace, PerspectiveCamera, Scene, WebGPURenderer } from 'three/webgpu';
import { GaussianSplat } from 'three/addons/objects/GaussianSplat.js';
import { CSPLATLoader, type SplatGeometry } from 'csplat-decoder/three';
import { encodePly } from 'csplat-encoder';

/** Load a scene; a PLY is encoded in a worker first. */
export async function load(url: string, signal?: AbortSignal): Promise<SplatGeometry> {
  const loader = new CSPLATLoader().setOptions({ signal });
  if (!url.endsWith('.ply')) return loader.loadAsync(url);
  const ply = await (await fetch(url, { signal })).arrayBuffer();
  const { file } = await encodePly(ply, { worker: true, signal });
  return (await loader.parse(file.buffer))!;
}

/** Draw a scene until the signal aborts; resolve with the number of splats. */
export async function show(canvas: HTMLCanvasElement, url: string, signal?: AbortSignal): Promise<number> {
  const geometry = await load(url, signal);
  const { bounds, refine, splatCount, upright } = geometry.userData.csplat;
  const splats = new GaussianSplat(geometry);
  splats.applyMatrix4(upright);
  refine(splats);
  const [x, y, z] = bounds.centre;
  const camera = new PerspectiveCamera(45, canvas.clientWidth / canvas.clientHeight, 0.01, 1000);
  camera.position.set(x, y + bounds.radius, z + 3 * bounds.radius);
  camera.lookAt(x, y, z);
  const renderer = new WebGPURenderer({ canvas });
  renderer.outputColorSpace = LinearSRGBColorSpace; // colours of splats are those of the display already
  renderer.setSize(canvas.clientWidth, canvas.clientHeight, false);
  const scene = new Scene().add(splats);
  await renderer.setAnimationLoop(() => renderer.render(scene, camera));
  signal?.addEventListener('abort', () => {
    geometry.dispose();
    renderer.dispose();
  });
  return splatCount;
}
