// The studio's pages, without a browser.

import assert from 'node:assert/strict';
import { beforeEach, test } from 'node:test';
import { Camera, Node, body, events, packed, page, serve, stepApp, wait } from './dom.mjs';
import { properName } from './server.js';
import { ImageView, colourBar } from './overlay.js';
import { LiveCamera } from './live_camera.js';
import { recordButton } from './recorder.js';
import { resultsStep } from './results_step.js';
import { scanStart } from './scan_start.js';
import { SolidView } from './solid_view.js';
import { startStep } from './start_step.js';
import { studyStep } from './study_step.js';

let camera;
beforeEach(() => { camera = new Camera(); });
const find = (id) => body.querySelector(`#${id}`);

test('names become some that the project takes', () => {
  const taken = /^[A-Za-z0-9_][A-Za-z0-9_. ()+-]{0,99}$/;
  for (const name of ['a.mp4', '.hidden', 'ü', '', `${'a'.repeat(20)} (${'b'.repeat(94)}.mp4`, ` ${'x'.repeat(200)}`]) {
    assert.match(properName(name), taken);
  }
  assert.equal(properName('part 1.inp'), 'part 1.inp');
});

// -- the study --------------------------------------------------------------------------------------

const RUBBER = { law: 'neo_hookean', young: '3 MPa', poisson: 0.45, prony: { relative_moduli: [0.6], times: ['2 s'] } };
const PUSH = { range: ['0 mm', '10 mm'], description: 'stroke of the machine' };

async function study(delay = 0) {
  const app = stepApp();
  const changes = [];
  const content = { materials: { rubber: RUBBER, mine: { law: 'user_material', function: 'law.py:f' } }, parameters: { push: PUSH } };
  const found = (text) => ({ text, content, problems: [], warnings: [], sets: [], cell_sets: [] });
  const laws = { neo_hookean: [['young', 'stress'], ['poisson', 'ratio']], yeoh: [['bulk', 'stress']] };
  serve({
    forms: () => ({ laws, materials: [], kinds: { supports: {}, loads: {}, contacts: {} } }),
    study: () => found('name = "x"\n'),
    change_study(change) { changes.push(change); return found('changed\n'); },
    async write_study({ text }) { await wait(delay); return found(text); },
  });
  await studyStep(app);
  const edit = (list, i) => find(list).children[i].all().find((one) => one.textContent === 'edit');
  return { app, changes, edit };
}

test('what a form does not show stays in an entry', async () => {
  const { changes, edit } = await study();
  await edit('parameters', 0).click();
  await find('save-parameters').click();
  await wait();
  await edit('materials', 0).click();
  await find('add-material').click();
  await wait();
  assert.deepEqual(changes, [{ section: 'parameters', key: 'push', value: PUSH }, { section: 'materials', key: 'rubber', value: RUBBER }]);
});

test('another law leaves no constants of the law before', async () => {
  const { changes, edit } = await study();
  await edit('materials', 0).click();
  find('law').value = 'yeoh';
  await find('law').fire('change');
  find('constant-bulk').value = '2';
  await find('add-material').click();
  await wait();
  assert.deepEqual(changes[0].value, { law: 'yeoh', bulk: '2 MPa', prony: RUBBER.prony });
});

test('an entry with another name is no second one', async () => {
  const { changes, edit } = await study();
  await edit('parameters', 0).click();
  find('parameter-name').value = 'stroke';
  await find('save-parameters').click();
  await wait();
  assert.deepEqual(changes, [{ section: 'parameters', key: 'stroke', value: PUSH }, { section: 'parameters', key: 'push', value: null }]);
});

test('an entry does not take the place of another one by its name', async () => {
  const { app, changes, edit } = await study();
  await edit('materials', 0).click();
  find('material-name').value = 'mine';
  await find('add-material').click();
  assert.deepEqual(changes, []);
  assert.equal(app.refused.length, 1);
});

test('a law without a form is edited in the text alone', async () => {
  const { edit } = await study();
  assert.equal(edit('materials', 1), undefined);
});

test('what is typed while the text is saved is kept', async () => {
  await study(30);
  const [text, save] = [find('study-text'), find('save-study')];
  text.value = 'one\n';
  await text.fire('input');
  const saving = save.click();
  text.value += 'two\n';
  await text.fire('input');
  await saving;
  assert.equal(text.value, 'one\ntwo\n');
  assert.equal(save.disabled, false);
  await save.click();
  assert.equal(save.disabled, true);
});

