// SPDX-License-Identifier: Apache-2.0
// Records what a viewer shows while a scene arrives: small images of its canvas and their times.
// `begin` does not wait; `state` reports progress, `pictures` returns the images.

const WIDTH = 160, HEIGHT = 120;

const seen = [];
let failed = '', version = '', whole = false, drawn = false, changed = 0, frames = 0;

/** Shows a file, and records an image after every frame in which something was drawn. */
export function begin(viewer, url, camera) {
  keepBuffers();
  noticeDrawing();
  const small = document.createElement('canvas');
  small.width = WIDTH;
  small.height = HEIGHT;
  const ink = small.getContext('2d', { willReadFrequently: true });
  const canvas = document.querySelector('canvas');
  let last = new Uint32Array(0);
  const frame = () => {
    frames++;
    if (drawn) look();
    requestAnimationFrame(frame);
  };
  const look = () => {
    drawn = false;
    const from = [...document.querySelectorAll('canvas')].at(-1); // a viewer may add its own
    ink.fillRect(0, 0, WIDTH, HEIGHT);
    if (from.width && from.height) ink.drawImage(from, 0, 0, WIDTH, HEIGHT);
    const { data } = ink.getImageData(0, 0, WIDTH, HEIGHT); // waits until it is drawn
    const words = new Uint32Array(data.buffer);
    if (words.some((word, i) => word !== last[i])) {
      changed = performance.now();
      frames = 0;
      seen.push({ at: performance.timeOrigin + changed, data });
      last = words;
    }
  };
  frame();
  show(viewer, canvas, url, camera).catch((error) => { failed = String(error?.message ?? error); });
}

async function show(viewer, canvas, url, camera) {
  const page = await import(`/pages/${viewer}.mjs`);
  version = page.version;
  await (await page.show(canvas, url, camera, { progressive: true, levels: true })).whole;
  whole = true;
}

/** Progress, and for how many milliseconds and frames the image has been the same. */
export const state = () => ({ failed, version, whole, still: performance.now() - changed, frames, pictures: seen.length });

/** Every image that differs from the one before: milliseconds since the epoch, RGBA in base64. */
export function pictures() {
  return seen.map(({ at, data }) => {
    let text = '';
    for (let i = 0; i < data.length; i += 8192) text += String.fromCharCode(...data.subarray(i, i + 8192));
    return [at, btoa(text)];
  });
}

// Drawn content stays in the canvas until the next frame, whichever engine draws.
function keepBuffers() {
  const get = HTMLCanvasElement.prototype.getContext;
  HTMLCanvasElement.prototype.getContext = function (kind, options) {
    return get.call(this, kind, kind.startsWith('webgl') ? { ...options, preserveDrawingBuffer: true } : options);
  };
}

function noticeDrawing() {
  const calls = WebGL2RenderingContext.prototype;
  for (const name of ['clear', 'drawArrays', 'drawElements', 'drawArraysInstanced', 'drawElementsInstanced', 'blitFramebuffer']) {
    const call = calls[name];
    calls[name] = function (...words) {
      drawn = true;
      return call.apply(this, words);
    };
  }
}
