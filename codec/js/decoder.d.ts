// SPDX-License-Identifier: Apache-2.0
// Types of the csplat decoder. test/types.ts checks decoder.mjs against them.

/** Limits on what a file may require. The defaults are those of the spec, section 8. */
export interface Limits {
  /** Splats per decode. Default: no limit. */
  splats?: number;
  /** Bytes of decoded arrays and tables, and of a file that a server sends without ranges. Default: 2 GiB. */
  bytes?: number;
  /** Memory of one JSON text, estimated from its bytes and values (STR-8). Default: 128 MiB. */
  jsonBytes?: number;
  /** Highest resource level of a file (spec 8.1). Default: 'C', which is every file. */
  resourceLevel?: ResourceLevel;
}

/** What a file requires a decoder to hold at least: 'A' suits phones, 'B' desktops, 'C' has no bounds. */
export type ResourceLevel = 'A' | 'B' | 'C';

/**
 * Inflates raw DEFLATE to exactly `size` bytes. Throws if the stream ends early or late, or if bytes follow it; the decoder
 * reports whatever it throws as E_CODER, with it as `cause.cause`.
 */
export type Inflate = (coded: Uint8Array<ArrayBuffer>, size: number) => Uint8Array | Promise<Uint8Array>;

export type Form = 'floats' | 'integers';
/** The form of a reader's tiles and layers. */
export type LayerForm = Form | 'packed';

export interface DecodeOptions extends FetchOptions {
  limits?: Limits;
  /** SH bands above this degree are not decoded (their chunks are still checked). */
  shDegree?: number;
  /** Indices of the tiles to decode, in this order, of any level. Default: those of level 0; for integers all tiles. */
  tiles?: Iterable<number>;
  /** 'integers' returns the arrays of the spec, section 9.2. */
  form?: Form;
  /** Ends the decoding, and the requests for its bytes. */
  signal?: AbortSignal;
  /** Called with the number of splats decoded so far, as their bytes arrive, and of all splats. */
  onProgress?: (done: number, total: number) => void;
  /**
   * Maximum number of workers, each of which decodes a tile at a time. Default: 0, which decodes in this thread. If a
   * page's policy or a bundler prevents workers from starting, this thread decodes and `workers` of the scene is 0.
   */
  workers?: number;
  /** Replaces node:zlib or DecompressionStream. WebAssembly and workers, which have their own inflate, are not used. */
  inflate?: Inflate;
}

export interface AttributeRecord {
  id: number;
  name: string;
  mapping: string;
  chromaShift: number;
  levels: number;
  step: number;
}

export interface CodebookRecord {
  id: number;
  kind: string;
  attributes: string[];
  bandFirst: number;
  bandLast: number;
  /** Number of entries. */
  size: number;
}

export interface ExtraRecord {
  name: string;
  /** null if this decoder does not know type or coding; the column is then not returned. */
  dtype: 'u8' | 'i8' | 'u16' | 'i16' | 'u32' | 'i32' | 'f32' | 'f64' | null;
  /** Bytes per value; 0 if `dtype` is null. */
  bytes: number;
  /** Values of a splat, 1 to 64. */
  components: number;
  /** Meaning of the values: `label`, `normal`, `feature:` and a model's name, …; empty if it is not stated. */
  semantic: string;
  /** Layer of the column. */
  layer: number;
}

/** A range of bytes in a file. */
export interface ByteRange {
  offset: number;
  size: number;
}

/** A chunk as listed in the index; the `Field` members are the positions of offset and size in the index. */
export interface ChunkPlace extends ByteRange {
  type: string;
  flags: number;
  /** CRC-32 of the chunk. */
  crc: number;
  offsetField: number;
  sizeField: number;
}

export interface DirectoryRecord extends ChunkPlace {
  id: number;
  layer: number;
  recordOffset: number;
}

export interface LayerRecord extends ChunkPlace {
  layer: number;
}