test('what is typed is saved before the next step', async () => {
  const { app } = await study();
  find('study-text').value = 'one\n';
  await find('study-text').fire('input');
  await find('to-build').click();
  assert.equal(find('save-study').disabled, true);
  assert.deepEqual(app.shown, ['build']);
});

// -- the start --------------------------------------------------------------------------------------

async function start({ pairs, numbers = null }) {
  const app = stepApp({ recording: { first: 0, last: 30 }, camera: {}, done: { build: true }, choices: {}, notes: {} });
  const saved = [];
  serve({
    model_mesh: () => packed({}, [['nodes', '<f4', [0, 0, 0]], ['triangles', '<i4', [0, 0, 0]]]),
    fit: () => packed({ residuals_px: [1, 1, 1, 1], rms_px: 1, worst: 0, parameters: {}, warnings: [], unit: 'MPa', top: 1 },
      [['pixels', '<f4', [0, 0]], ['order', '<i4', []], ['values', '<f4', [0]]]),
    start_files: () => ({ pairs, frame: 0, at_rest: false }),
    frame_numbers: () => ({ numbers }),
    model: () => ({ parameters: [] }),
    explore: () => ({ colours: Array(256).fill([1, 2, 3]) }),
    'model.json': () => ({}),
    frame: (number) => (Number(number) === 9 ? 'there is no frame 9' : {}),
    save_start(content) { saved.push(content); return {}; },
  });
  const fetching = globalThis.fetch;
  globalThis.fetch = (path, options) => (path === '/explore/model.json'
    ? Promise.resolve({ ok: true, json: async () => ({ colours: Array(256).fill([1, 2, 3]) }) }) : fetching(path, options));
  const step = await startStep(app);
  const slide = async (number) => { find('frame').value = number; await find('frame').fire('change'); };
  return { app, saved, slide, step };
}

const PAIRS = [[0, 0, 0, 1, 1], [1, 0, 0, 2, 1], [0, 1, 0, 1, 2], [1, 1, 0, 2, 2]];

test('pairs are saved with the frame that they were clicked in', async () => {
  const { saved, slide, step } = await start({ pairs: PAIRS });
  find('at-rest').checked = true;
  await find('at-rest').fire('change');
  assert.equal(find('save-start').disabled, false);
  await slide(5);
  assert.equal(find('save-start').disabled, true);
  assert.match(find('elsewhere').textContent, /frame 0/);
  await slide(0);
  await find('save-start').click();
  assert.equal(saved[0].frame, 0);
  step.close();
});

test('a frame that does not come is not the one that is shown', async () => {
  const { app, slide, step } = await start({ pairs: [] });
  await slide(3);
  await slide(9);
  assert.deepEqual(app.refused, ['there is no frame 9']);
  assert.equal(find('frame').value, '3');
  step.close();
});

test('of images with gaps the nearest one is shown', async () => {
  const { app, slide, step } = await start({ pairs: [], numbers: [0, 10, 20, 30] });
  await slide(9);
  assert.deepEqual(app.refused, []);
  assert.equal(find('frame').value, '10');
  step.close();
});

test('a keyframe that does not come is not the one that hints are of', async () => {
  const app = stepApp();
  const map = { keyframes: [0, 4, 8], n_tracked: 9, n_map_points: 99, flags: [] };
  let asked = null;
  serve({
    model_mesh: () => packed({}, [['nodes', '<f4', [0, 0, 0]], ['triangles', '<i4', [0, 0, 0]]]),
    scan: (of) => (typeof of === 'object'
      ? { source: 'v.mp4', is_own: false, recording: { frames: 9, first: 0 }, last: null, map, place: null }
      : of === '8' ? 'there is no frame 8' : {}),
    find_place(content) { asked = content; return {}; },
  });
  await scanStart(app);
  const slide = async (position) => { find('keyframe').value = position; await find('keyframe').fire('change'); };
  await slide(0);
  await slide(2);
  assert.deepEqual(app.refused, ['there is no frame 8']);
  await find('find-place').click();
  assert.equal(asked.frame, 0);
});

