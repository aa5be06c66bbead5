// SPDX-License-Identifier: Apache-2.0
// The parts of the engines that their adapters use, for type checks without the engines' packages.

declare module 'three' {
  export class BufferAttribute {
    constructor(array: ArrayBufferView, itemSize: number, normalized?: boolean);
    array: any;
  }
  export class Box3 {
    constructor(min: Vector3, max: Vector3);
    getBoundingSphere(target: Sphere): Sphere;
  }
  export class Sphere {
    constructor(center?: Vector3, radius?: number);
    center: Vector3;
    radius: number;
  }
  export class BufferGeometry {
    userData: object;
    attributes: Record<string, BufferAttribute>;
    boundingBox: Box3 | null;
    boundingSphere: Sphere | null;
    addEventListener(type: string, listener: () => void): void;
    setAttribute(name: string, attribute: BufferAttribute): this;
    computeBoundingBox(): void;
    computeBoundingSphere(): void;
  }
  export class Matrix4 {
    elements: number[];
    clone(): Matrix4;
    invert(): this;
    getMaxScaleOnAxis(): number;
    set(...rows: number[]): this;
    makeScale(x: number, y: number, z: number): this;
    multiplyMatrices(a: Matrix4, b: Matrix4): this;
  }
  export class Vector2 {
    x: number;
    y: number;
  }
  export class Vector3 {
    constructor(...coordinates: number[]);
    x: number;
    y: number;
    z: number;
    applyMatrix4(matrix: Matrix4): this;
    distanceTo(other: Vector3): number;
    set(x: number, y: number, z: number): this;
  }
  export class PerspectiveCamera {
    near: number;
    matrixWorldInverse: Matrix4;
    projectionMatrix: Matrix4;
  }
  export class DataTexture {
    constructor(data: ArrayBufferView, width: number, height: number, format: number, type: number);
  }
  export class DataArrayTexture {
    image: { width: number; height: number; depth: number; data: ArrayBufferView };
    format: number;
    type: number;
    isDataArrayTexture: boolean;
  }
  export class WebGLRenderer {
    copyTextureToTexture(from: DataTexture, to: DataArrayTexture, region: null, position: Vector3): void;
  }
  export class LoadingManager {
    abortController?: AbortController;
    resolveURL(url: string): string;
    itemStart(url: string): void;
    itemEnd(url: string): void;
    itemError(url: string): void;
  }
  export class Loader<T = unknown> {
    constructor(manager?: LoadingManager);
    manager: LoadingManager;
    path: string;
    withCredentials: boolean;
    requestHeader: Record<string, string>;
    loadAsync(url: string, onProgress?: (event: ProgressEvent) => void): Promise<T>;
  }
}

declare module 'three/addons/objects/GaussianSplat.js' {
  import type { Matrix4, PerspectiveCamera, Sphere, Vector2 } from 'three';
  export interface StorageAttribute {
    array: any;
    needsUpdate: boolean;
    pbo?: { needsUpdate: boolean };
    addUpdateRange(start: number, count: number): void;
  }
  export class GaussianSplat {
    boundingSphere: Sphere | null;
    matrixWorld: Matrix4;
    onBeforeRender: (
      renderer: { getDrawingBufferSize(target: Vector2): Vector2 },
      scene: unknown,
      camera: PerspectiveCamera,
    ) => void;
    _buffers: any;
    _sortInitialized: boolean;
    _sphericalHarmonicsInitialized: boolean;
  }
}

declare module '@babylonjs/core/Misc/fileRequest.js' {
  import type { Observable } from '@babylonjs/core/Misc/observable.js';
  export interface IFileRequest {
    onCompleteObservable: Observable<IFileRequest>;
    abort(): void;
  }
}

declare module '@babylonjs/core/Misc/observable.js' {
  export class Observable<T> {
    add(listener: () => void): { remove(): void };
    addOnce(listener: () => void): { remove(): void };
    notifyObservers(value: T): void;
  }
}

declare module '@babylonjs/core/scene.js' {
  import type { Matrix } from '@babylonjs/core/Maths/math.vector.js';
  import type { Observable } from '@babylonjs/core/Misc/observable.js';
  export class Scene {
    isDisposed: boolean;
    onDisposeObservable: Observable<Scene>;
    onBeforeRenderObservable: Observable<Scene>;
    useRightHandedSystem: boolean;
    activeCamera: { minZ: number; getViewMatrix(): Matrix; getProjectionMatrix(): Matrix } | null;
    getEngine(): {
      getCaps(): { maxTextureSize: number };
      getRenderWidth(): number;
      getRenderHeight(): number;
    };
  }
}

declare module '@babylonjs/core/assetContainer.js' {
  export class AssetContainer {
    constructor(scene: import('@babylonjs/core/scene.js').Scene);
    meshes: object[];
    removeAllFromScene(): void;
  }
}

declare module '@babylonjs/core/Loading/sceneLoader.js' {
  export function RegisterSceneLoaderPlugin(plugin: object): void;
}

