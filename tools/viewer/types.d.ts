// What the viewer's parts hand to each other. engine.mjs is the way in for pages.

import type { Description, Header, TileRecord } from '../../codec/js/decoder.d.ts';

export type { Description, Header, TileRecord };

/** A pinhole camera, in pixels of the drawing buffer; the centre of the first pixel lies at (0.5, 0.5). */
export interface Camera {
  /** 16 numbers, row by row: world → camera, a rotation and a translation; x right, y down, z forward (OpenCV). */
  viewmat: ArrayLike<number>;
  fx: number;
  fy: number;
  cx: number;
  cy: number;
  /** Splats whose centre is not farther than this along z are not drawn; scene units, 0.2 by default. */
  near?: number;
}

/** A camera and the size of its picture. */
export interface View extends Required<Camera> {
  width: number;
  height: number;
}

/** Where a scene lies, for an automatic camera; in scene units, relative to the header's origin. */
export interface Bounds {
  /** Where most of what shows is. */
  centre: [number, number, number];
  /** Of a ball around `centre` that holds nine tenths of what shows. */
  radius: number;
  /** Box of all centres of splats, far outliers too. */
  boxMin: [number, number, number];
  boxMax: [number, number, number];
  /** [S, 3], means of up to some 20,000 splats from all over the scene; corners of tiles until layer 0 is here. */
  samples: Float32Array;
  /** [S], how much each of them shows: square root of alpha times the area of its ellipse. */
  weights: Float32Array;
  /** True before layer 0 is complete: all that is known then is the boxes of the tiles. */
  coarse: boolean;
}

export interface Stats {
  splatCount: number;
  /** Splats whose layer 0 is on the GPU. */
  splatsResident: number;
  /** Splats that passed the cull for the last sort. */
  splatsDrawn: number;
  /** Bytes of the file, and bytes of it that have arrived. */
  fileSize: number;
  received: number;
  /** Milliseconds of decoding and packing in the worker so far, waiting for bytes not counted. */
  decodeMs: number;
  /** Milliseconds of the last sort, and of the cull before it. */
  sortMs: number;
  cullMs: number;
  /** Milliseconds from a frame's first command until the GPU was done with it, the last one. */
  frameMs: number;
  /** FrameScheduler of the last second. */
  fps: number;
  /** Bytes of textures with attributes, tables and order; `workBytes` those of targets and projected splats. */
  gpuBytes: number;
  workBytes: number;
  /** Bytes of attributes and tables per splat on the GPU, and what float32 attributes would take. */
  gpuBytesPerSplat: number;
  expandedBytesPerSplat: number;
  /** From `open` until a frame showed the whole scene from layer 0; bytes received when all of that was here. 0 before. */
  firstPictureMs: number;
  firstPictureBytes: number;
  /** Degree that is shown at most: what has been asked for and the file has. */
  shDegree: number;
  glRenderer: string;
  pictureFormat: PictureFormat;
}

export interface Progress {
  /** `open` until header and index are here, then `layers`. */
  phase: 'open' | 'layers';
  received: number;
  fileSize: number;
  /** Splats whose layer 0 is decoded. */
  splatsDone: number;
  splatCount: number;
  /** The layer that is being read: 0, then 1 to 3. */
  layer: number;
}

/** An error as messages carry it; `fatal` where the scene is given up. */
export interface ErrorReport {
  /** One of the format's (E_CRC …), or of engine_error.mjs: E_WEBGL2, E_CONTEXT, E_REPLACED, E_WORKER. */
  code: string;
  message: string;
  /** Byte of the file, and clause of the specification, where the file is at fault. */
  offset?: number;
  clause?: string;
  fatal: boolean;
}

/** What splats are blended into. Bytes round each layer: a last resort. */
export type PictureFormat = 'RGBA16F' | 'RGBA32F' | 'RGBA8';

export interface EngineOptions {
  /** Red, green, blue, 0 to 1. */
  background?: [number, number, number];
  /** Makes the worker that decodes and sorts. */
  workerFactory?: () => Worker;
  /** By default the fastest that can be blended and does not show. */
  pictureFormat?: PictureFormat;
  onProgress?: (progress: Progress) => void;
  /** Called once header, index, metadata and cameras are here. */
  onHeader?: (header: Header, description: Description) => void;
  /** Called when a frame has been drawn. */
  onFrame?: (stats: Stats) => void;
  onError?: (error: ErrorReport) => void;
}

export interface Engine {
  /** Show a scene in the place of the one before. Resolves when all of it is decoded, rejects with an EngineError. */
  open(source: string | URL | Blob | ArrayBuffer): Promise<void>;
  setCamera(camera: Camera): void;
  /** Pixels of the drawing buffer. */
  setSize(width: number, height: number): void;
  setBackground(background: [number, number, number]): void;
  /** Show SH bands up to this degree. */
  setShDegree(degree: number): void;
  requestFrame(): void;
  /** Resolves when everything is decoded, sorted for the camera of then, and drawn. */
  settled(): Promise<void>;
  /** The settled picture: RGBA, the top row first. */
  readPixels(): Promise<Uint8Array>;
  /** The scene's file, but that it says which way is up: a direction of length 1. */
  fileWithUp(up: [number, number, number]): Promise<Uint8Array<ArrayBuffer>>;
  /** Draw frames one after the other and wait for each: milliseconds of each. For benchmarks. */
  timeFrames(count: number): Promise<number[]>;
  readonly stats: Stats;
  readonly bounds: Bounds | null;
  readonly header: Header | null;
  /** Free everything; nothing else may be called afterwards. */
  close(): void;
}