test('a scan that is left while its frame comes says nothing in the next step', async () => {
  const app = stepApp();
  const recording = { frames: 9, first: 0 };
  serve({
    model_mesh: () => packed({}, [['nodes', '<f4', [0, 0, 0]], ['triangles', '<i4', [0, 0, 0]]]),
    scan: async (asked) => {
      if (typeof asked === 'object') return { source: 'v.mp4', is_own: false, recording, last: null, map: null, place: null };
      await wait(20);
      return {};
    },
  });
  const opening = scanStart(app);
  await wait(10);
  app.view.replaceChildren();
  await opening;
  assert.deepEqual(app.refused, []);
});

// -- the image --------------------------------------------------------------------------------------

// -- the results ------------------------------------------------------------------------------------

async function results(frame) {
  const app = stepApp({ done: { track: true }, notes: {}, files: [] });
  const row = { frame: 0, status: 'tracked', parameters: {}, forces: {}, largest_displacement: null, largest_von_mises: null };
  serve({
    model_mesh: () => packed({}, [['nodes', '<f4', [0, 0, 0]], ['triangles', '<i4', [0, 0, 0]]]),
    model: () => ({ parameters: [], supports: [] }),
    'model.json': () => ({ colours: Array(256).fill([1, 2, 3]), fields: [{ key: 'displacement', top: 1 }] }),
    tracked_frames: () => ({ frames: [row], summary: { n_tracked: 1, n_frames: 1, median_ms: 1 } }),
    overlay: () => packed({ top: 1, unit: 'MPa' }, [['pixels', '<f4', [0, 0]], ['order', '<i4', []], ['values', '<f4', [0]],
      ['displacement', '<f4', [0, 0, 0]]]),
    frame,
  });
  return { app, step: await resultsStep(app), solid: SolidView.all.at(-1) };
}

test('the results show the surface of a frame', async () => {
  const { app, solid } = await results(() => ({}));
  await wait();
  assert.deepEqual(app.refused, []);
  assert.equal(solid.shown, 1);
});

test('results that are left while a frame comes show nothing, and say nothing in the next step', async () => {
  for (const answer of [{}, 'the recording has gone']) {
    const { app, step, solid } = await results(async () => { await wait(20); return answer; });
    step.close();
    await wait(40);
    assert.equal(solid.isGone, true);
    assert.equal(solid.shown, 0);
    assert.deepEqual(app.refused, []);
  }
});

test('the first button alone sets points, and a drag that the system ends is over', async () => {
  const clicked = [];
  const view = new ImageView(new Node('div'), (pixel) => clicked.push(pixel));
  view.setImage({ width: 600, height: 400 });
  const at = (x, button) => ({ clientX: x, clientY: 200, button, pointerId: 1 });
  for (const button of [2, 1, 0]) {
    await view.canvas.fire('pointerdown', at(300, button));
    await view.canvas.fire('pointerup', at(300, button));
  }
  assert.deepEqual(clicked, [[299.5, 199.5]]); // the centre, by the pixels' centres
  const { left } = view;
  await view.canvas.fire('pointerdown', at(300, 0));
  await view.canvas.fire('pointercancel');
  await view.canvas.fire('pointermove', at(500, 0));
  assert.equal(view.left, left);
});

test('the colours end with a short number', () => {
  const bar = colourBar(Array(256).fill([1, 2, 3]), { unit: 'MPa', top: 0.1 + 0.2 });
  assert.equal(bar.children.at(-1).textContent, '0.3 MPa');
});

// -- cameras ----------------------------------------------------------------------------------------

test('two clicks while the browser asks begin one recording', async () => {
  const taken = [];
  const { button, close } = recordButton(stepApp(), 'record', 'Record', 'w', async (files) => taken.push(files));
  button.click();
  button.click();
  await camera.allow();
  assert.equal(camera.given.length, 1);
  await button.click();
  await wait();
  close();
  assert.equal(taken.length, 1);
  assert.equal(camera.isOn, false);
});

test('a step that is left while the browser asks leaves the camera off', async () => {
  const { button, close } = recordButton(stepApp(), 'record', 'Record', 'w', async () => {});
  button.click();
  close();
  await camera.allow();
  assert.equal(camera.given.length, 1);
  assert.equal(camera.isOn, false);
});

