// SPDX-License-Identifier: Apache-2.0
// The parameters of the address, and the error messages.
import assert from 'node:assert/strict';
import { readdirSync } from 'node:fs';
import { test } from 'node:test';

import * as spec from '../../../codec/js/spec.mjs';
import { readCamera } from '../../../codec/js/first_view.mjs';
import { roundedCamera, saveCommand, upWord } from '../save_offer.mjs';
import { explain } from '../messages.mjs';
import { readCameras, readWishes } from '../page.mjs';

test('an empty address has no parameters', () => {
  const { wishes, complaints } = readWishes(new URLSearchParams());
  assert.deepEqual(complaints, []);
  assert.deepEqual(wishes, {
    scene: null,
    camera: null,
    view: 0,
    up: null,
    axes: null,
    size: null,
    background: null,
    limits: { kind: 'free', distance: [0, Infinity], polar: [0, Math.PI], azimuth: [-Math.PI, Math.PI] },
    ui: true,
    backend: 'auto',
  });
});

test('controls have limits, and a background may be transparent', () => {
  const { wishes, complaints } = readWishes(
    new URLSearchParams(
      'background=Transparent&controls=orbit max-distance=2.5 min-polar=45%20 max-polar=90 min-azimuth=-45',
    ),
  );
  assert.deepEqual(complaints, []);
  const { background, limits } = wishes;
  assert.equal(background, 'transparent');
  const [distance, polar, azimuth] = [[0, 2.5], [Math.PI / 4, Math.PI / 2], [-Math.PI / 4, Math.PI]]; // prettier-ignore
  assert.deepEqual(limits, { kind: 'orbit', distance, polar, azimuth });
  assert.equal(readWishes(new URLSearchParams('controls=none')).wishes.limits.kind, 'none');
});

test('a word that controls do not have is named, next to all limits', () => {
  const unknown = { fly: 'fly', 'orbit  max-azimut=9 min-polar=1': 'max-azimut=9', 'none orbit': 'none', 'max-polar=-1': 'max-polar=-1' }; // prettier-ignore
  for (const [controls, word] of Object.entries(unknown)) {
    const [complaint] = readWishes(new URLSearchParams({ controls })).complaints;
    assert.ok(complaint.startsWith(`controls has the word “${word}”, expected `), complaint);
    for (const name of ['distance', 'polar', 'azimuth'])
      assert.match(complaint, new RegExp(`min-${name}.* max-${name}`));
  }
});

test('every parameter is read', () => {
  const { wishes, complaints } = readWishes(
    new URLSearchParams(
      'scene=/a.csplat&camera=[]&view=3&axes=RUB&size=512x384&background=%23ff8000&ui=0&backend=webgpu-quads',
    ),
  );
  assert.deepEqual(complaints, []);
  assert.deepEqual(wishes.size, { width: 512, height: 384 });
  assert.deepEqual(wishes.background, [1, 128 / 255, 0]);
  const { scene, camera, view, axes, ui, backend } = wishes;
  assert.deepEqual([scene, camera, view, axes, ui, backend], ['/a.csplat', '[]', 3, 'RUB', false, 'webgpu-quads']);
});

test('up is normalised', () => {
  const up = (text) => readWishes(new URLSearchParams({ up: text })).wishes.up;
  assert.deepEqual(up('0,-1,0'), [0, -1, 0]);
  assert.deepEqual(
    up('0,3,-4').map((x) => Math.round(1e9 * x) / 1e9),
    [0, 0.6, -0.8],
  );
  assert.deepEqual(up('1e300,0,-0'), [1, 0, -0]);
});

const WRONG = ['size=0x5', 'size=20', 'background=red', 'axes=RLF', 'axes=RDFU', 'view=-1', 'view=x', 'backend=cpu'];
const LIMITS = [
  'controls=fly',
  'controls=min-polar=90 max-polar=80',
  'controls=none orbit',
  'controls=max-polar',
  'controls=min-distance=-1',
  'controls=min-azimuth=10',
  'controls=min-azimuth=-20 max-azimuth=-10',
];
const NOWHERE = ['up=z', 'up=0,1', 'up=0,0,0', 'up=1,2,3,4', 'up=1,e,2', 'up=1e999,0,0'];
for (const query of [...WRONG, ...LIMITS, ...NOWHERE]) {
  test(`${query} is reported and ignored`, () => {
    const { wishes, complaints } = readWishes(new URLSearchParams(query));
    assert.equal(complaints.length, 1);
    assert.deepEqual(wishes, readWishes(new URLSearchParams()).wishes);
  });
}

// Each camera is at 1 2 3 and looks along x, z up: 64 by 48 pixels, focal length 50.
const FOREIGN = {
  'cameras.json of INRIA': [
    {
      id: 0,
      img_name: 'a',
      width: 64,
      height: 48,
      fx: 50,
      fy: 50,
      position: [1, 2, 3],
      rotation: [
        [0, 0, 1],
        [-1, 0, 0],
        [0, -1, 0],
      ],
    },
  ],
  'a camera path of nerfstudio': {
    render_width: 64,
    render_height: 48,
    camera_path: [
      {
        fov: (360 / Math.PI) * Math.atan(24 / 50),
        camera_to_world: [0, 0, -1, 1, -1, 0, 0, 2, 0, 1, 0, 3, 0, 0, 0, 1],
      },
    ],
  },
  'transforms.json': {
    ...{ w: 64, h: 48, camera_angle_x: 2 * Math.atan(32 / 50) },
    frames: [
      {
        file_path: 'a',
        transform_matrix: [
          [0, 0, -1, 1],
          [-1, 0, 0, 2],
          [0, 1, 0, 3],
          [0, 0, 0, 1],
        ],
      },
    ],
  },
};

