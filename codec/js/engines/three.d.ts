// Types of the loader for three.js.

import type { BufferGeometry, Loader, LoadingManager, Matrix4 } from 'three';

/** What stands in `userData` of a geometry. */
export interface SplatUserData {
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
  /** Stands the object upright: `splats.applyMatrix4(geometry.userData.upright)`. */
  upright: Matrix4;
}

export type SplatGeometry = BufferGeometry & { userData: SplatUserData };

/** Loads `.csplat` as the geometry that `GaussianSplat` of three/addons takes. Errors of a file are `CsplatError`s. */
export class CSPLATLoader extends Loader<SplatGeometry> {
  constructor(manager?: LoadingManager);
  load(
    url: string,
    onLoad: (geometry: SplatGeometry) => void,
    onProgress?: (event: ProgressEvent) => void,
    onError?: (error: unknown) => void,
  ): void;
  loadAsync(url: string, onProgress?: (event: ProgressEvent) => void): Promise<SplatGeometry>;
  /** Of a file in memory; undefined where an error went to onError. */
  parse(
    buffer: ArrayBuffer,
    onLoad?: (geometry: SplatGeometry) => void,
    onError?: (error: unknown) => void,
  ): Promise<SplatGeometry | undefined>;
  /** End all that this loader has begun. */
  abort(): this;
}