export interface TileRecord {
  index: number;
  /** Level of detail: 0 is the scene, higher levels are coarser. */
  level: number;
  /** Number of splats in the tiles before this one: at level 0, the index of its first splat in the scene. */
  first: number;
  splatCount: number;
  /** Lattice of the means: exponent, step × 2^exponent, corner and extent in its integers. */
  exponent: number;
  step: number;
  corner: number[];
  extent: number[];
  /** Bounding box of the centres, numbers of binary32 as these are. */
  min: number[];
  max: number[];
  /** Natural logarithm of the largest standard deviation. */
  maxScale: number;
  /** All layers, including those that this decoder does not know. */
  layers: LayerRecord[];
  /** Ids of the codebooks. */
  tables: number[];
  recordOffset: number;
  tablesOffset: number;
}

export interface Header {
  version: string;
  profile: string;
  resourceLevel: ResourceLevel;
  fileSize: number;
  indexSize: number;
  /** Splats of level 0, the scene. */
  splatCount: number;
  shDegree: number;
  /** Shape of a splat: 'ellipse'; other kernels are refused. */
  kernel: string;
  /** How the splats were drawn in training (spec 4.3): numbers of its registries, or unknown ones from 128 on. */
  projection: number;
  antialiasing: number;
  colourSpace: number;
  /** Whether `antialiasing` is MIP. */
  antialiased: boolean;
  flat: boolean;
  /** Letters of the directions of +x, +y, +z ("RDF"), or empty if unknown. */
  axes: string;
  /** Metres per scene unit, 0 if unknown. */
  unitMetres: number;
  /** Position that the means are relative to. */
  origin: number[];
  attributes: AttributeRecord[];
  codebooks: CodebookRecord[];
  extras: ExtraRecord[];
  directory: DirectoryRecord[];
  /** The tiles of level 0. */
  tiles: TileRecord[];
  /** The tiles of the coarser levels, whose indices follow; empty if the file has no levels of detail. */
  coarseTiles: TileRecord[];
}

/** Some tiles of one level that are drawn together (spec 5.7). A parent is a coarser version of its children. */
export interface TreeNode {
  index: number;
  level: number;
  /** Index of the parent, which is larger than `index`; null for a root. */
  parent: number | null;
  /** Indices of the children, ascending; empty at level 0. */
  children: number[];
  /** Index of its first tile; the others follow. */
  firstTile: number;
  tileCount: number;
  splatCount: number;
  /** Size of a pixel, in scene units, from which on the node may replace the splats below it; 0 at level 0. */
  error: number;
  /** Region: the bounding box of the centres of its splats and of those of all nodes below it. */
  min: number[];
  max: number[];
}

/** A version of the scene: at most one of `level`, `pixelSize` and `maxSplats`. Default: level 0. */
export interface CutOptions {
  /** The highest level to use, 0 to 255. */
  level?: number;
  /** Use each node from its `error` on. Size of a pixel at the nodes, in scene units: one number, or one per node. */
  pixelSize?: number | ArrayLike<number>;
  /** Maximum number of splats of the version. Nodes with the largest errors are replaced first by their children. */
  maxSplats?: number;
  /**
   * Select a part of the version: two corners of a box, x, y, z each, in any order, possibly infinite, relative to the
   * header's origin. Of level 0, these are the tiles whose box touches it, or shares a point with it. Of a coarser node,
   * they are all of its tiles if its region, from `min` to `max`, does.
   */
  box?: ArrayLike<number>;
}

export interface DeclaredErrors {
  sourceCount: number;
  prunedCount: number;
  sourceShDegree: number;
  refitted: boolean;
  errors: Record<string, { max: number; rms: number }>;
}

/** Ancillary chunks; null for chunks that the file does not have. */
export interface Description {
  metadata: Record<string, unknown> | null;
  cameras: Record<string, unknown>[] | null;
  /** Options that the encoder was called with. */
  options: Record<string, unknown> | null;
  declaredErrors: DeclaredErrors | null;
}

/** The checked CRCs: header, index, and the number of chunks. */
export interface Checks {
  header: boolean;
  index: boolean;
  chunks: number;
}

export type ExtraArray =
  Uint8Array | Int8Array | Uint16Array | Int16Array | Uint32Array | Int32Array | Float32Array | Float64Array;

