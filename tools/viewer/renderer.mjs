// SPDX-License-Identifier: Apache-2.0
// The interface of rendering back ends, and the choice of one.

import { WebGl2Renderer } from './webgl2.mjs';
import { WebGpuRenderer } from './webgpu.mjs';

/** @typedef {import('./types.d.ts').PictureFormat} PictureFormat */

/**
 * Properties of a scene that are known before its tiles arrive.
 *
 * @typedef {object} SceneLayout
 * @property {{splatCount: number, corner: number[], step: number}[]} tiles
 * @property {number[]} pages slots of each page, see `pagesOf` of texels.mjs
 * @property {number} drawn number of splats that a picture usually has at most
 * @property {number} shDegree
 * @property {boolean} antialiased opacities are compensated for the dilation
 * @property {number} opacityLevels
 * @property {boolean} opacitySquare alpha is (q / levels)², not q / levels
 * @property {number} quatLevels
 *
 * @typedef {object} Capabilities
 * @property {string} name name of the device, as reported by the driver
 * @property {PictureFormat} pictureFormat format of the picture before it is shown
 * @property {number} splatsMax maximum number of splats
 * @property {number} sideMax maximum width and height of a picture, pixels
 * @property {boolean} sorts whether it culls and sorts on the GPU, and needs no order
 *
 * Bytes on the GPU: attributes and tables; the order of splats; render targets and projected splats.
 *
 * @typedef {{attributes: number, order: number, work: number}} Bytes
 *
 * How to draw: the background, red, green, blue and alpha, premultiplied, 0 to 1; SH bands up to a degree.
 *
 * @typedef {{background: number[], shDegree: number}} Look
 *
 * The memory of a scene on the GPU.
 *
 * @typedef {object} SceneMemory
 * @property {(tile: number, texels: import('./texels.mjs').GeometryTexels, slot: number) => void} putGeometry layer 0
 *   of a tile, and the slot of its first splat
 * @property {(tile: number) => void} evict free the memory of a tile, which the order has no splats of
 * @property {(codebook: number, layer: number, rows: import('./texels.mjs').Rows) => void} putTable entries of a codebook
 * @property {(tile: number, layer: number, band: import('./texels.mjs').BandTexels) => void} putBand an SH band of a
 *   tile, after the table it refers to; a codebook's lowest band first
 * @property {(order: Uint32Array, count: number) => void} putOrder slots, farthest first, for renderers that do not sort
 * @property {(shares: Map<number, number>) => void} setShares the tiles to draw, and their shares, see `fadedAlpha`; all of
 *   all tiles if it is never called
 *
 * Draws splats, each in a slot. The order must not contain splats that are not there. All methods but `dispose` may do nothing after the context or the GPU is lost.
 *
 * @typedef {object} Renderer
 * @property {Capabilities} capabilities
 * @property {Bytes} bytes
 * @property {(scene: SceneLayout) => void} allocate replace the previous scene and allocate memory for a new one; throws
 *   a RangeError if there is not enough
 * @property {SceneMemory | null} scene
 * @property {() => void} complete everything has been uploaded: free reserved memory
 * @property {(view: import('./types.d.ts').View, look: Look) => void} draw to the canvas, which has the size of the view
 * @property {(view: import('./types.d.ts').View, look: Look) => Uint8Array<ArrayBuffer> | Promise<Uint8Array<ArrayBuffer>>} pixelsOf draw a picture of
 *   any size and return it: RGBA, premultiplied, top row first; empty if the GPU is lost. Throws a RangeError if there is not
 *   enough memory
 * @property {() => Promise<void>} finished resolves when the GPU has completed its work
 * @property {() => void | Promise<void>} wait do the same, synchronously if possible
 * @property {() => void} dispose free everything
 */

/**
 * What to call when drawing becomes impossible.
 *
 * @typedef {object} Losses
 * @property {(hasDrawn: boolean) => void} lost the GPU of WebGPU is lost; whether it has drawn anything
 * @property {(code: string, message: string) => void} failed WebGPU reports an error, such as too little memory
 */

/**
 * Create a back end.
 *
 * @param {HTMLCanvasElement} canvas
 * @param {Pick<import('./types.d.ts').EngineOptions, 'backend' | 'background' | 'pictureFormat'>} options
 * @param {Losses} losses
 * @returns {Promise<Renderer | null>} null if there is none
 */
export async function createRenderer(canvas, { backend = 'auto', background, pictureFormat }, losses) {
  const alpha = background === 'transparent';
  const renderer = backend === 'webgl2' ? null : await WebGpuRenderer.create(canvas, backend, alpha, losses);
  return renderer ?? WebGl2Renderer.create(canvas, alpha, pictureFormat);
}
