// SPDX-License-Identifier: Apache-2.0
// Types that the adapters for engines share.

import type { ByteSource, Header, ReaderOptions } from '../decoder.d.ts';

/** Options of a load; `signal` aborts all of it. */
export interface LoadOptions extends Omit<ReaderOptions, 'inflate'> {
  /** SH bands above this degree are not fetched. */
  shDegree?: number;
  /** Resolve as soon as geometry and base colour are available; SH bands follow, see `complete`. */
  progressive?: boolean;
  /** Number of decoding workers. Default: 2. */
  workers?: number;
  /**
   * Of a file with levels of detail, load the version with the smallest errors that has at most this number of splats, or
   * the coarsest; Infinity: level 0. Other files are loaded whole. Default: 2,500,000, on
   * phones 1,000,000; in PlayCanvas `app.scene.gsplat.splatBudget`.
   */
  maxSplats?: number;
  /**
   * Of a file with levels of detail, draw each part as finely as the camera requires, at most `maxSplats` splats, and load it
   * when it is required. The load resolves with the coarsest version; `progressive` has no effect. Default: false.
   */
  levels?: boolean;
  /** Error, in pixels, below which parts are not refined further; with `levels`. Default: 1. */
  pixelError?: number;
}

/** The source of a scene. */
export type SceneSource = string | URL | Blob | ArrayBuffer | ArrayBufferView | ByteSource;

/** The first view of a scene, for the engine's camera, in the coordinates of the upright scene. */
export interface SceneView {
  position: number[];
  /** A point on the line of sight, as far away as the middle of the scene: what an orbit turns around. */
  target: number[];
  /** Towards the top of the picture, of length 1. */
  up: number[];
  /** Distance of the near plane. */
  near: number;
  /** `training` (a camera of the training), `author` (a person), `estimate` (a program), or '' if the file does not tell. */
  from: string;
  /** Return the vertical field of view, in degrees, with which a canvas of this shape, width / height, shows all of the view. */
  fov(aspect: number): number;
}

/** The property `csplat` of an engine's object. */
export interface SceneFacts<T = void> {
  /** `axes`, `antialiased`, `origin` (the position that coordinates are relative to), `unitMetres`, `shDegree`, …, of the file. */
  header: Header;
  /** Number of splats of the loaded version. */
  splatCount: number;
  metadata: Record<string, unknown> | null;
  /** Where a viewer starts: as the file has it, the same in every viewer; else an estimate from the boxes of its tiles. */
  view: SceneView;
  /** A sphere around most splats of the upright scene. */
  bounds: { centre: number[]; radius: number };
  /**
   * Resolves when the SH bands are loaded: at once, unless the load was progressive; with `levels`, when all that a camera
   * requires is drawn for the first time. Disposal ends it.
   */
  complete: Promise<T>;
  /** What streams levels of detail; null if they are not drawn by what the camera sees. */
  levels: SceneLevels | null;
}

/** Levels of detail that are streamed. */
export interface SceneLevels {
  /** Number of splats that are drawn now; `splatCount` of the scene is the number that there is room for. */
  readonly splatCount: number;
  /** Whether all that the camera requires is drawn. */
  readonly isComplete: boolean;
  /** Bytes that the camera requires and that are not here. */
  readonly missingBytes: number;
}
