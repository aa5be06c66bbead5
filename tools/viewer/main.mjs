// SPDX-License-Identifier: Apache-2.0
// The page: an engine, a camera that the user moves, and the overlay.
//
// Parameters: ?scene=URL&camera=JSON-or-its-URL&view=0&up=x,y,z&axes=RDF&size=WxH&background=rrggbb&ui=0
// &controls=none&backend=webgl2
// `window.csplatViewer` lets programs control the page; its `ready` resolves when the scene has been drawn completely.

import { E_CONTEXT, E_INPUT } from './engine_error.mjs';
import { MeasureCard, measure } from './measure.mjs';
import { SaveOffer, upWord } from './save_offer.mjs';
import { Overlay, element } from './overlay.mjs';
import { embedded, nameOf, readWishes } from './page.mjs';
import { SceneViewer } from './viewer.mjs';

const BACKGROUNDS = /** @type {[number, number, number][]} */ ([
  [0, 0, 0],
  [0.5, 0.5, 0.5],
  [1, 1, 1],
]);

const page = embedded();
const address = Object.fromEntries(new URLSearchParams(location.search));
const { wishes, complaints } = readWishes(new URLSearchParams({ ...page?.wishes, ...address }));
const canvas = element('canvas', HTMLCanvasElement);
const overlay = new Overlay({ open: (file) => void show(file, file.name) });
const keep = new SaveOffer({
  file: async (changes) => {
    if (!showing.engine) throw new Error('no scene is loaded');
    return showing.engine.fileWith(changes);
  },
  say: (text) => overlay.toast(text),
});
const calm = matchMedia('(prefers-reduced-motion: reduce)');
const showing = new SceneViewer(canvas, wishes, {
  calm: () => calm.matches || wishes.size !== null || !wishes.ui,
  header: () => {
    otherBackground(0);
    overlay.describe(view.facts.title || overlay.name, view.facts.licence);
  },
  placed: () => tools(true),
  chosen: (point) => overlay.point(point),
  progress: (progress) => overlay.progress(progress),
  frame: (stats) => overlay.statistics(stats, showing.stage.moving),
  shown: (stats) => {
    overlay.statistics(stats, false);
    overlay.done();
  },
  failed: (report) => {
    const isScene = report.code !== E_CONTEXT;
    if (report.fatal || !isScene) overlay.error(report, showing.engine !== null && isScene);
    else if (report.reason === 'replaced') overlay.toast('The file was replaced on the server. It is opened anew.');
    else if (report.code === E_INPUT) overlay.toast('The connection is lost. It is tried again.');
    else overlay.warn(report);
  },
});
const { view } = showing;
document.documentElement.classList.toggle('bare', !wishes.ui);
document.documentElement.classList.toggle('fixed', wishes.size !== null);

const measured = new MeasureCard();

/** The scene that is shown. @type {{source: string | Blob | ArrayBuffer, name: string} | null} */
let current = null;
let isMeasuring = false;

let shade = 0; // index of the current background

/**
 * Replace the current scene.
 *
 * @param {string | Blob | ArrayBuffer} source
 * @param {string} name
 */
async function show(source, name) {
  shade = 0;
  current = { source, name };
  measured.hide();
  overlay.begin(name);
  keep.hide();
  tools(false);
  await showing.show(source);
}

/** @param {boolean} known whether a scene is loaded */
function tools(known) {
  element('upright', HTMLElement).hidden = !known || view.knowsUp;
  element('cameras', HTMLElement).hidden = !known || view.cameras.length < 2;
}

/** @param {number} step */
function otherCamera(step) {
  const name = view.otherCamera(step);
  if (name) overlay.toast(name);
}

/** Available backgrounds. */
function backgrounds() {
  const own = showing.background;
  return [own, ...BACKGROUNDS.filter((colour) => String(colour) !== String(own))];
}

/** @param {number} step */
function otherBackground(step) {
  const all = backgrounds();
  shade = (shade + step) % all.length;
  const background = all[shade];
  showing.engine?.setBackground(background);
  const isClear = background === 'transparent';
  document.documentElement.classList.toggle('clear', isClear);
  const colour = isClear ? background : `rgb(${background.map((value) => Math.round(255 * value))})`;
  document.querySelector('meta[name=theme-color]')?.setAttribute('content', colour); // colours the bars of a phone's browser
}

