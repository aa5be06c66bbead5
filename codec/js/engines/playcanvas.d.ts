// Types of the adapter for PlayCanvas.
import type { AppBase, Asset, Entity, GSplatResourceBase } from 'playcanvas';
import type { LoadOptions, SceneFacts } from './options.d.ts';

/** What `asset.resource` is. The integers of the file lie in textures; `destroy`, of the engine, frees them and ends a load. */
export interface CsplatResource extends GSplatResourceBase {
  csplat: SceneFacts;
  /** Turn an entity so that the scene stands upright, by its axes and `up` of the metadata, and draw it again once it is complete. */
  stand(entity: Entity): void;
}

/**
 * Loads assets of type `gsplat` whose name ends in `.csplat`. The asset fires `progress` with bytes received and those of the
 * file; `error` with the decoder's CsplatError, and nothing is left behind then. Opacity compensation is
 * `app.scene.gsplat.antiAlias`.
 */
export class CsplatParser {
  constructor(app: AppBase, options?: LoadOptions);
  canParse(context: { ext: string }): boolean;
  load(url: string | { load: string }, callback: (error: any, resource?: CsplatResource) => void, asset?: Asset): void;
  open(url: string, data: unknown): unknown;
}
