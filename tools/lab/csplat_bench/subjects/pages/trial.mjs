// SPDX-License-Identifier: Apache-2.0
// An engine on a canvas, and loads that succeed, fail or are aborted. GPU memory is counted from the calls to WebGL, so
// that this module must be imported before the engine.

const TEXEL = {
  R8: 1, R8UI: 1, RG8: 2, RG8UI: 2, R16F: 2, R16UI: 2, RGBA8: 4, SRGB8_ALPHA8: 4, RGBA8UI: 4, RG16F: 4, RG16UI: 4, R32F: 4,
  R32UI: 4, R32I: 4, RGB10_A2: 4, R11F_G11F_B10F: 4, RGBA16F: 8, RGBA16UI: 8, RG32F: 8, RG32UI: 8, RGBA32F: 16, RGBA32UI: 16,
  DEPTH_COMPONENT16: 2, DEPTH_COMPONENT24: 4, DEPTH_COMPONENT32F: 4, DEPTH24_STENCIL8: 4, DEPTH32F_STENCIL8: 8,
};
const GL = WebGL2RenderingContext.prototype;
const texelBytes = new Map(Object.entries(TEXEL).map(([name, bytes]) => [GL[name], bytes]));
const live = new Map(); // bytes by object

const BINDINGS = {
  TEXTURE_2D: 'TEXTURE_BINDING_2D', TEXTURE_2D_ARRAY: 'TEXTURE_BINDING_2D_ARRAY', TEXTURE_3D: 'TEXTURE_BINDING_3D',
  ARRAY_BUFFER: 'ARRAY_BUFFER_BINDING', ELEMENT_ARRAY_BUFFER: 'ELEMENT_ARRAY_BUFFER_BINDING',
  UNIFORM_BUFFER: 'UNIFORM_BUFFER_BINDING', PIXEL_UNPACK_BUFFER: 'PIXEL_UNPACK_BUFFER_BINDING',
  PIXEL_PACK_BUFFER: 'PIXEL_PACK_BUFFER_BINDING', TRANSFORM_FEEDBACK_BUFFER: 'TRANSFORM_FEEDBACK_BUFFER_BINDING',
  COPY_WRITE_BUFFER: 'COPY_WRITE_BUFFER_BINDING', COPY_READ_BUFFER: 'COPY_READ_BUFFER_BINDING',
};
const bindings = new Map(Object.entries(BINDINGS).map(([target, binding]) => [GL[target], GL[binding]]));

count('texStorage2D', (_levels, format, width, height) => width * height * (texelBytes.get(format) ?? 4));
count('texStorage3D', (_levels, format, width, height, depth) => width * height * depth * (texelBytes.get(format) ?? 4));
count('texImage2D', (level, format, width, height) =>
  level === 0 && typeof height === 'number' ? width * height * (texelBytes.get(format) ?? 4) : null,
);
count('texImage3D', (level, format, width, height, depth) => (level === 0 ? width * height * depth * (texelBytes.get(format) ?? 4) : null));
count('bufferData', (data, _usage, _offset, length) =>
  typeof data === 'number' ? data : length ? length * data.BYTES_PER_ELEMENT : (data?.byteLength ?? 0),
);
for (const name of ['deleteTexture', 'deleteBuffer']) {
  const own = GL[name];
  GL[name] = function (object) {
    live.delete(object);
    return own.call(this, object);
  };
}

function count(name, bytesOf) {
  const own = GL[name];
  GL[name] = function (target, ...rest) {
    const bytes = bytesOf(...rest);
    const object = bindings.has(target) && bytes !== null ? this.getParameter(bindings.get(target)) : null;
    if (object) live.set(object, bytes);
    return own.call(this, target, ...rest);
  };
}

export const gpuBytes = () => [...live.values()].reduce((sum, bytes) => sum + bytes, 0);

let stage, shown;

/** Starts an engine; returns its version. */
export async function start(engine, camera, options) {
  const page = await import(`/pages/${engine}.mjs`);
  stage = await page.start(document.querySelector('canvas'), camera, options);
  return page.version;
}

const frames = async (count) => {
  for (let i = 0; i < count; i++) await new Promise((resolve) => requestAnimationFrame(resolve));
};

/** Shows a scene until it is complete; returns the failure, if any. `abortAt`: bytes received. */
export async function show(url, camera, { abortAt, ...options } = {}) {
  const begun = performance.now();
  const controller = new AbortController();
  if (abortAt !== undefined) {
    options.signal = controller.signal;
    options.onProgress = (received) => received >= abortAt && controller.abort();
  }
  try {
    shown = await stage.show(url, camera, options);
    await frames(1);
    await shown.whole;
    await frames(2);
    return { world: shown.world, count: shown.count };
  } catch (error) {
    const { name, code = '', message } = cause(error);
    return { failed: { name, code, message, ms: performance.now() - begun } };
  }
}

/** Some engines wrap a loader's error. */
const cause = (error) => (error.innerError ? cause(error.innerError) : error);

/** Moves the camera. */
export const look = (camera) => stage.look(camera, shown.world);

/** What is drawn of a file with levels of detail, and whether all that the camera requires is. */
export const levels = () => {
  const { splatCount, isComplete } = shown.levels;
  return { splatCount, isComplete };
};

/** Removes the scene. */
export async function remove() {
  shown.remove();
  await frames(2);
}

/** Shows and removes a scene, `times` times. */
export async function repeat(url, camera, times) {
  for (let i = 0; i < times; i++) {
    await show(url, camera);
    await remove();
  }
}
