// Types of the plugin for Babylon.js. To import the module registers it.

import type { AssetContainer } from '@babylonjs/core/assetContainer.js';
import type { GaussianSplattingMesh } from '@babylonjs/core/Meshes/GaussianSplatting/gaussianSplattingMesh.js';
import type { Scene } from '@babylonjs/core/scene.js';

/** What stands in `metadata.csplat` of a mesh. */
export interface SplatMetadata {
  /** Letters of the directions of +x, +y, +z, or empty where they are not known. */
  axes: string;
  antialiased: boolean;
  /** What the positions are relative to. */
  origin: number[];
  /** Metres per unit, 0 where unknown. */
  unitMetres: number;
  /** The direction that is up, where the metadata has it. */
  up: number[] | null;
  metadata: Record<string, unknown> | null;
}

/** `pluginOptions: { csplat: … }` of the scene loader. */
export interface CSPLATLoadingOptions {
  /** As GaussianSplattingMesh has it. */
  keepInRam?: boolean;
}

export interface CSPLATImport {
  meshes: GaussianSplattingMesh[];
  particleSystems: never[];
  skeletons: never[];
  animationGroups: never[];
  transformNodes: never[];
  geometries: never[];
  lights: never[];
  spriteManagers: never[];
}

/** The plugin. A file's `CsplatError` is the `innerError` of what the scene loader rejects with. */
export class CSPLATFileLoader {
  constructor(options?: CSPLATLoadingOptions);
  readonly name: 'csplat';
  readonly extensions: { '.csplat': { isBinary: true; mimeType: 'model/vnd.csplat' } };
  createPlugin(options: { csplat?: CSPLATLoadingOptions }): CSPLATFileLoader;
  importMeshAsync(names: unknown, scene: Scene, data: ArrayBuffer | Uint8Array<ArrayBuffer>): Promise<CSPLATImport>;
  loadAsync(scene: Scene, data: ArrayBuffer | Uint8Array<ArrayBuffer>): Promise<void>;
  loadAssetContainerAsync(scene: Scene, data: ArrayBuffer | Uint8Array<ArrayBuffer>): Promise<AssetContainer>;
}
