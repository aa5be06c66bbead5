// SPDX-License-Identifier: Apache-2.0
// Types of the loader for three.js.

import type { BufferGeometry, Loader, LoadingManager, Matrix4 } from 'three';
import type { GaussianSplat } from 'three/addons/objects/GaussianSplat.js';
import type { LoadOptions, SceneFacts } from './options.d.ts';

export type { LoadOptions };

export type SplatGeometry = BufferGeometry & {
  userData: {
    /** `complete` resolves to the geometry with SH: the same one, or after a progressive load another one, for a new
     * GaussianSplat. */
    csplat: SceneFacts<SplatGeometry> & {
      /** From the file's coordinates to those of the geometry, which are right, up, back if signs suffice for that. */
      fromFile: Matrix4;
      /** Makes the object upright: `splats.applyMatrix4(geometry.userData.csplat.upright)`. The identity, unless the file
       * has an up direction or axes that signs alone do not change to these. */
      upright: Matrix4;
      /** Bounds the object without splats far away, since it sorts in 4,096 steps of its bounding sphere. With the option
       * `levels`: from now on, it draws what the camera of each frame requires. */
      refine(splats: GaussianSplat): void;
    };
  };
};

/** Loads `.csplat` as the geometry that `SPZLoader` of three/addons returns, for its `GaussianSplat`. Invalid files cause `CsplatError`s. */
export class CSPLATLoader extends Loader<SplatGeometry> {
  constructor(manager?: LoadingManager);
  setOptions(options: LoadOptions): this;
  load(
    url: string,
    onLoad: (geometry: SplatGeometry) => void,
    onProgress?: (event: ProgressEvent) => void,
    onError?: (error: unknown) => void,
  ): void;
  loadAsync(url: string, onProgress?: (event: ProgressEvent) => void): Promise<SplatGeometry>;
  /** Load a file in memory; undefined if an error went to onError. */
  parse(
    buffer: ArrayBuffer,
    onLoad?: (geometry: SplatGeometry) => void,
    onError?: (error: unknown) => void,
  ): Promise<SplatGeometry | undefined>;
  /** Abort all loads of this loader. */
  abort(): this;
}
