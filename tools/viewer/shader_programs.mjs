// SPDX-License-Identifier: Apache-2.0
// Shader programs of the WebGL 2 back end and their uniforms.

import { tileTexels } from './shader_attributes.mjs';
import { COVER_VERTEX, PROJECT_FRAGMENT, RESOLVE_FRAGMENT, SPLAT_FRAGMENT, SPLAT_VERTEX } from './shaders.mjs';

/**
 * @typedef {import('./renderer.mjs').SceneLayout} SceneLayout
 * @typedef {import('./types.d.ts').View} View
 */

/** Texture units by sampler name. */
export const UNITS = Object.freeze({
  uFirst: 0,
  uStore: 1,
  uTiles: 2,
  uPlaces: 3,
  uBlocks: 4,
  uOrder: 5,
  uRecordPlace: 6,
  uRecordLook: 7,
  uPicture: 8,
});

/** A linked program and the locations of its uniforms. */
class Program {
  /**
   * @param {WebGL2RenderingContext} gl
   * @param {string} vertex
   * @param {string} fragment
   */
  constructor(gl, vertex, fragment) {
    this.gl = gl;
    this.program = gl.createProgram();
    for (const [type, source] of /** @type {[number, string][]} */ ([
      [gl.VERTEX_SHADER, vertex],
      [gl.FRAGMENT_SHADER, fragment],
    ])) {
      const shader = gl.createShader(type);
      if (shader === null) continue; // context lost
      gl.shaderSource(shader, source);
      gl.compileShader(shader);
      gl.attachShader(this.program, shader);
      gl.deleteShader(shader);
    }
    gl.linkProgram(this.program);
    this.check();
    /** @type {Map<string, WebGLUniformLocation | null>} */
    this.places = new Map();
    gl.useProgram(this.program);
    for (const [name, unit] of Object.entries(UNITS)) gl.uniform1i(this.at(name), unit);
  }

  check() {
    const { gl, program } = this;
    if (gl.isContextLost() || gl.getProgramParameter(program, gl.LINK_STATUS)) return;
    const logs = (gl.getAttachedShaders(program) ?? []).map((shader) => gl.getShaderInfoLog(shader));
    throw new Error(`a shader of the viewer: ${[gl.getProgramInfoLog(program), ...logs].filter(Boolean).join('; ')}`);
  }

  /** @param {string} name name of a uniform */
  at(name) {
    let place = this.places.get(name);
    if (place === undefined) {
      place = this.gl.getUniformLocation(this.program, name);
      this.places.set(name, place);
    }
    return place;
  }
}

/** All programs. */
export class ShaderPrograms {
  /** @param {WebGL2RenderingContext} gl */
  constructor(gl) {
    this.gl = gl;
    this.project = new Program(gl, COVER_VERTEX, PROJECT_FRAGMENT);
    this.splat = new Program(gl, SPLAT_VERTEX, SPLAT_FRAGMENT);
    this.resolve = new Program(gl, COVER_VERTEX, RESOLVE_FRAGMENT);
  }

  /**
   * @param {View} view
   * @param {number[]} slopes limits of x/z and y/z
   * @param {SceneLayout} scene
   * @param {number} shDegree
   */
  setView(view, slopes, scene, shDegree) {
    const { gl, project, splat } = this;
    const m = view.viewmat;
    gl.useProgram(project.program);
    const rotation = [m[0], m[1], m[2], m[4], m[5], m[6], m[8], m[9], m[10]];
    gl.uniformMatrix3fv(project.at('uRotation'), true, rotation);
    gl.uniform4f(project.at('uFocal'), view.fx, view.fy, view.cx, view.cy);
    gl.uniform4fv(project.at('uSlopes'), slopes);
    gl.uniform2f(project.at('uSize'), view.width, view.height);
    gl.uniform1f(project.at('uNear'), view.near);
    gl.uniform1f(project.at('uOpacityLevels'), scene.opacityLevels);
    gl.uniform1i(project.at('uOpacitySquare'), Number(scene.opacitySquare));
    gl.uniform1i(project.at('uQuatLevels'), scene.quatLevels);
    gl.uniform1i(project.at('uAntialiased'), Number(scene.antialiased));
    gl.uniform1i(project.at('uDegree'), shDegree);
    gl.uniform1ui(project.at('uTileTexels'), tileTexels(scene.shDegree));
    gl.useProgram(splat.program);
    gl.uniform2f(splat.at('uSize'), view.width, view.height);
  }

  /**
   * @param {number} begin position in the order
   * @param {number} end
   */
  useProject(begin, end) {
    const { gl, project } = this;
    gl.useProgram(project.program);
    gl.uniform1ui(project.at('uBegin'), begin);
    gl.uniform1ui(project.at('uEnd'), end);
  }

  useSplat() {
    this.gl.useProgram(this.splat.program);
  }

  /** @param {number[]} background red, green, blue, alpha, premultiplied */
  useResolve(background) {
    const { gl, resolve } = this;
    gl.useProgram(resolve.program);
    gl.uniform4fv(resolve.at('uBackground'), background);
  }

  dispose() {
    for (const { program } of [this.project, this.splat, this.resolve]) this.gl.deleteProgram(program);
  }
}
