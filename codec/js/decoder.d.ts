// Types of the csplat decoder. test/types.ts holds decoder.mjs against them.

/** What a file may ask for. Defaults are those of the spec, section 8. */
export interface Limits {
  /** Splats of one decode; any number, if left out. */
  splats?: number;
  /** Bytes of decoded arrays and tables, 2 GiB; also of a file that a server sends without ranges. */
  bytes?: number;
  /** Bytes of one JSON chunk, 64 MiB. */
  jsonBytes?: number;
}

/** Raw DEFLATE of exactly `size` bytes; refuses early ends, late ends and trailing bytes by throwing. */
export type Inflate = (coded: Uint8Array<ArrayBuffer>, size: number) => Uint8Array | Promise<Uint8Array>;

export type Form = 'floats' | 'integers';
/** Of a reader's tiles and layers. */
export type LayerForm = Form | 'packed';

export interface DecodeOptions {
  limits?: Limits;
  /** SH bands above this degree are not decoded (their chunks are still checked). */
  shDegree?: number;
  /** Indices of the tiles to decode, in this order; all of them by default. */
  tiles?: Iterable<number>;
  /** `integers` for the arrays of the spec, section 9.2. */
  form?: Form;
  signal?: AbortSignal;
  /** Splats so far, and all of them. */
  onProgress?: (done: number, total: number) => void;
  /**
   * Workers at most that decode, a tile each at a time; by default this thread does. Where a page's policy or a bundler
   * keeps them from starting, this thread does, too, and `workers` of the scene is 0.
   */
  workers?: number;
  /** Takes the place of node:zlib or DecompressionStream, and of WebAssembly and workers, which have an inflate of their own. */
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
  /** How many entries it has. */
  size: number;
}

export interface ExtraRecord {
  name: string;
  /** null where this decoder does not know the type: then the column is not returned. */
  dtype: 'u8' | 'i8' | 'u16' | 'i16' | 'u32' | 'i32' | 'f32' | 'f64' | null;
  /** Of one value; 0 where the type is not known. */
  bytes: number;
}

/** Bytes of a file. */
export interface ByteRange {
  offset: number;
  size: number;
}

/** A chunk as the index names it; the `Field`s are the places of offset and size in the index. */
export interface ChunkPlace extends ByteRange {
  type: string;
  flags: number;
  /** CRC-32 of its bytes. */
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
  /** Number of the tile's first splat in the whole scene. */
  first: number;
  splatCount: number;
  /** Lattice of the means: exponent, step × 2^exponent, corner and extent in its integers. */
  exponent: number;
  step: number;
  corner: number[];
  extent: number[];
  /** Box of the centres. */
  min: number[];
  max: number[];
  /** Natural logarithm of the largest standard deviation. */
  maxScale: number;
  /** Those that this decoder does not know too. */
  layers: LayerRecord[];
  /** Ids of the codebooks. */
  tables: number[];
  recordOffset: number;
  tablesOffset: number;
}

export interface Header {
  version: string;
  profile: string;
  fileSize: number;
  indexSize: number;
  splatCount: number;
  shDegree: number;
  antialiased: boolean;
  flat: boolean;
  /** Letters of the directions of +x, +y, +z ("RDF"), or empty where they are not known. */
  axes: string;
  /** Metres per scene unit, 0 where unknown. */
  unitMetres: number;
  /** What the means are relative to. */
  origin: number[];
  attributes: AttributeRecord[];
  codebooks: CodebookRecord[];
  extras: ExtraRecord[];
  directory: DirectoryRecord[];
  tiles: TileRecord[];
}

export interface StatedErrors {
  sourceCount: number;
  prunedCount: number;
  sourceShDegree: number;
  refitted: boolean;
  errors: Record<string, { max: number; rms: number }>;
}

/** Ancillary chunks; null for those that the file does not have. */
export interface Description {
  metadata: Record<string, unknown> | null;
  cameras: Record<string, unknown>[] | null;
  /** What the encoder was asked. */
  options: Record<string, unknown> | null;
  statedErrors: StatedErrors | null;
}

/** Which CRCs were checked: those of header, index and so many chunks. */
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
  /** Extra columns by name. */
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
  tile_splats: Uint32Array;
  exponents: Int32Array;
  extra: Record<string, ExtraArray>;
}

/** Integers of one attribute in one tile, as narrow as they can be. */
export interface PackedColumns {
  /** Column after column, each as long as the list of splats: an integer is `offsets[column]` + element. */
  columns: Uint8Array | Uint16Array | Uint32Array | Float64Array;
  offsets: number[];
  /** A value is `Math.fround(integer * step)`; 0 for opacities and quats, see `levels` of their attribute record. */
  step: number;
}

