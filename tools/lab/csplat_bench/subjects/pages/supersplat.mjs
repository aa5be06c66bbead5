// SPDX-License-Identifier: Apache-2.0
// The viewer of SuperSplat, in an element of its own: it takes scenes in a PLY's axes and rotates them about z.
import { createViewer } from '@playcanvas/supersplat-viewer/viewer.js';

export const version = '1';

export async function show(canvas, url, camera) {
  const container = document.createElement('div');
  container.style = `position: absolute; inset: 0; width: ${camera.width}px; height: ${camera.height}px`;
  const style = Object.assign(document.createElement('link'), { rel: 'stylesheet' });
  style.href = '/node_modules/@playcanvas/supersplat-viewer/dist/viewer.css';
  await new Promise((resolve) => {
    style.onload = resolve;
    document.head.append(style);
  });
  document.body.append(container);
  const off = { enabled: false };
  const viewer = await createViewer({
    container, contentUrl: url, renderer: 'webgl', ui: false, noanim: true, nofx: true,
    settings: {
      version: 2, tonemapping: 'none', highPrecisionRendering: false, background: { color: [0, 0, 0] },
      postEffectSettings: {
        sharpness: { ...off, amount: 0 }, bloom: { ...off, intensity: 1, blurLevel: 2 },
        grading: { ...off, brightness: 1, contrast: 1, saturation: 1, tint: [1, 1, 1] },
        vignette: { ...off, intensity: 0, inner: 0, outer: 1, curvature: 1 }, fringing: { ...off, intensity: 0 },
      },
      animTracks: [], annotations: [], startMode: 'default', cameras: [{ initial: poseOf(camera) }],
    },
  });
  const whole = new Promise((resolve) => {
    if (viewer.state.loaded) resolve();
    else viewer.events.on('loaded:changed', () => resolve());
  });
  return { whole };
}

// Position and target; the viewer's up is the world's, whose x and y are the file's negated.
function poseOf({ view, fovY, depth, width, height }) {
  const turned = ([x, y, z]) => [-x, -y, z];
  const row = (i) => [view[i], view[4 + i], view[8 + i]];
  const eye = [0, 1, 2].map((axis) => -[0, 1, 2].reduce((sum, i) => sum + row(i)[axis] * view[12 + i], 0));
  // The viewer takes the field of view of the wider side.
  const wide = (360 / Math.PI) * Math.atan(Math.tan((fovY * Math.PI) / 360) * Math.max(1, width / height));
  const target = eye.map((value, axis) => value + depth * row(2)[axis]);
  return { position: turned(eye), target: turned(target), fov: wide };
}