async function live(told = () => {}) {
  const one = new LiveCamera({ told });
  const starting = one.start().catch(() => {});
  await WebSocket.last.tell('message', { data: JSON.stringify({ size: [640, 480] }) });
  return { one, starting };
}

test('a live camera that is stopped while the browser asks is off', async () => {
  const { one, starting } = await live();
  one.stop();
  await camera.allow();
  await starting;
  assert.equal(camera.given.length, 1);
  assert.equal(camera.isOn, false);
});

test('frames that are too large are said, and not sent again', async () => {
  const said = [];
  const { one, starting } = await live((facts) => said.push(facts.problem));
  await camera.allow();
  await starting;
  const socket = WebSocket.last;
  await socket.tell('close', { code: 1009, reason: 'frame exceeds 2000000 bytes' });
  assert.match(said.at(-1), /frame exceeds 2000000 bytes/);
  assert.equal(one.running, false);
  assert.equal(camera.isOn, false);
});

test('pictures that nobody takes are closed', async () => {
  let [made, closed] = [0, 0];
  const before = globalThis.createImageBitmap;
  globalThis.createImageBitmap = async () => { made += 1; return { close() { closed += 1; } }; };
  const one = new LiveCamera({ told() {} });
  for (let i = 0; i < 5; i++) await one.show(new ArrayBuffer(8));
  globalThis.createImageBitmap = before;
  assert.deepEqual([made, closed], [5, 5]);
});

test('a phone that is replaced as a camera says how its next recording went', async () => {
  const [said] = page('said', 'view', 'controls');
  serve({ upload: () => ({}) });
  await import('./phone.js');
  find('live').click();
  await WebSocket.last.tell('message', { data: JSON.stringify({ size: [640, 480], tracking: false }) });
  await camera.allow();
  await WebSocket.last.tell('close', { code: 4000, reason: 'another camera has taken the place' });
  assert.equal(said.textContent, 'another camera has taken the place');
  find('record').click();
  await camera.allow();
  await find('record').click();
  await wait();
  assert.match(said.textContent, /The video is in the project/);
  await wait(600); // longer than the page takes to tell of a camera
  assert.match(said.textContent, /The video is in the project/);
});

// -- the frame of the page --------------------------------------------------------------------------

const FRAME = ['folder', 'settings-note', 'steps', 'panel', 'view', 'job', 'message'];
const STATE = { folder: '/a', files: [], choices: {}, done: {}, job: null, phone: null, notes: {}, camera: null, recording: null };
const JOB = { kind: 'track', command: 'morph track', running: true, stopped: false, status: null, what: 'tracking', done: 1, total: 100,
  left_s: 3, lines: [], seconds: 1 };

test('a studio that cannot begin says why', async () => {
  page(...FRAME);
  serve({ state: () => 'studio.json cannot be read' });
  await import('./studio.js?refused');
  assert.match(find('panel').textContent, /studio\.json cannot be read/);
});

test('the button that stops a command is the same as long as it runs', async () => {
  page(...FRAME);
  let stops = 0;
  serve({ state: () => STATE, stop: () => { stops += 1; return {}; } });
  await import('./studio.js?begun');
  await events.job(JOB);
  const button = find('job-stop');
  await events.job({ ...JOB, done: 2 });
  assert.equal(find('job-stop'), button);
  assert.match(find('job-words').textContent, /2 of 100/);
  await button.click();
  assert.equal(stops, 1);
  await events.job({ ...JOB, running: false, status: 0 });
  assert.equal(button.hidden, true);
});

test('more frames than a call takes arguments come at once', async () => {
  page(...FRAME);
  serve({ state: () => STATE });
  await import('./studio.js?long');
  events.frames({ anew: true, frames: Array(200_000).fill({}) });
  await wait();
});

test('a step that fails while it is opened lets its connection go when it is left', async () => {
  page(...FRAME);
  const recording = { first: 0, frames: 3, width: 6, height: 4, fps: 30 };
  serve({ state: () => ({ ...STATE, recording }), frame: () => 'the frame cannot be read' });
  await import('./studio.js?failed');
  await find('step-camera').click();
  await wait();
  assert.equal(find('message').textContent, 'the frame cannot be read');
  const socket = WebSocket.last;
  assert.equal(socket.isClosed, undefined);
  await find('step-results').click();
  assert.equal(socket.isClosed, true);
});