/** An SH band may stay in its codebook. */
export interface Packed extends PackedColumns {
  /** The splats that the columns are about, where they are not all: the others stand in the codebook, or are 0. */
  rows?: Uint32Array;
  lookup?: {
    /** Id of the codebook. */
    codebook: number;
    /** Its entries, and one row of zeros behind them. The same object for every tile of a reader. */
    table: PackedColumns;
    /** [count], a row of the table; the last one for the splats `rows`. */
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

/** A tile: layer 0 and, from band 1 on, its SH bands; null for those that it leaves out, whose coefficients are 0. */
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
  /** That decoded tiles; 0 where this thread did. */
  workers: number;
}
export type Scene = Splats & Whole;
export type IntegerScene = IntegerSplats & Whole;

/** Decode a whole file, with all of its checksums. */
export function decode(
  data: ArrayBuffer | ArrayBufferView,
  options: DecodeOptions & { form: 'integers' },
): Promise<IntegerScene>;
export function decode(
  data: ArrayBuffer | ArrayBufferView,
  options?: DecodeOptions & { form?: 'floats' },
): Promise<Scene>;

/** Read and check header and index; the data may end behind the index. */
export function readHeader(data: ArrayBuffer | ArrayBufferView, options?: { limits?: Limits }): Header;

/** Where a reader's bytes come from. `read` gives exactly `size` bytes or throws. */
export interface ByteSource {
  read(offset: number, size: number, signal?: AbortSignal): Promise<Uint8Array<ArrayBuffer>>;
  prefetch?(ranges: ByteRange[], signal?: AbortSignal): void;
  /** Of the file, where it is known. */
  size?: number | null;
}

export interface ReaderOptions {
  limits?: Limits;
  /** Of the first request, 64 KiB: header and index, one hopes. */
  firstBytes?: number;
  /** Of `open`, and of the body of a server without ranges. */
  signal?: AbortSignal;
  /** Bytes received so far, and the size of the file (0 before the header is here). */
  onProgress?: (received: number, fileSize: number) => void;
  fetch?: typeof fetch;
  /** Credentials, headers, mode of each request. */
  request?: RequestInit;
  inflate?: Inflate;
}

export interface ReadOptions {
  form?: Form;
  signal?: AbortSignal;
}

export interface TilesOptions {
  /** Indices; all tiles by default. */
  tiles?: Iterable<number>;
  form?: LayerForm;
  shDegree?: number;
  /** Extra columns; not of packed tiles. */
  extra?: boolean;
  /** Workers at most, as for `decode`; a reader with an `inflate` of the caller has none. */
  workers?: number;
  signal?: AbortSignal;
}

export interface LayerRequest {
  tile: number;
  layer: number;
}

/** Reads tiles and layers of a file in any order; checks the CRC of each part. */
export class CsplatReader {
  static open(from: string | URL | Blob | ArrayBuffer | ByteSource, options?: ReaderOptions): Promise<CsplatReader>;
  readonly header: Header;
  readonly checks: Checks;
  /** Milliseconds that reads have waited for bytes so far, each for itself. */
  readonly waitedMs: number;
  /** A tile with its SH bands up to a degree, and its extra columns if they are asked for. */
  readTile(
    index: number,
    options: ReadOptions & { form: 'integers'; shDegree?: number; extra?: boolean },
  ): Promise<IntegerSplats>;
  readTile(
    index: number,
    options?: ReadOptions & { form?: 'floats'; shDegree?: number; extra?: boolean },
  ): Promise<Splats>;
  /** Integers as narrow as the tile allows, codebooks as tables: to be drawn or kept as they are. */
  readTile(index: number, options: { form: 'packed'; shDegree?: number; signal?: AbortSignal }): Promise<PackedTile>;
  /** What readTile gives of each tile, and its `index`: one after the other, or with workers as they are done. */
  readTiles(options: TilesOptions & { form: 'packed' }): AsyncGenerator<PackedTile & { index: number }, void>;
  readTiles(options: TilesOptions & { form: 'integers' }): AsyncGenerator<IntegerSplats & { index: number }, void>;
  readTiles(options?: TilesOptions & { form?: 'floats' }): AsyncGenerator<Splats & { index: number }, void>;
  /** Layer 0: geometry and base colour. */
  readLayer(index: number, layer: 0, options: ReadOptions & { form: 'integers' }): Promise<IntegerSplats>;
  readLayer(index: number, layer: 0, options?: ReadOptions & { form?: 'floats' }): Promise<Splats>;
  /** An SH band, [count, 2·layer + 1, 3]; null where the tile leaves it out and its coefficients are 0. */
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
  /** Begin to fetch layers that will be read soon, neighbours with one request. */
  prefetch(wanted: Iterable<LayerRequest>, options?: { signal?: AbortSignal }): void;
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

/** Base of all errors; `clause` is the broken requirement. */
export class CsplatError extends Error {
  readonly code: ErrorCode;
  readonly offset: number | null;
  readonly clause: string | null;
}
export class FormatError extends CsplatError {}
export class UnsupportedError extends CsplatError {}
export class LimitError extends CsplatError {}
export class InputError extends CsplatError {}
