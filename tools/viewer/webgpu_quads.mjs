// SPDX-License-Identifier: Apache-2.0
// Blends records as quads in half floats, by the hardware for rasterising and blending: less exact than screen tiles, and
// faster on some GPUs.

import { GROUPS } from './webgpu_projection.mjs';
import * as WGSL from './wgsl.mjs';

/** @typedef {import('./webgpu_projection.mjs').Projection} Projection */

const FORMAT = 'rgba16float';

export class Quads {
  name = 'quads';
  presents = /** @type {const} */ ('present_quads');
  pairs = 0;
  isFarthestFirst = true;

  /** @param {Projection} projection */
  constructor(projection) {
    this.projection = projection;
    /** @type {GPURenderPipeline | null} */
    this.pipeline = null;
    /** @type {GPUTexture | null} */
    this.picture = null;
    /** @type {GPUBindGroup | null} */
    this.group = null;
  }

  /**
   * @param {{width: number, height: number}} view
   * @returns {[number, number][]} the rows of the picture, as one band
   */
  prepare({ width, height }) {
    if (this.picture?.width !== width || this.picture.height !== height) {
      this.forget();
      this.picture = this.projection.device.picture(width, height, FORMAT);
    }
    return [[0, height]];
  }

  /**
   * Blend the records of a slice.
   *
   * @param {GPUCommandEncoder} encoder
   * @param {boolean} isFirst whether the picture is empty
   */
  encode(encoder, isFirst) {
    if (!this.picture) return;
    const { device, groups, view, counters, records } = this.projection;
    const pipeline = (this.pipeline ??= quadPipeline(device.device));
    this.group ??= device.device.createBindGroup({
      layout: pipeline.getBindGroupLayout(0),
      entries: [view, counters, records.order, records.ellipses, records.looks].map((buffer, binding) => ({
        binding,
        resource: { buffer },
      })),
    });
    const pass = encoder.beginRenderPass({
      colorAttachments: [
        {
          view: this.picture.createView(),
          loadOp: isFirst ? 'clear' : 'load',
          storeOp: 'store',
        },
      ],
    });
    pass.setPipeline(pipeline);
    pass.setBindGroup(0, this.group);
    pass.drawIndirect(groups, GROUPS.drawQuads);
    pass.end();
  }

  /** @returns {GPUBindGroupEntry[]} the picture, for present.wgsl */
  get entries() {
    return this.picture ? [{ binding: 2, resource: this.picture.createView() }] : [];
  }

  /** Free the picture. */
  forget() {
    this.projection.device.free(this.picture);
    this.picture = this.group = null;
  }
}

/** @param {GPUDevice} device */
function quadPipeline(device) {
  const module = device.createShaderModule({ label: 'quads', code: `${WGSL.COMMON}\n${WGSL.QUADS}` });
  const over = /** @type {GPUBlendComponent} */ ({ srcFactor: 'one', dstFactor: 'one-minus-src-alpha' });
  return device.createRenderPipeline({
    layout: 'auto',
    vertex: { module, entryPoint: 'corner' },
    fragment: { module, entryPoint: 'splat', targets: [{ format: FORMAT, blend: { color: over, alpha: over } }] },
    primitive: { topology: 'triangle-strip' },
  });
}