for (const [what, file] of Object.entries(FOREIGN)) {
  test(`${what} gives cameras`, () => {
    const [entry] = readCameras(JSON.stringify(file));
    const { viewmat, lens } = readCamera(entry);
    assert.deepEqual(
      viewmat.map((value) => value + 0),
      [0, -1, 0, 2, 0, 0, -1, 3, 1, 0, 0, -1, 0, 0, 0, 1],
    );
    for (const name of ['fx', 'fy']) assert.ok(Math.abs(lens[name] - 50) < 1e-9, `${lens[name]}`);
    assert.deepEqual([lens.cx, lens.cy, lens.W, lens.H], [32, 24, 64, 48]);
  });
}

test('invalid cameras of other programs are refused', () => {
  const { frames, ...document } = FOREIGN['transforms.json'];
  const turned = [{ transform_matrix: [0, 1, 2, 3].map((k) => frames[0].transform_matrix.map((row) => row[k])) }];
  for (const [wrong, pattern] of [
    [{ ...document, frames: turned }, /transform_matrix has the last row 1 2 3 1, expected 0 0 0 1/],
    [{ ...document, frames: [{}] }, /transform_matrix is not/],
    [{ ...FOREIGN['a camera path of nerfstudio'], camera_type: 'equirectangular' }, /camera_type is equirectangular/],
    [[{ rotation: [1] }], /rotation and position/],
  ]) {
    assert.throws(() => readCameras(JSON.stringify(wrong)), pattern);
  }
});

test('the address may contain cameras', () => {
  assert.deepEqual(readCameras(' [{"W": 1}, {"W": 2}]'), [{ W: 1 }, { W: 2 }]);
  assert.deepEqual(readCameras('{"W": 1}'), [{ W: 1 }]);
  assert.throws(() => readCameras('[1'), SyntaxError);
});

test('every code of the format has a message', () => {
  const codes = Object.entries(spec)
    .filter(([name]) => /^ERROR_[A-Z]+$/.test(name))
    .map(([, code]) => code)
    .filter((code) => typeof code === 'string' && code.startsWith('E_'));
  assert.ok(codes.length > 15);
  for (const code of codes) assert.notEqual(explain({ code, message: '' }).title, 'Something went wrong.', code);
});

test('an error has its code, offset and clause once', () => {
  const message = 'E_CRC at byte 12345 (CHK-1): the chunk has another CRC';
  const { title, facts } = explain({ code: 'E_CRC', message, offset: 12345, clause: 'CHK-1' });
  assert.equal(facts, 'E_CRC at byte 12,345 (CHK-1): the chunk has another CRC');
  assert.match(title, /damaged/);
});

test('advice follows what failed, not only the code', () => {
  const fetching = (facts) => explain({ code: 'E_INPUT', message: 'x', ...facts });
  const expected = [
    [{ reason: 'connection' }, /could not be read/, /connection/],
    [{ reason: 'server' }, /server does not send/, /server/],
    [{ reason: 'busy', status: 503 }, /cannot send the file now/, /later/],
    [{ reason: 'refused', status: 403 }, /access/, /expired/],
    [{ reason: 'refused', status: 401 }, /access/, /Sign in/],
    [{ reason: 'refused', status: 404 }, /could not be read/, /no file at this address/],
    [{ reason: 'refused', status: 418 }, /could not be read/, /address/],
    [{ reason: 'replaced' }, /was replaced on the server/, /Reload/],
    [{ reason: 'local' }, /from disk/, /csplat export-html.*local server/],
    [{}, /could not be read/, /address/],
  ];
  for (const [facts, title, advice] of expected) {
    assert.match(fetching(facts).title, title, JSON.stringify(facts));
    assert.match(fetching(facts).advice, advice, JSON.stringify(facts));
  }
  assert.match(explain({ code: 'E_CRC', message: 'x' }).advice, /^Reload the page/);
});

test('all modules but the one of the page can be imported where no document is', async () => {
  const folder = new URL('../', import.meta.url);
  const listen = globalThis.onmessage;
  for (const name of readdirSync(folder)) {
    if (name.endsWith('.mjs') && name !== 'main.mjs') await import(new URL(name, folder));
  }
  globalThis.onmessage = listen; // of the worker's module
});

test('a PLY is recognised by its name', () => {
  assert.match(explain({ code: 'E_MAGIC', message: 'x' }, 'scene.PLY').title, /PLY/);
  assert.match(explain({ code: 'E_MAGIC', message: 'x' }, 'scene.zip').title, /not a \.csplat/);
});

test('the command that saves up direction and first view can be pasted into a shell', () => {
  assert.equal(saveCommand('scene.csplat', { up: [0, 0, 1] }), 'csplat encode scene.ply scene.csplat --up z');
  assert.equal(saveCommand('a.b.CSPLAT', { up: [0, -1, -0] }), 'csplat encode a.b.ply a.b.csplat --up -y');
  assert.equal(
    saveCommand("my dog's $HOME.csplat", { up: [1, 0, 0] }),
    "csplat encode 'my dog'\\''s $HOME.ply' 'my dog'\\''s $HOME.csplat' --up x",
  );
  const view = { K: [[1 / 3]], viewmat: [[-0, 1e-9]], W: 4, H: 3, near: 0.2 };
  assert.equal(
    saveCommand('scene.csplat', { view, up: [0, 0, 1] }),
    'csplat encode scene.ply scene.csplat --cameras view.json --up z',
  );
  assert.deepEqual(roundedCamera(view), { ...view, K: [[0.3333333]], viewmat: [[0, 1e-9]] });
  assert.equal(upWord([-0.006123456, -0.8760004, 0.4822]), '-0.006123,-0.876,0.4822');
});