/** The arrays of the spec, section 3, in C order. */
export interface Splats {
  count: number;
  /** K = (shDegree + 1)² − 1 */
  shDegree: number;
  /** [count, 3], relative to the header's origin */
  means: Float32Array;
  /** [count, 4], w x y z */
  quats: Float32Array;
  /** [count, 3], natural logarithms */
  scales: Float32Array;
  /** [count], alpha */
  opacities: Float32Array;
  /** [count, 3] */
  sh0: Float32Array;
  /** [count, K, 3] */
  shN: Float32Array;
  /** Extra columns by name, [count, components]. None if a tile of a coarser level is included: only level 0 has them. */
  extra: Record<string, ExtraArray>;
}

/** The integer arrays of the spec, section 9.2; A attributes of T tiles. */
export interface IntegerSplats {
  count: number;
  shDegree: number;
  opacities: Uint32Array;
  scales: BigInt64Array;
  quats: Int32Array;
  means: BigInt64Array;
  sh0: BigInt64Array;
  sh1?: BigInt64Array;
  sh2?: BigInt64Array;
  sh3?: BigInt64Array;
  sh4?: BigInt64Array;
  tile_splats: Uint32Array;
  exponents: Int32Array;
  extra: Record<string, ExtraArray>;
}

/** Integers of one attribute in one tile, in the narrowest type that holds them. */
export interface PackedColumns {
  /** Column after column, each with one element per splat; the integer is `offsets[column]` + element. */
  columns: Uint8Array | Uint16Array | Uint32Array | Float64Array;
  offsets: number[];
  /** A value is `Math.fround(integer * step)`; 0 for opacities and quats, see `levels` of their attribute record. */
  step: number;
}

/** Packed columns, or an SH band that stays in its codebook. */
export interface Packed extends PackedColumns {
  /** The splats that the columns cover, if not all: the others are in the codebook, or 0. */
  rows?: Uint32Array;
  lookup?: {
    /** Id of the codebook. */
    codebook: number;
    /** Its entries, followed by one row of zeros. The same object for every tile of a reader. */
    table: PackedColumns;
    /** [count], the row of the table for each splat; the last row for the splats in `rows`. */
    index: Uint8Array | Uint16Array | Uint32Array;
  };
}

/** Layer 0 of a tile. Colours are R, G, B, as after the spec's 7.1. */
export interface PackedGeometry {
  count: number;
  /** Levels, one column. */
  opacities: PackedColumns;
  /** Three columns. */
  scales: PackedColumns;
  /** x, y, z; w follows (spec 7.5). */
  quats: PackedColumns;
  means: PackedColumns;
  sh0: PackedColumns;
}

/** A tile: layer 0 and the SH bands from 1 on; null for bands that the tile leaves out, whose coefficients are 0. */
export interface PackedTile extends PackedGeometry {
  sh: (Packed | null)[];
}

/** An SH band of a tile; column channel · (2l + 1) + m holds coefficient m. */
export interface PackedBand {
  count: number;
  sh: Packed;
}

export interface Whole extends Description {
  header: Header;
  checks: Checks;
  /** Number of workers that decoded tiles; 0 if this thread did. */
  workers: number;
}
export type Scene = Splats & Whole;
export type IntegerScene = IntegerSplats & Whole;

/**
 * Decode a whole file and check all of its checksums. The result is level 0, or the tiles in the options; integers are by
 * default those of all levels.
 */
export function decode(data: FileSource, options: DecodeOptions & { form: 'integers' }): Promise<IntegerScene>;
export function decode(data: FileSource, options?: DecodeOptions & { form?: 'floats' }): Promise<Scene>;

/** Read and check header and index; the data may end after the index. */
export function readHeader(data: ArrayBuffer | ArrayBufferView, options?: { limits?: Limits }): Header;

/**
 * A file: its address, in Node, Bun and Deno also its path or file: URL; a Blob; a Response or a stream of bytes, which are
 * read once, as they arrive; its bytes; or an object that reads it.
 */
export type FileSource =
  string | URL | Blob | Response | ReadableStream<Uint8Array> | ArrayBuffer | ArrayBufferView | ByteSource;

