// What the adapters for engines have in common.

import type { ByteSource, Header, ReaderOptions } from '../decoder.d.ts';

/** `signal` holds for all of a load. */
export interface LoadOptions extends Omit<ReaderOptions, 'inflate'> {
  /** SH bands above this degree are not fetched. */
  shDegree?: number;
  /** Resolve as soon as geometry and base colour are there; SH bands follow, see `complete`. */
  progressive?: boolean;
  /** That decode; 2 by default, 0 for none. */
  workers?: number;
}

/** What a scene may come from. */
export type SceneSource = string | URL | Blob | ArrayBuffer | ByteSource;

/** What stands beside an engine's object, as `csplat`. */
export interface SceneFacts<T = void> {
  /** `axes`, `antialiased`, `origin` (what positions are relative to), `unitMetres`, `splatCount`, `shDegree`, … */
  header: Header;
  metadata: Record<string, unknown> | null;
  /** A ball around most splats, as they stand upright: for a first camera. */
  bounds: { center: number[]; radius: number };
  /** Resolves when the SH bands are there too: at once, unless the load was progressive. Disposal ends it. */
  complete: Promise<T>;
}
