// SPDX-License-Identifier: Apache-2.0
// Types shared by the viewer's modules. engine.mjs is the entry point for pages.

import type { Description, FetchOptions, FetchReason, Header, TileRecord, TreeNode } from '../../codec/js/decoder.d.ts';

export type { Description, FetchOptions, Header, TileRecord, TreeNode };

/** A pinhole camera, in pixels of the drawing buffer; the centre of the first pixel is at (0.5, 0.5). */
export interface Camera {
  /** 16 numbers, row by row: world → camera, a rotation and a translation; x right, y down, z forward (OpenCV). */
  viewmat: ArrayLike<number>;
  fx: number;
  fy: number;
  cx: number;
  cy: number;
  /** Splats whose centre is nearer than this along z are not drawn; scene units. Default: 0.2. */
  near?: number;
}

/** A camera and the size of its picture. */
export interface View extends Required<Camera> {
  width: number;
  height: number;
}

/** The bounds of a scene, for an automatic camera; in scene units, relative to the header's origin. */
/** An up direction, a unit vector, and a first view for the metadata of a file. */
export interface MetadataChanges {
  up?: [number, number, number];
  view?: FileCamera;
}

export interface Bounds {
  /** Centre of the visible weight. */
  centre: [number, number, number];
  /** Radius of a ball around `centre` with nine tenths of the visible weight. */
  radius: number;
  /** Box of the centres of all splats, including far outliers. */
  boxMin: [number, number, number];
  boxMax: [number, number, number];
  /** [S, 3], means of up to about 20,000 splats of the coarsest version; corners of tiles until it has arrived. */
  samples: Float32Array;
  /** [S], visibility weight of each: square root of alpha times the area of its ellipse. */
  weights: Float32Array;
  /** True before the coarsest version is complete: only the boxes of the tiles are known. */
  coarse: boolean;
}

export interface Stats {
  splatCount: number;
  /** Splats whose layer 0 is on the GPU, at any level. */
  splatsResident: number;
  /** Splats that passed the cull for the last sort. */
  splatsDrawn: number;
  /** Size of the file, and bytes received. */
  fileSize: number;
  received: number;
  /** Milliseconds of decoding and packing in the worker so far, excluding the wait for bytes. */
  decodeMs: number;
  /** Milliseconds of the last sort, and of the cull before it. */
  sortMs: number;
  cullMs: number;
  /** Milliseconds from the first command of the last frame until the GPU had completed it. */
  frameMs: number;
  /** Frames drawn during the last second. */
  fps: number;
  /** Bytes of textures with attributes, tables and order; `workBytes` for render targets and projected splats. */
  gpuBytes: number;
  workBytes: number;
  /** Bytes of attributes and tables per splat on the GPU, and the bytes of float32 attributes. */
  gpuBytesPerSplat: number;
  expandedBytesPerSplat: number;
  /** Time from `open` until a frame showed the whole scene, at any level, and the bytes received for it. 0 before. */
  firstPictureMs: number;
  firstPictureBytes: number;
  /** Displayed SH degree: the minimum of the requested degree and the file's. */
  shDegree: number;
  glRenderer: string;
  pictureFormat: PictureFormat;
}

export interface Progress {
  /** `open` until it is known what the view requires, then `layers`. */
  phase: 'open' | 'layers';
  received: number;
  /** Bytes that the view requires and that have not arrived. */
  missing: number;
  fileSize: number;
  /** Splats whose layer 0 is decoded, without those of coarser levels. */
  splatsDone: number;
  splatCount: number;
  /** The layer being read: 0, then the SH bands from 1 on. */
  layer: number;
}

/** An error as sent in messages; `fatal` if the scene is given up. */
export interface ErrorReport {
  /** A code of the format (E_CRC …) or of engine_error.mjs: E_WEBGL2, E_CONTEXT, E_SUPERSEDED, E_WORKER. */
  code: string;
  message: string;
  /** Offset in the file and clause of the specification, if the file is invalid. */
  offset?: number;
  clause?: string;
  /** What failed, and the HTTP status, if the file cannot be fetched. `replaced`: it is opened anew unless `fatal`. */
  reason?: FetchReason;
  status?: number;
  fatal: boolean;
}

/** Format of the target of blending. Bytes are rounded after each layer, a last resort. */
export type PictureFormat = 'RGBA16F' | 'RGBA32F' | 'RGBA8';

/**
 * What draws. `webgpu` blends by screen tiles, in binary32, or as quads, in half floats, whichever a measurement finds faster;
 * the other names say which. `auto` is `webgpu` on hardware that draws a small scene correctly. All draw with WebGL 2 in a
 * browser without WebGPU.
 */
export type Backend = 'auto' | 'webgl2' | 'webgpu' | 'webgpu-tiles' | 'webgpu-quads';

/** Red, green, blue, 0 to 1, or nothing: the page shows behind the scene. */
export type Background = [number, number, number] | 'transparent';

/** How `toBlob` makes a picture. */
export interface PictureOptions<T = Camera> {
  /** Pixels. If one is missing, the shape of the canvas is kept; if both are, its size at full resolution. */
  width?: number;
  height?: number;
  /** Default: the current camera, so that at least all that the canvas shows is in the picture. */
  camera?: T;
  /** Default: image/png. Only this type and image/webp keep a transparent background. */
  type?: string;
  /** Quality of an image with losses, 0 to 1. */
  quality?: number;
}

/** A camera as in camera files and in the metadata of scenes (spec 5.4). */
export interface FileCamera {
  /** 3 × 3, rows of the intrinsic matrix of a picture of W by H pixels. */
  K: number[][];
  /** 4 × 4, by rows: world → camera, as of Camera. */
  viewmat: number[][];
  W: number;
  H: number;
  near?: number;
}