declare module '@babylonjs/core/Maths/math.vector.js' {
  export class Vector3 {
    constructor(x: number, y: number, z: number);
  }
  export class Quaternion {}
  export class Matrix {
    multiply(other: Matrix): Matrix;
    asArray(): ArrayLike<number>;
    static FromValues(...values: number[]): Matrix;
    decompose(scaling: Vector3, rotation: Quaternion): boolean;
  }
}

declare module '@babylonjs/core/Meshes/GaussianSplatting/gaussianSplattingMesh.js' {
  import type { Matrix, Quaternion, Vector3 } from '@babylonjs/core/Maths/math.vector.js';
  import type { Scene } from '@babylonjs/core/scene.js';
  export class GaussianSplattingMesh {
    constructor(name: string, url: string | null, scene: Scene, keepInRam?: boolean);
    onDisposeObservable: import('@babylonjs/core/Misc/observable.js').Observable<unknown>;
    material: object | null;
    metadata: unknown;
    rotationQuaternion: Quaternion | null;
    scaling: Vector3;
    computeWorldMatrix(force: boolean): void;
    getWorldMatrix(): Matrix;
    getBoundingInfo(): { reConstruct(min: Vector3, max: Vector3, world: Matrix): void };
    setSplatIndexRanges(ranges: { offset: number; count: number }[]): void;
    _writeStreamingSplats(first: number, count: number, rows: Uint8Array): void;
    _updateShTextureData(texture: object, data: Uint8Array, width: number, line: number, lines: number): void;
    _shTextures: object[];
    _colorsTexture: object;
    _vertexCount: number;
    _getTextureSize(count: number): { x: number };
    _updateTextureFromDataRect(
      texture: object,
      data: Uint8Array,
      x: number,
      y: number,
      width: number,
      height: number,
    ): void;
    dispose(doNotRecurse?: boolean, disposeMaterialAndTextures?: boolean): void;
    updateDataAsync(data: ArrayBuffer, sh?: Uint8Array[], parts?: undefined, shDegree?: number): Promise<void>;
  }
}

declare module '@sparkjsdev/spark' {
  import type { DataArrayTexture, Matrix4, PerspectiveCamera, Vector2, WebGLRenderer } from 'three';
  export class ExtSplats {
    extra: Record<string, unknown>;
    numSplats: number;
    textures: [DataArrayTexture, DataArrayTexture];
    constructor(options: { extArrays: [Uint32Array, Uint32Array]; extra: Record<string, unknown>; numSplats: number });
  }
  export class PackedSplats {
    extra: Record<string, unknown>;
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
    matrixWorld: Matrix4;
    set needsUpdate(value: boolean);
    frameUpdate?: (frame: { renderer: WebGLRenderer; camera: PerspectiveCamera; renderSize: Vector2 }) => void;
    quaternion: { setFromRotationMatrix(matrix: unknown): unknown };
    userData: Record<string, unknown>;
    dispose(): void;
    updateGenerator(): void;
  }
}

declare module 'playcanvas' {
  export const PIXELFORMAT_RGBA8U: number;
  export const PIXELFORMAT_RGBA16U: number;
  export const PIXELFORMAT_RGBA32U: number;
  export const PIXELFORMAT_RGBA32F: number;
  export const WORKBUFFER_UPDATE_ONCE: number;
  export interface Asset {
    file?: { contents?: ArrayBuffer } | null;
    fire(name: string, ...values: unknown[]): unknown;
  }
  export interface AppBase {
    graphicsDevice: { maxTextureSize: number; width: number; height: number };
    systems: { camera: { cameras: CameraComponent[] } };
    on(name: string, listener: () => void): void;
    off(name: string, listener: () => void): void;
    scene?: { gsplatCentersEnabled?: boolean; gsplat?: { antiAlias: boolean; splatBudget: number } };
  }
  export interface CameraComponent {
    viewMatrix: Mat4;
    projectionMatrix: Mat4;
    rect: { z: number; w: number };
    nearClip: number;
  }
  export class Entity {
    gsplat?: { workBufferUpdate: number; layers: number[] };
    addComponent(name: string, data: object): void;
    addChild(child: Entity): void;
    getWorldTransform(): Mat4;
    once(name: string, listener: () => void): void;
    destroy(): void;
    setLocalRotation(rotation: Quat): void;
  }
  export class Vec3 {
    constructor(...values: number[]);
    x: number;
  }
  export class Mat4 {
    data: Float32Array;
    mul2(a: Mat4, b: Mat4): this;
  }
  export class Quat {
    setFromMat4(matrix: Mat4): this;
  }
  export class Texture {
    static createDataTexture2D(
      device: object,
      name: string,
      width: number,
      height: number,
      format: number,
      levels: ArrayBufferView[],
    ): Texture;
  }
  export class GSplatFormat {
    constructor(device: object, streams: object[], options: { readGLSL: string; readWGSL: string });
  }
  export class GSplatResourceBase {
    constructor(device: object, data: object, options: object);
    device: { maxTextureSize: number };
    gsplatData: any;
    streams: { textures: Map<string, Texture>; textureDimensions: { set(x: number, y: number): unknown } };
    parameters: Map<string, unknown>;
    _format: GSplatFormat | null;
    destroy(): void;
  }
}
