// The page: an engine, a camera that a person moves, and what stands over the scene.
//
// Parameters: ?scene=URL&camera=JSON-or-its-URL&view=0&up=x,y,z&seems=x,y,z&axes=RDF&size=WxH&background=rrggbb&ui=0
// `window.csplatViewer` lets programs drive the page; its `ready` resolves when the scene is drawn for good.

import { Controls } from './controls.mjs';
import { createEngine } from './engine.mjs';
import { KeepOffer, upWord } from './keep.mjs';
import { Overlay, element } from './overlay.mjs';
import { embedded, fetchCameras, nameOf, readWishes } from './page.mjs';
import { Rig } from './rig.mjs';
import { SceneView, emptyPose } from './sceneview.mjs';
import { Stage } from './stage.mjs';

/**
 * @typedef {import('./types.d.ts').Engine} Engine
 * @typedef {import('./types.d.ts').ErrorReport} ErrorReport
 */

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
const keep = new KeepOffer({
  file: async (up) => {
    if (!engine) throw new Error('there is no scene');
    return engine.fileWithUp(up);
  },
  say: (text) => overlay.toast(text),
});
const rig = new Rig(emptyPose(), 1);
const stage = new Stage(canvas, wishes.size, draw);
const calm = matchMedia('(prefers-reduced-motion: reduce)');
/** @type {Controls} */
const controls = new Controls(canvas, rig, {
  moved: () => {
    stage.moved();
    draw();
  },
  pivotAt: (x, y) => view.pivotAt(x, y, canvas.clientWidth, canvas.clientHeight),
  calm: () => calm.matches || wishes.size !== null || !wishes.ui,
});
/** @type {SceneView} */
const view = new SceneView(rig, controls, wishes);
document.documentElement.classList.toggle('bare', !wishes.ui);

/** @type {Engine | null} */
let engine = null;
let shade = 0; // which of `backgrounds` is behind the scene
let turn = 0; // counts scenes, so that what is late for one is not shown for the next

function draw() {
  if (!engine) return;
  engine.setCamera(rig.camera(stage.width, stage.height));
  engine.requestFrame();
}

/**
 * Show a scene in the place of the present one.
 *
 * @param {string | Blob | ArrayBuffer} source
 * @param {string} name
 */
async function show(source, name) {
  if (!engine) return;
  const mine = ++turn;
  shade = 0;
  view.begin();
  overlay.begin(name);
  keep.hide();
  tools(false);
  try {
    await engine.open(source);
    if (mine !== turn) return;
    place();
    await engine.settled();
    if (mine !== turn) return;
    overlay.statistics(engine.stats, false);
    overlay.done();
  } catch (error) {
    if (mine === turn) overlay.error(asReport(error));
  }
}

/**
 * @param {unknown} error
 * @returns {Omit<ErrorReport, 'fatal'>}
 */
function asReport(error) {
  const { code = 'E_UNKNOWN', message = String(error), offset, clause } = /** @type {any} */ (error);
  return { code, message, offset, clause };
}

/** Put the camera where it should be by what is known of the scene so far. */
function place() {
  if (!engine?.bounds || !engine.header) return;
  const { splatCount, splatsDrawn } = engine.stats;
  if (view.place(engine.bounds, splatCount, splatsDrawn === 0)) draw();
  tools(true);
}

/** @param {boolean} known whether a scene is */
function tools(known) {
  element('upright', HTMLElement).hidden = !known || view.knowsUp;
  element('cameras', HTMLElement).hidden = !known || view.cameras.length < 2;
}

/** @param {number} step */
function otherCamera(step) {
  const name = view.otherCamera(step);
  if (name) overlay.toast(name);
}

/** What may stand behind the scene: first what the address says, else what it was trained in front of, else black. */
function backgrounds() {
  const own = wishes.background ?? view.facts.background ?? BACKGROUNDS[0];
  return [own, ...BACKGROUNDS.filter((colour) => String(colour) !== String(own))];
}

