// SPDX-License-Identifier: Apache-2.0
// Decoders of others in JavaScript, bundled for Node and pages; exports as in csplat.mjs. Each loads only its own package.

const geometry = (loader) => async (bytes) => {
  const { attributes } = await loader.parse(bytes.buffer);
  return Object.values(attributes).map(({ array }) => array);
};

export async function adobe() {
  const spz = await (await import('@adobe/spz')).default({ print() {} });
  return (bytes) => spz.loadSpzFromBuffer(bytes, { to: spz.CoordinateSystem.UNSPECIFIED });
}

export async function threeSpz() {
  return geometry(new (await import('three/addons/loaders/SPZLoader.js')).SPZLoader());
}

export async function threeKsplat() {
  return geometry(new (await import('three/addons/loaders/KSPLATLoader.js')).KSPLATLoader());
}

export async function threeSplat() {
  return geometry(new (await import('three/addons/loaders/SPLATLoader.js')).SPLATLoader());
}

export async function gaussianSplats3d() {
  globalThis.window ??= globalThis; // it reads setTimeout from it
  const { SpzLoader } = await import('@mkkellogg/gaussian-splats-3d');
  return async (bytes) => [new Uint8Array((await SpzLoader.loadFromFileData(bytes.buffer, 0, 0, false, 2)).bufferData)];
}

export async function spark() {
  const { PackedSplats } = await import('@sparkjsdev/spark');
  return async (fileBytes) => {
    const { packedArray, extra } = await new PackedSplats({ fileBytes, fileType: 'spz' }).initialized;
    return [packedArray, ...Object.values(extra)];
  };
}
