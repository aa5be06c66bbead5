// SPDX-License-Identifier: Apache-2.0
// Types of the adapter for Spark.
import type { SplatMesh } from '@sparkjsdev/spark';
import type { LoadOptions, SceneFacts, SceneSource } from './options.d.ts';

export interface SparkOptions extends LoadOptions {
  /**
   * `packed` for PackedSplats (float16 centres; 16 bytes and 40 of SH per splat), `ext` for ExtSplats (float32 centres; 32
   * and 64). Default: packed if float16 is off by at most one step of the file anywhere in the scene; ext with `levels`.
   */
  layout?: 'packed' | 'ext';
}

export type CsplatMesh = SplatMesh & { userData: { csplat: SceneFacts } };

/**
 * Loads a file as Spark's SplatMesh, rotated upright by the header's axes for a world whose y is up. The engine's `dispose`
 * frees arrays and textures, and ends a load that is not complete.
 * Opacity compensation is an option of the renderer: Spark's default suits scenes whose header has `antialiased`, others
 * require `new SparkRenderer({ renderer, preBlurAmount: 0.3, blurAmount: 0 })`. Rejects with CsplatError.
 */
export function loadCsplat(from: SceneSource, options?: SparkOptions): Promise<CsplatMesh>;