/** @param {number} degree */
function shDegree(degree) {
  showing.engine?.setShDegree(degree);
  showing.draw();
  overlay.toast(`Colour detail: degree ${degree}`);
}

function turnUpright() {
  const { engine } = showing;
  if (!engine?.bounds) return;
  const { up, isSaid } = view.turnUpright();
  element('upright', HTMLElement).hidden = false; // allows turning the scene further
  if (isSaid) {
    keep.hide();
    overlay.toast(`${upWord(up).replace('-', '−')} is up, as in the file`);
  } else keep.show(overlay.name, { up });
}

/** Offer the current camera as the first view of the file. */
function keepView() {
  const { camera } = showing;
  if (camera) keep.show(overlay.name, { view: camera, ...(view.isTurned && { up: view.up }) });
}

async function measureFrames() {
  if (!current || isMeasuring) return;
  isMeasuring = true;
  const { width, height } = showing.stage.full;
  try {
    measured.show(await measure({ ...current, rig: showing.rig, width, height }, (text) => overlay.toast(text)));
  } catch (error) {
    overlay.toast(`Nothing was measured: ${error instanceof Error ? error.message : error}`);
  } finally {
    isMeasuring = false;
  }
}

async function fullScreen() {
  try {
    await (document.fullscreenElement ? document.exitFullscreen() : document.documentElement.requestFullscreen());
  } catch {
    overlay.toast('This browser does not allow full screen here');
  }
}

/** @type {Record<string, () => void>} by key code, or by the id of a button */
const ACTIONS = {
  KeyR: () => view.goHome(),
  KeyF: () => void fullScreen(),
  KeyH: () => overlay.toggleHelp(),
  KeyI: () => overlay.toggleStatistics(),
  KeyM: () => void measureFrames(),
  KeyO: () => overlay.chooseFile(),
  KeyU: turnUpright,
  KeyV: keepView,
  KeyB: () => otherBackground(1),
  BracketLeft: () => otherCamera(-1),
  BracketRight: () => otherCamera(1),
  Escape: () => {
    overlay.hideError();
    keep.hide();
    measured.hide();
  },
  Digit0: () => shDegree(0),
  Digit1: () => shDegree(1),
  Digit2: () => shDegree(2),
  Digit3: () => shDegree(3),
  Digit4: () => shDegree(4),
};
const BUTTONS = {
  reset: 'KeyR',
  full: 'KeyF',
  upright: 'KeyU',
  previous: 'BracketLeft',
  next: 'BracketRight',
  'help-upright': 'KeyU',
  'help-view': 'KeyV',
  'help-background': 'KeyB',
  'help-measure': 'KeyM',
};

function listen() {
  const { classList } = document.documentElement;
  addEventListener('keydown', ({ key }) => key === 'Tab' && classList.add('keys'));
  addEventListener('pointerdown', () => classList.remove('keys'));
  addEventListener('keydown', (event) => {
    const { code, key, ctrlKey, metaKey, altKey, repeat, target } = event;
    if (ctrlKey || metaKey || altKey || repeat) return;
    const dialog = target instanceof Element && target.closest('dialog');
    const action = ACTIONS[key === '?' ? 'KeyH' : code];
    if (!action || (dialog && code !== 'KeyH')) return;
    event.preventDefault();
    action();
  });
  for (const [id, code] of Object.entries(BUTTONS)) element(id, HTMLElement).addEventListener('click', ACTIONS[code]);
  element('full', HTMLElement).hidden = !document.fullscreenEnabled;
}

async function start() {
  listen();
  if (!(await showing.start())) return;
  const complaint = await showing.readCameras();
  if (complaint) complaints.push(complaint);
  if (complaints.length) overlay.toast(complaints.join('; '));
  if (page) await show(page.scene(), page.name);
  else if (wishes.scene !== null) await show(new URL(wishes.scene, document.baseURI).href, nameOf(wishes.scene));
  else overlay.welcome();
}

const viewer = {
  get engine() {
    return showing.engine;
  },
  rig: showing.rig,
  controls: showing.controls,
  stage: showing.stage,
  /** Resolves when the first scene is shown or has failed; `#error` is then visible. */
  ready: Promise.resolve(),
  show,
};
/** @type {any} */ (window).csplatViewer = viewer;
viewer.ready = start();
