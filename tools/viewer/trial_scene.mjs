// SPDX-License-Identifier: Apache-2.0
// A small scene: to check whether a GPU draws what it should, so that WebGPU is chosen only where it works, and to compile
// shaders before a scene arrives.

import { packGeometry, pagesOf } from './texels.mjs';

const SIZE = 32; // pixels
const FOCAL = 12; // pixels
const LEVELS = 100; // of opacity
const TOLERANCE = 2; // of 255
const DILATION = 0.3;
const BACKGROUND = [0, 0, 1, 1];
const IDENTITY = [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1];

/** Two balls of a radius of one unit on the axis of the camera, the farther one first. */
const BALLS = [
  { depth: 6, opacity: 80, sh0: [2, 0, 0] },
  { depth: 3, opacity: 50, sh0: [0, 3, 1] },
];

/** Some pixels: inside both balls, at their edges, and outside. */
const PIXELS = [
  [16, 16],
  [13, 18],
  [20, 12],
  [16, 25],
  [1, 1],
];

/**
 * Draw the scene once and clear the canvas: a driver compiles shaders when it draws with them first.
 *
 * @param {import('./webgl2.mjs').WebGl2Renderer} renderer without a scene
 */
export function warmUp(renderer) {
  const view = putTrialScene(renderer);
  renderer.scene?.putOrder(Uint32Array.of(0, 1), BALLS.length);
  for (let time = 0; time < 2; time++) {
    renderer.draw(view, { background: [0, 0, 0, 1], shDegree: 0 });
    renderer.allocate(null);
  }
}

/**
 * Draw a small scene by both methods.
 *
 * @param {import('./webgpu.mjs').WebGpuRenderer} renderer without a scene
 */
export async function isSound(renderer) {
  const chosen = renderer.method;
  const view = putTrialScene(renderer);
  let isRight = true;
  for (const method of [renderer.tiles, renderer.quads]) {
    renderer.use(method);
    const pixels = await renderer.pixelsOf(view, { background: BACKGROUND, shDegree: 0 }, 1);
    for (const [x, y] of PIXELS) {
      expectedAt(x, y).forEach((value, c) => {
        isRight &&= Math.abs(255 * value - pixels[4 * (SIZE * y + x) + c]) <= TOLERANCE;
      });
    }
  }
  renderer.allocate(null);
  renderer.use(chosen);
  return isRight;
}

/**
 * Let a renderer hold the scene, and return a view of it.
 *
 * @param {import('./renderer.mjs').Renderer} renderer
 */
function putTrialScene(renderer) {
  const column = (/** @type {number[]} */ ...columns) => ({
    columns: Uint32Array.from(columns),
    offsets: [0, 0, 0],
    step: 1,
  });
  const depths = BALLS.map(({ depth }) => depth);
  const channels = [0, 1, 2].flatMap((c) => BALLS.map(({ sh0 }) => sh0[c]));
  const geometry = {
    count: BALLS.length,
    means: column(0, 0, 0, 0, ...depths),
    opacities: column(...BALLS.map(({ opacity }) => opacity)),
    scales: column(0, 0, 0, 0, 0, 0), // logarithms
    quats: column(0, 0, 0, 0, 0, 0), // x y z
    sh0: column(...channels),
  };
  const layout = { antialiased: false, opacityLevels: LEVELS, opacitySquare: false, quatLevels: LEVELS };
  const tiles = [{ splatCount: BALLS.length, corner: [0, 0, 0], step: 1 }];
  const { pages } = pagesOf(tiles, Infinity);
  renderer.allocate({ ...layout, shDegree: 0, tiles, pages, drawn: BALLS.length });
  renderer.scene?.putGeometry(0, packGeometry(geometry, { levels: LEVELS }, { levels: LEVELS }), 0);
  const half = SIZE / 2;
  return { viewmat: IDENTITY, fx: FOCAL, fy: FOCAL, cx: half, cy: half, width: SIZE, height: SIZE, near: 0.2 };
}

/**
 * Return the colour of a pixel.
 *
 * @param {number} x
 * @param {number} y
 */
function expectedAt(x, y) {
  let colour = BACKGROUND.slice(0, 3);
  for (const { depth, opacity, sh0 } of BALLS) {
    const variance = (FOCAL / depth) ** 2 + DILATION;
    const squared = (x + 0.5 - SIZE / 2) ** 2 + (y + 0.5 - SIZE / 2) ** 2;
    const falloff = (opacity / LEVELS) * Math.exp((-0.5 * squared) / variance);
    const alpha = falloff >= 1 / 255 ? falloff : 0;
    colour = colour.map((behind, c) => alpha * (0.5 + 0.28209479177387814 * sh0[c]) + (1 - alpha) * behind);
  }
  return colour.map((value) => Math.min(1, value));
}
