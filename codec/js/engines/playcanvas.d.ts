// SPDX-License-Identifier: Apache-2.0
// Types of the adapter for PlayCanvas.
import type { AppBase, Asset, Entity, GSplatResourceBase } from 'playcanvas';
import type { LoadOptions, SceneFacts } from './options.d.ts';

/** The type of `asset.resource`. Textures hold the integers of the file; the engine's `destroy` frees them and ends a load. */
export interface CsplatResource extends GSplatResourceBase {
  csplat: SceneFacts;
  /**
   * Rotate an entity so that the scene is upright, by its axes and the metadata's `up`, and draw it again once complete. With
   * the option `levels`, entities below it draw the tiles.
   */
  stand(entity: Entity): void;
}

/**
 * Loads assets of type `gsplat` whose name ends in `.csplat`. The asset fires `progress` with the received and total bytes,
 * and `error` with the decoder's CsplatError; a failed load leaves nothing behind. Opacity compensation is the option
 * `app.scene.gsplat.antiAlias`.
 */
export class CsplatParser {
  constructor(app: AppBase, options?: LoadOptions);
  canParse(context: { ext: string }): boolean;
  load(url: string | { load: string }, callback: (error: any, resource?: CsplatResource) => void, asset?: Asset): void;
  open(url: string, data: unknown): unknown;
}
