// Types of the adapter for Spark.
import type { SplatMesh } from '@sparkjsdev/spark';
import type { LoadOptions, SceneFacts, SceneSource } from './options.d.ts';

export interface SparkOptions extends LoadOptions {
  /**
   * `packed` for PackedSplats (float16 centres; 16 bytes and 40 of SH for a splat), `ext` for ExtSplats (float32 centres; 32
   * and 64). By default packed where float16 is off by no more than a step of the file's anywhere in the scene.
   */
  layout?: 'packed' | 'ext';
}

export type CsplatMesh = SplatMesh & { userData: { csplat: SceneFacts } };

/**
 * Spark's SplatMesh of a file, turned upright by the header's axes for a world whose y is up. `dispose`, of the engine, frees
 * arrays and textures, and ends a load that is not complete.
 * Opacity compensation is a switch of the renderer: Spark's default is that of scenes whose header says `antialiased`, others
 * want `new SparkRenderer({ renderer, preBlurAmount: 0.3, blurAmount: 0 })`. Rejects with CsplatError.
 */
export function loadCsplat(from: SceneSource, options?: SparkOptions): Promise<CsplatMesh>;
