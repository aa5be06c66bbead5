// SPDX-License-Identifier: Apache-2.0
// Types of csplat-encoder. N is the number of splats, K = (degree + 1)² − 1 for SH of degree 0 to 4.

/**
 * A scene, such as csplat-decoder's `decode` returns. All numbers are finite. Extra columns, cameras and declared errors are
 * left out.
 */
export interface Splats {
  /** [N, 3], centres in scene units, relative to `origin` */
  means: Float32Array;
  /** [N, 4], rotations w x y z, of unit length within 0.001 */
  quats: Float32Array;
  /** [N, 3], natural logarithms of the standard deviations */
  scales: Float32Array;
  /** [N], alpha, 0 to 1 */
  opacities: Float32Array;
  /** [N, 3], SH coefficient of band 0 */
  sh0: Float32Array;
  /** [N, K, 3], SH coefficients of bands 1 and above. Default: none. */
  shN?: Float32Array;
  /** [N, 3], positions in doubles, of which `means` are the differences from the origin, rounded. Default: means are exact. */
  positions?: Float64Array | null;
  /** Position that the means are relative to. Default: 0, 0, 0. */
  origin?: number[];
  /** Directions of +x, +y and +z, letters of R L U D F B, such as `RDF`. Default: '', unknown. */
  axes?: string;
  /** Metres per scene unit. Default: 0, unknown. */
  unitMetres?: number;
  /** Trained with the low-pass filter of Mip-Splatting. Default: false. */
  antialiased?: boolean;
  /** Discs (2DGS). Default: false. */
  flat?: boolean;
  /** 0: sRGB, the default; 1: linear light */
  colourSpace?: number;
  /** Title, licence, up direction and other keys of META (specification, 5.4). Default: none. */
  metadata?: Record<string, unknown> | null;
  /** Of a decoded scene: states what of origin, axes, unitMetres, antialiased, flat and colourSpace is not stated above. */
  header?: Pick<Splats, 'origin' | 'axes' | 'unitMetres' | 'antialiased' | 'flat' | 'colourSpace'>;
}

/** The splats of a PLY. */
export interface PlySplats extends Required<Omit<Splats, 'metadata' | 'header'>> {
  /** Rows of the file; those with NaN or infinity are left out. */
  rowCount: number;
}

export interface EncodeOptions {
  /** Work in a worker, to which arrays are copied, instead of the calling thread. Default: false. */
  worker?: boolean;
  /** Called with the finished fraction of the work, 0 to 1. */
  onProgress?: (done: number) => void;
  /** Stops the work; the promise is rejected with its reason. Without a worker, it is checked whenever progress is reported. */
  signal?: AbortSignal;
  /** [N], receives the number of the input's splat that each splat of the file represents. Only of `encode`. */
  sourceIndex?: Uint32Array;
}

/** E_INPUT: the data is invalid. E_LIMIT: out of memory. */
export class CsplatError extends Error {
  code: 'E_INPUT' | 'E_LIMIT';
}

/** Encode a scene. The bytes depend only on the scene. Throws a CsplatError. */
export function encode(splats: Splats, options?: EncodeOptions): Promise<Uint8Array<ArrayBuffer>>;

/**
 * Read a PLY of splats as trainers write it, binary or text. Comments of csplat specify origin, axes and unit. Throws a
 * CsplatError.
 */
export function readPly(ply: ArrayBuffer | Uint8Array, options?: EncodeOptions): Promise<PlySplats>;

/** A PLY that is encoded. */
export interface EncodedPly {
  file: Uint8Array<ArrayBuffer>;
  splatCount: number;
  /** Rows of the PLY; those with NaN or infinity, `rowCount - splatCount`, are left out. */
  rowCount: number;
}

/** Read and encode a PLY, which takes half the memory of both calls. Throws a CsplatError. */
export function encodePly(ply: ArrayBuffer | Uint8Array, options?: EncodeOptions): Promise<EncodedPly>;