/** @param {number} step */
function otherBackground(step) {
  const all = backgrounds();
  shade = (shade + step) % all.length;
  engine?.setBackground(all[shade]);
  const colour = `rgb(${all[shade].map((value) => Math.round(255 * value))})`;
  document.querySelector('meta[name=theme-color]')?.setAttribute('content', colour); // a phone's bars
}

/** @param {number} degree */
function shDegree(degree) {
  engine?.setShDegree(degree);
  draw();
  overlay.toast(`Colour detail: degree ${degree}`);
}

function turnUpright() {
  if (!engine?.bounds) return;
  const { up, isSaid } = view.turnUpright(engine.bounds, engine.stats.splatCount);
  element('upright', HTMLElement).hidden = false; // who turns a scene once may want to go on
  if (isSaid) {
    keep.hide();
    overlay.toast(`${upWord(up).replace('-', '−')} is up, as the scene says`);
  } else keep.show(overlay.name, up);
}

async function fullScreen() {
  try {
    await (document.fullscreenElement ? document.exitFullscreen() : document.documentElement.requestFullscreen());
  } catch {
    overlay.toast('This browser does not allow a full screen here');
  }
}

/** @type {Record<string, () => void>} by the code of the key, and by the id of the button where there is one */
const ACTIONS = {
  KeyR: () => view.goHome(),
  KeyF: () => void fullScreen(),
  KeyH: () => overlay.toggleHelp(),
  KeyI: () => overlay.toggleStatistics(),
  KeyO: () => overlay.chooseFile(),
  KeyU: turnUpright,
  KeyB: () => otherBackground(1),
  BracketLeft: () => otherCamera(-1),
  BracketRight: () => otherCamera(1),
  Escape: () => {
    overlay.hideError();
    keep.hide();
  },
  Digit0: () => shDegree(0),
  Digit1: () => shDegree(1),
  Digit2: () => shDegree(2),
  Digit3: () => shDegree(3),
};
const BUTTONS = {
  reset: 'KeyR',
  full: 'KeyF',
  upright: 'KeyU',
  previous: 'BracketLeft',
  next: 'BracketRight',
  'help-upright': 'KeyU',
  'help-background': 'KeyB',
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

/** Read the cameras of the address; a wrong one costs a line on the page, not the scene. */
async function readCameras() {
  if (wishes.camera === null) return;
  try {
    view.useCameras(await fetchCameras(wishes.camera), wishes.view);
  } catch (error) {
    complaints.push(`The camera cannot be used: ${error instanceof Error ? error.message : error}`);
  }
}

async function start() {
  listen();
  try {
    engine = await createEngine(canvas, {
      background: backgrounds()[0],
      workerFactory: page?.workerFactory,
      onHeader: (header, description) => {
        view.read(header, description);
        otherBackground(0);
        overlay.describe(view.facts.title || overlay.name, view.facts.licence);
        place();
      },
      onProgress: (progress) => {
        overlay.progress(progress);
        if (view.waits) place();
      },
      onFrame: (stats) => {
        stage.drawn(stats.frameMs);
        overlay.statistics(stats, stage.moving);
      },
      // what `open` rejects with is shown by `show`; what comes later, or without a scene, is shown here
      onError: (report) => overlay.error(report, report.code !== 'E_CONTEXT'),
    });
  } catch (error) {
    overlay.error(asReport(error), false);
    return;
  }
  viewer.engine = engine;
  stage.attach(engine);
  await readCameras();
  if (complaints.length) overlay.toast(complaints.join('; '));
  if (page) await show(page.scene(), page.name);
  else if (wishes.scene !== null) await show(new URL(wishes.scene, document.baseURI).href, nameOf(wishes.scene));
  else overlay.welcome();
}

const viewer = {
  /** @type {Engine | null} */
  engine: null,
  rig,
  controls,
  stage,
  /** Resolves when the first scene is shown or has failed; `#error` is visible then. */
  ready: Promise.resolve(),
  show,
};
/** @type {any} */ (window).csplatViewer = viewer;
viewer.ready = start();
