// As much of Spark as its adapter uses, for checks without its package.

declare module '@sparkjsdev/spark' {
  export class ExtSplats {
    constructor(options: { extArrays: [Uint32Array, Uint32Array]; extra: Record<string, unknown>; numSplats: number });
  }
  export class PackedSplats {
    constructor(options: {
      packedArray: Uint32Array;
      extra: Record<string, unknown>;
      numSplats: number;
      splatEncoding: Record<string, number>;
    });
  }
  export class SplatMesh {
    constructor(options: {
      extSplats?: ExtSplats;
      packedSplats?: PackedSplats;
      splatEncoding?: Record<string, number>;
    });
    matrix: { set(...rows: number[]): unknown };
    quaternion: { setFromRotationMatrix(matrix: unknown): unknown };
    userData: Record<string, unknown>;
  }
}
