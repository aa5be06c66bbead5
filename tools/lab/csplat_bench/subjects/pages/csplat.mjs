// SPDX-License-Identifier: Apache-2.0
// The viewer of this project: its engine alone, on a canvas.
import { createEngine } from '/tools/viewer/engine.mjs';

export const version = '';

export async function show(canvas, url, { view, fovY, width, height, near }) {
  const engine = await createEngine(canvas);
  engine.setSize(width, height);
  const f = height / 2 / Math.tan((fovY * Math.PI) / 360);
  const viewmat = view.map((_, i) => view[4 * (i % 4) + Math.floor(i / 4)]);
  engine.setCamera({ viewmat, fx: f, fy: f, cx: width / 2, cy: height / 2, near });
  return { whole: engine.open(url).then(() => engine.settled()) };
}
