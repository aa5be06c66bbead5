// What the engine wants of a back end, and the choice of one. A WebGPU back end would join here.

import { WebGl2Renderer } from './webgl2.mjs';

/** @typedef {import('./types.d.ts').PictureFormat} PictureFormat */

/**
 * What is known of a scene before its tiles arrive.
 *
 * @typedef {object} SceneLayout
 * @property {{splatCount: number, corner: number[], step: number}[]} tiles
 * @property {number} shDegree
 * @property {boolean} antialiased opacities are to be compensated for the dilation
 * @property {number} opacityLevels
 * @property {boolean} opacitySquare alpha is (q / levels)², not q / levels
 * @property {number} quatLevels
 *
 * @typedef {object} Capabilities
 * @property {string} name of the device, as the driver tells it
 * @property {PictureFormat} pictureFormat of the picture before it is shown
 * @property {number} splatsMax splats for which there is room
 *
 * Bytes on the GPU: attributes and tables; the order of splats; targets and projected splats.
 *
 * @typedef {{attributes: number, order: number, work: number}} Bytes
 *
 * Draws splats. Slots number the splats: tile after tile, as `layoutSlots` of texels.mjs says. What has not been uploaded
 * must not stand in the order. All methods but `dispose` may do nothing once the context is lost.
 *
 * @typedef {object} Renderer
 * @property {Capabilities} capabilities
 * @property {Bytes} bytes
 * @property {(scene: SceneLayout) => void} allocate make room for a scene, in the place of the one before; throws a
 *   RangeError where there is too little
 * @property {(tile: number, texels: import('./texels.mjs').GeometryTexels) => void} uploadGeometry layer 0 of a tile
 * @property {(codebook: number, layer: number, rows: import('./texels.mjs').Rows) => void} uploadTable entries of a codebook
 * @property {(tile: number, layer: number, band: import('./texels.mjs').BandTexels) => void} uploadBand an SH band of a
 *   tile, after the table it names; a codebook's lowest band first
 * @property {() => void} complete everything has been uploaded: give back what was kept in reserve
 * @property {(order: Uint32Array, count: number) => void} setOrder slots, the farthest first
 * @property {(view: import('./types.d.ts').View, look: {background: number[], shDegree: number}) => void} draw to the
 *   canvas, whose size the view has
 * @property {() => Uint8Array} readPixels what `draw` has drawn just before, RGBA, the top row first
 * @property {() => Promise<void>} finished resolves when the GPU has done what it has been told
 * @property {() => void} wait the same, holding everything up
 * @property {() => void} dispose free everything
 */

/**
 * The best back end that the browser has.
 *
 * @param {HTMLCanvasElement} canvas
 * @param {PictureFormat} [format] of the picture before it is shown; without it the fastest that does not show
 * @returns {Renderer | null} null where there is none
 */
export function createRenderer(canvas, format) {
  return WebGl2Renderer.create(canvas, format);
}