/** The source of a reader's bytes. `read` returns exactly `size` bytes or throws. */
export interface ByteSource {
  read(offset: number, size: number, signal?: AbortSignal): Promise<Uint8Array<ArrayBuffer>>;
  prefetch?(ranges: ByteRange[], signal?: AbortSignal): void;
  /** Size of the file, if known. */
  size?: number | null;
  /** Whether later bytes arrive later, since the whole file is on its way. */
  readonly isSequential?: boolean;
}

/**
 * What failed: no connection, a broken or stalled one; an address that is refused (4xx, a revoked blob); a server that is
 * busy or out of order (408, 425, 429, 5xx); a server that answers otherwise than HTTP requires; a file that was replaced
 * while it was read; a page from disk, which may not load files.
 */
export type FetchReason = 'connection' | 'refused' | 'busy' | 'server' | 'replaced' | 'local';

/** A new address for a file: a URL, or a URL with options of its requests, which replace the earlier ones. */
export type NewAddress = string | URL | Request | (RequestInit & { url?: string | URL });

/** How a URL is fetched. */
export interface FetchOptions {
  /** Replaces the platform's function. Called with an absolute URL, Range in `headers`, and a signal. */
  fetch?: typeof fetch;
  /** Headers, credentials and mode of each request. */
  request?: RequestInit;
  /** Retries of a request in a row, after failures that may pass. Default: 4. */
  retries?: number;
  /** Milliseconds until the first retry, doubled each time up to 30 s. Retry-After counts, up to 30 s. Default: 500. */
  retryMs?: number;
  /** Milliseconds without a byte after which a request is made again; doubled each time. Default: 8000. */
  timeoutMs?: number;
  /**
   * Called if the server refuses the address (status 4xx), for example because a signed URL has expired. Returns another
   * address, or nothing to give up. Called again when that has worked and is refused later.
   */
  renew?: (refusal: {
    url: string;
    status: number;
    message: string;
  }) => NewAddress | null | undefined | void | Promise<NewAddress | null | undefined | void>;
}

export interface ReaderOptions extends FetchOptions {
  limits?: Limits;
  /** Size of the first request, which should cover header and index. Default: 64 KiB. */
  firstBytes?: number;
  /** Aborts `open` and all that is read later, which then reject with its reason. */
  signal?: AbortSignal;
  /** Called with the bytes received so far, each counted once, and the size of the file (0 before the header is here). */
  onProgress?: (received: number, fileSize: number) => void;
  /** Called before each retry, with the error and the wait in milliseconds. */
  onRetry?: (error: InputError, waitMs: number) => void;
  inflate?: Inflate;
}

export interface ReadOptions {
  form?: Form;
  signal?: AbortSignal;
}

export interface TilesOptions {
  /** Indices of the tiles, of any level. Default: those of level 0. */
  tiles?: Iterable<number>;
  form?: LayerForm;
  shDegree?: number;
  /** Include extra columns; not available for packed tiles. */
  extra?: boolean;
  /** Maximum number of workers, as for `decode`; 0 for a reader with its own `inflate`. */
  workers?: number;
  signal?: AbortSignal;
}

export interface LayerRequest {
  tile: number;
  layer: number;
}