/** The options of FetchOptions apply to scenes that are URLs; after its opening, a scene is retried without end by default. */
export interface EngineOptions extends FetchOptions {
  /** Default: black. Only an engine made with `transparent` can be transparent later. */
  background?: Background;
  /** Creates the worker that decodes and sorts. */
  workerFactory?: () => Worker;
  /** What draws. Default: auto. */
  backend?: Backend;
  /**
   * Maximum number of splats drawn of a file with levels of detail; parts that are far away are then drawn coarsely. Default:
   * 6 million with WebGPU, 3 million with WebGL 2, half of that on small devices and for users who save data. Twice as many
   * are kept in memory.
   */
  maxSplats?: number;
  /**
   * Error, in pixels, below which parts of a file with levels of detail are not refined further. Default: 1; 2 for users who save
   * data, and what is out of view is then not loaded.
   */
  pixelError?: number;
  /** Format of WebGL 2. Default: the fastest that can be blended without visible differences. */
  pictureFormat?: PictureFormat;
  onProgress?: (progress: Progress) => void;
  /** Called once header, index, metadata and cameras have arrived. */
  onHeader?: (header: Header, description: Description) => void;
  /** Called when a frame has been drawn. */
  onFrame?: (stats: Stats) => void;
  onError?: (error: ErrorReport) => void;
}

export interface Engine {
  /**
   * Replace the scene. Resolves when everything that the view requires is decoded, all of it without levels of detail; rejects
   * with an EngineError.
   */
  open(source: string | URL | Blob | ArrayBuffer): Promise<void>;
  setCamera(camera: Camera): void;
  /** Set the size of the drawing buffer, pixels. */
  setSize(width: number, height: number): void;
  /** Maximum width and height of the drawing buffer, pixels. */
  readonly sideMax: number;
  setBackground(background: Background): void;
  /** Show SH bands up to this degree. */
  setShDegree(degree: number): void;
  requestFrame(): void;
  /** Resolves when everything that the current camera requires is decoded, sorted, and drawn. */
  settled(): Promise<void>;
  /** Return the settled picture: RGBA, premultiplied by alpha, top row first. */
  readPixels(): Promise<Uint8Array>;
  /**
   * Make an image of the scene, of any size, when everything that it requires is decoded; the canvas keeps its picture until
   * then. While the page is hidden, it waits for what a file with levels of detail still requires. `camera` is in pixels of the
   * image. Rejects with an EngineError: E_INPUT for invalid options, E_LIMIT for more
   * pixels than possible, E_SUPERSEDED if another scene is opened, E_CONTEXT if the GPU is lost, or that of the scene.
   */
  toBlob(options?: PictureOptions): Promise<Blob>;
  /** Return the scene's file with other metadata. */
  fileWith(changes: MetadataChanges): Promise<Uint8Array<ArrayBuffer>>;
  /**
   * Draw frames, waiting after each or after so many together, and return the milliseconds per frame of each wait. For
   * benchmarks.
   */
  timeFrames(count: number, together?: number): Promise<number[]>;
  readonly stats: Stats;
  readonly bounds: Bounds | null;
  readonly header: Header | null;
  /** Free everything; no method may be called afterwards. */
  close(): void;
}

/** The element's own events, which do not bubble. */
export interface CsplatViewEvents {
  progress: CustomEvent<Progress>;
  firstpicture: CustomEvent<Stats>;
  load: CustomEvent<Stats>;
  camerachange: CustomEvent<FileCamera>;
  error: CustomEvent<ErrorReport>;
}

/** The element `<csplat-view>`. Properties other than those below reflect the attributes of the same name. */
export interface CsplatViewElement extends HTMLElement {
  addEventListener<K extends keyof CsplatViewEvents>(
    type: K,
    listener: (this: CsplatViewElement, event: CsplatViewEvents[K]) => void,
    options?: boolean | AddEventListenerOptions,
  ): void;
  addEventListener<K extends Exclude<keyof HTMLElementEventMap, keyof CsplatViewEvents>>(
    type: K,
    listener: (this: CsplatViewElement, event: HTMLElementEventMap[K]) => void,
    options?: boolean | AddEventListenerOptions,
  ): void;
  addEventListener(
    type: string,
    listener: EventListenerOrEventListenerObject,
    options?: boolean | AddEventListenerOptions,
  ): void;
  src: string;
  alt: string;
  /**
   * The current camera; null before the scene is placed. Set it to a camera, a list of cameras, JSON of either or its URL: the
   * camera moves there at once, without an event.
   */
  get camera(): FileCamera | null;
  set camera(value: FileCamera | readonly FileCamera[] | string | URL | null);
  view: string | number;
  up: string | readonly number[];
  axes: string;
  background: string;
  poster: string;
  controls: string;
  backend: Backend | '';
  crossOrigin: 'anonymous' | 'use-credentials' | null;
  /** How scenes are fetched; used from the next `src` on. */
  fetch: FetchOptions['fetch'];
  request: FetchOptions['request'];
  renew: FetchOptions['renew'];
  retries: FetchOptions['retries'];
  timeoutMs: FetchOptions['timeoutMs'];
  /** Null before the element loads and after it has left the page. */
  readonly engine: Engine | null;
  /** Make an image as `Engine.toBlob` does. Default size with a camera: W by H. */
  toBlob(options?: PictureOptions<FileCamera>): Promise<Blob>;
}

declare global {
  interface HTMLElementTagNameMap {
    'csplat-view': CsplatViewElement;
  }
}
