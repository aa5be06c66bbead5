// SPDX-License-Identifier: Apache-2.0
// Measures the back ends on the scene of the page, and offers the result as JSON.

import { createEngine } from './engine.mjs';
import { OrbitCamera } from './orbit_camera.mjs';
import { element, megabytes, milliseconds, saveFile } from './overlay.mjs';

/**
 * @typedef {import('./types.d.ts').Backend} Backend
 *
 * @typedef {object} Scene
 * @property {string | Blob | ArrayBuffer} source
 * @property {string} name
 * @property {OrbitCamera} rig
 * @property {number} width of the picture, pixels
 * @property {number} height
 *
 * @typedef {object} Result
 * @property {Backend} backend
 * @property {string} renderer name of the device
 * @property {string} pictureFormat
 * @property {number} frameMs median, of all views
 * @property {number[]} viewMs median of each view
 * @property {number} sortMs of the last sort on the CPU; 0 if the GPU sorts, as a part of each frame
 * @property {number} loadMs until everything is decoded and drawn
 * @property {number} sceneBytes on the GPU
 * @property {number} workBytes on the GPU, that depend on the picture
 *
 * @typedef {{scene: string, splats: number, fileBytes: number, shDegree: number, width: number, height: number,
 *   views: number, framesPerView: number, browser: string, results: Result[], missing: Backend[]}} Report
 */

const BACKENDS = /** @type {const} */ (['webgl2', 'webgpu-tiles', 'webgpu-quads']);
const VIEWS = 4; // around the pivot
const ROUNDS = 5; // measurements of each view
const TOGETHER = 4; // frames per measurement, drawn without waiting for each
const PATIENCE_MS = 3000; // for each view

/**
 * Draw a scene with each back end, from views around the pivot.
 *
 * @param {Scene} scene
 * @param {(text: string) => void} say
 * @returns {Promise<Report>}
 */
export async function measure(scene, say) {
  const { name, width, height } = scene;
  const report = { scene: name, splats: 0, fileBytes: 0, shDegree: 0, width, height };
  /** @type {Result[]} */
  const results = [];
  /** @type {Backend[]} */
  const missing = [];
  for (const backend of BACKENDS) {
    say(`Measuring ${backend} …`);
    const engine = await createEngine(document.createElement('canvas'), { backend });
    try {
      const isMissing = backend !== 'webgl2' && !engine.stats.glRenderer.includes('WebGPU');
      if (isMissing) missing.push(backend);
      else results.push(await measureOne(engine, backend, scene));
      const { splatCount, fileSize, shDegree } = engine.stats;
      if (!isMissing) Object.assign(report, { splats: splatCount, fileBytes: fileSize, shDegree });
    } finally {
      engine.close();
    }
  }
  const framesPerView = ROUNDS * TOGETHER;
  return { ...report, views: VIEWS, framesPerView, browser: navigator.userAgent, results, missing };
}

/**
 * @param {import('./types.d.ts').Engine} engine
 * @param {Backend} backend
 * @param {Scene} scene
 * @returns {Promise<Result>}
 */
async function measureOne(engine, backend, { source, rig, width, height }) {
  const around = new OrbitCamera(rig.pose, rig.extent);
  const start = performance.now();
  engine.setSize(width, height);
  engine.setCamera(around.camera(width, height));
  await engine.open(source);
  await engine.settled();
  const loadMs = performance.now() - start;
  const viewMs = [];
  for (let view = 0; view < VIEWS; view++) {
    await engine.timeFrames(1); // sorts, compiles, and makes room
    const begun = performance.now();
    const times = [];
    while (times.length < ROUNDS && (times.length === 0 || performance.now() - begun < PATIENCE_MS)) {
      times.push(...(await engine.timeFrames(1, TOGETHER)));
    }
    viewMs.push(median(times));
    around.orbit((2 * Math.PI) / VIEWS, 0);
    engine.setCamera(around.camera(width, height));
  }
  const { glRenderer, pictureFormat, sortMs, gpuBytes, workBytes } = engine.stats;
  return {
    backend,
    renderer: glRenderer,
    pictureFormat,
    frameMs: median(viewMs),
    viewMs,
    sortMs,
    loadMs,
    sceneBytes: gpuBytes,
    workBytes,
  };
}

/** @param {number[]} values */
function median(values) {
  const sorted = [...values].sort((a, b) => a - b);
  const half = sorted.length >> 1;
  return sorted.length % 2 ? sorted[half] : (sorted[half - 1] + sorted[half]) / 2;
}

/** Shows reports in the page. */
export class MeasureCard {
  constructor() {
    /** @type {Report | null} */
    this.report = null;
    element('measured-close', HTMLElement).addEventListener('click', () => this.hide());
    element('measured-save', HTMLElement).addEventListener('click', () => {
      if (!this.report) return;
      const text = `${JSON.stringify(this.report, null, 2)}\n`;
      saveFile(text, `${this.report.scene.replace(/\.csplat$/i, '') || 'scene'}-frames.json`, 'application/json');
    });
  }

  /** @param {Report} report */
  show(report) {
    this.report = report;
    const { splats, width, height, results, missing } = report;
    const row = (/** @type {string[]} */ cells, /** @type {'th' | 'td'} */ kind) => {
      const line = document.createElement('tr');
      line.append(...cells.map((textContent) => Object.assign(document.createElement(kind), { textContent })));
      return line;
    };
    const what = `${splats.toLocaleString('en')} splats, ${width} × ${height} pixels, median of ${VIEWS} views`;
    const lack = missing.length ? `. This browser lacks ${missing.join(' and ')}` : '';
    element('measured-what', HTMLElement).textContent = `${what}${lack}.`;
    element('measured-table', HTMLElement).replaceChildren(
      row(['', 'Frame', 'Memory'], 'th'),
      ...results.map(({ backend, frameMs, sceneBytes, workBytes }) =>
        row([backend, milliseconds(frameMs), `${megabytes(sceneBytes + workBytes)} MB`], 'td'),
      ),
    );
    element('measured', HTMLElement).hidden = false;
    element('measured-close', HTMLElement).focus();
  }

  hide() {
    element('measured', HTMLElement).hidden = true;
  }
}