/** Reads tiles and layers of a file in any order; checks the CRC of each part. */
export class CsplatReader {
  /** Open a file with one request for header and index. */
  static open(from: FileSource, options?: ReaderOptions): Promise<CsplatReader>;
  readonly header: Header;
  readonly checks: Checks;
  /** Retries of a request, as in the options; may be changed. */
  retries: number;
  /** Total milliseconds that reads have waited for bytes; concurrent reads count separately. */
  readonly waitedMs: number;
  /** Read a tile with its SH bands up to a degree, and its extra columns if requested. */
  readTile(
    index: number,
    options: ReadOptions & { form: 'integers'; shDegree?: number; extra?: boolean },
  ): Promise<IntegerSplats>;
  readTile(
    index: number,
    options?: ReadOptions & { form?: 'floats'; shDegree?: number; extra?: boolean },
  ): Promise<Splats>;
  /** Read integers in the narrowest types that hold them and codebooks as tables, for drawing or storage. */
  readTile(index: number, options: { form: 'packed'; shDegree?: number; signal?: AbortSignal }): Promise<PackedTile>;
  /** Yield the result of readTile for each tile, with its `index`; in order, or with workers as they are done. */
  readTiles(options: TilesOptions & { form: 'packed' }): AsyncGenerator<PackedTile & { index: number }, void>;
  readTiles(options: TilesOptions & { form: 'integers' }): AsyncGenerator<IntegerSplats & { index: number }, void>;
  readTiles(options?: TilesOptions & { form?: 'floats' }): AsyncGenerator<Splats & { index: number }, void>;
  /** Read layer 0: geometry and base colour. */
  readLayer(index: number, layer: 0, options: ReadOptions & { form: 'integers' }): Promise<IntegerSplats>;
  readLayer(index: number, layer: 0, options?: ReadOptions & { form?: 'floats' }): Promise<Splats>;
  /** Read an SH band, [count, 2·layer + 1, 3]; null if the tile leaves it out and its coefficients are 0. */
  readLayer(
    index: number,
    layer: number,
    options: ReadOptions & { form: 'integers' },
  ): Promise<{ sh: BigInt64Array; count: number } | null>;
  readLayer(
    index: number,
    layer: number,
    options?: ReadOptions & { form?: 'floats' },
  ): Promise<{ sh: Float32Array; count: number } | null>;
  readLayer(index: number, layer: 0, options: { form: 'packed'; signal?: AbortSignal }): Promise<PackedGeometry>;
  readLayer(
    index: number,
    layer: number,
    options: { form: 'packed'; signal?: AbortSignal },
  ): Promise<PackedBand | null>;
  describe(options?: { signal?: AbortSignal }): Promise<Description>;
  /** Read the nodes of the levels of detail, children before parents. Without levels: one node of level 0, or none. */
  nodes(): Promise<TreeNode[]>;
  /** Select tiles, for `readTiles`, `readTile` or `decode`. A budget below that of the coarsest version is E_LIMIT. */
  cut(options?: CutOptions): Promise<number[]>;
  /** Start to fetch layers that will be read soon; neighbours share a request. */
  prefetch(wanted: Iterable<LayerRequest>, options?: { signal?: AbortSignal }): void;
  /** Forget what `readLayer` keeps of a tile for its other layers; they can still be read. */
  forget(index: number): void;
  /** Whether parts near the end of the file arrive later than others, since the server sends it from its beginning. */
  readonly arrivesInOrder: boolean;
}

/** Codes of the spec, section 12. */
// begin generated: error codes
export type ErrorCode =
  | 'E_MAGIC'
  | 'E_VERSION'
  | 'E_TRUNCATED'
  | 'E_TRAILING'
  | 'E_CRC'
  | 'E_RESERVED'
  | 'E_VALUE'
  | 'E_INDEX'
  | 'E_UNSUPPORTED'
  | 'E_STREAM'
  | 'E_CODER'
  | 'E_RANGE'
  | 'E_CODEBOOK'
  | 'E_BOX'
  | 'E_JSON'
  | 'E_LIMIT'
  | 'E_INPUT';
// end generated

/** Base of all errors; `clause` is the id of the violated requirement. */
export class CsplatError extends Error {
  readonly code: ErrorCode;
  readonly offset: number | null;
  readonly clause: string | null;
}
export class FormatError extends CsplatError {}
export class UnsupportedError extends CsplatError {}
export class LimitError extends CsplatError {}
/** Invalid arguments, or a file that cannot be fetched. */
export class InputError extends CsplatError {
  /** What failed; null for arguments. */
  readonly reason: FetchReason | null;
  /** HTTP status, if it is the cause. */
  readonly status: number | null;
  /** Whether the same request may succeed later. */
  readonly isTransient: boolean;
  /** Milliseconds that the server requests to wait, 0 if it does not. */
  readonly retryAfterMs: number;
  /** Whether the server has another file by now: open it again. */
  readonly isReplaced: boolean;
}
