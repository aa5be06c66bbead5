// SPDX-License-Identifier: Apache-2.0
// Types of the plugin for Babylon.js. Importing the module registers the plugin.

import type { AssetContainer } from '@babylonjs/core/assetContainer.js';
import type { IFileRequest } from '@babylonjs/core/Misc/fileRequest.js';
import type { GaussianSplattingMesh } from '@babylonjs/core/Meshes/GaussianSplatting/gaussianSplattingMesh.js';
import type { Scene } from '@babylonjs/core/scene.js';
import type { LoadOptions, SceneFacts } from './options.d.ts';

/** `pluginOptions: { csplat: … }` of the scene loader. */
export interface CSPLATLoadingOptions extends LoadOptions {
  /** As for GaussianSplattingMesh. */
  keepInRam?: boolean;
}

/** A mesh; `dispose(false, true)` frees it with its material. */
export type CSPLATMesh = GaussianSplattingMesh & { metadata: { csplat: SceneFacts } };

export interface CSPLATImport {
  meshes: CSPLATMesh[];
  particleSystems: never[];
  skeletons: never[];
  animationGroups: never[];
  transformNodes: never[];
  geometries: never[];
  lights: never[];
  spriteManagers: never[];
}

/**
 * The plugin. A load ends if the scene or mesh is disposed, or by `signal`. If a file is invalid, the scene loader rejects
 * with an error whose `innerError` is the `CsplatError`.
 */
export class CSPLATFileLoader {
  constructor(options?: CSPLATLoadingOptions);
  readonly name: 'csplat';
  readonly extensions: { '.csplat': { isBinary: true; mimeType: 'model/vnd.csplat' } };
  createPlugin(options: { csplat?: CSPLATLoadingOptions }): CSPLATFileLoader;
  loadFile(
    scene: Scene,
    from: string | Blob | ArrayBufferView,
    rootUrl: string,
    onSuccess: (opened: unknown) => void,
    onProgress?: (event: { lengthComputable: boolean; loaded: number; total: number }) => void,
    asArrayBuffer?: boolean,
    onError?: (request?: undefined, error?: any) => void,
  ): IFileRequest;
  importMeshAsync(names: unknown, scene: Scene, opened: unknown): Promise<CSPLATImport>;
  loadAsync(scene: Scene, opened: unknown): Promise<void>;
  loadAssetContainerAsync(scene: Scene, opened: unknown): Promise<AssetContainer>;
}
