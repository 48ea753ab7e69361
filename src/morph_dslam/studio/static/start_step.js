// Start: pairs of a point on the mesh and a pixel place the object in one frame.

import { call, explored, frame } from './server.js';
import { check, choice, command, digits, dropZone, el, facts, field, title } from './parts.js';
import { MeshView } from './mesh_view.js';
import { ImageView, colourBar } from './overlay.js';
import { upload } from './server.js';
import { scanStart } from './scan_start.js';

const SOON = 500; // milliseconds without a click
const GOOD = '#0f6e8c';
const WORST = '#b3261e';
const PENDING = '#f08c00';
const PLAIN = Array(256).fill([40, 170, 200]); // of an undeformed object, which has no stress

export async function startStep(app) {
  app.panel.append(...title('Start', 'Where the object is: by four clicked pairs or more, or by a scan of the still scene.'));
  const { recording, camera, done, choices } = app.state;
  const recording_number = choices.recording_number ?? 0;
  if (!done.build || !recording || recording.message || !camera || camera.message) {
    app.panel.append(el('p', { className: 'problem' }, 'This step needs the model, the recording and the camera.'));
    return {};
  }
  const way = choice('start-by', [['pairs', 'pairs in a frame'], ['scan', 'a scan of the still scene']],
    app.state.choices.start ?? 'pairs');
  way.addEventListener('change', () => app.doing(async () => { await call('start_by', { way: way.value }); await app.show('start'); }));
  app.panel.append(field('Start by', way));
  if (way.value === 'scan') return scanStart(app);
  const aside = el('p', { className: 'warning note', id: 'pairs-note', hidden: !app.state.notes.start }, app.state.notes.start ?? '');
  app.panel.append(aside);
  const [mesh, known, model, { colours }, { numbers }] = await Promise.all([
    call('model_mesh'), call('start_files'), call('model'), explored('model.json'), call('frame_numbers')]);
  const { first, last } = recording;
  // Of images some numbers may be missing.
  const nearest = (wanted) => (numbers ?? []).reduce((a, b) => (Math.abs(b - wanted) < Math.abs(a - wanted) ? b : a), numbers?.[0] ?? wanted);
  let pairs = known.pairs;
  let pending = { point: null, pixel: null };
  let fitted = null;
  let saved = pairs.length > 0;
  let number = known.frame ?? first; // of the frame that is shown
  let clickedIn = number; // of the frame that the pairs belong to
  const isElsewhere = () => pairs.length > 0 && clickedIn !== number;

  const left = el('div', {}, el('span', { className: 'tag' }, 'image'));
  const right = el('div', {}, el('span', { className: 'tag' }, 'undeformed model'));
  const imagePlace = el('div', { className: 'fill', id: 'start-image' });
  const meshPlace = el('div', { className: 'fill', id: 'start-mesh' });
  left.append(imagePlace);
  right.append(meshPlace, el('p', { className: 'hint' }, 'Drag turns or shifts, wheel zooms, click sets a point.'));
  app.view.append(el('div', { className: 'split' }, left, right));
  const image = new ImageView(imagePlace, (pixel) => { if (!isElsewhere()) { pending.pixel = pixel; paired(); } });
  const faces = Int32Array.from({ length: mesh.triangles.length / 3 }, (_, i) => i);
  const solid = new MeshView(meshPlace, mesh.nodes, mesh.triangles, faces, ({ point }) => { pending.point = point; paired(); });
  imagePlace.view = image;
  meshPlace.view = solid;

  const atRest = el('input', { id: 'at-rest', checked: known.at_rest, onchange: () => fit() });
  const frameInput = el('input', { id: 'frame', type: 'range', min: first, max: last, value: number });
  const frameText = el('output', { className: 'fixed' }, String(number));
  const opacity = el('input', { id: 'opacity', type: 'range', min: 0, max: 1, step: 0.05, value: image.opacity,
    oninput: () => { image.opacity = opacity.valueAsNumber; image.draw(); } });
  const list = el('ul', { className: 'list', id: 'pairs' });
  const result = el('div', { id: 'fit' });
  const save = el('button', { id: 'save-start', className: 'main', onclick: () => app.doing(async () => {
    await call('save_start', { pairs, frame: clickedIn, at_rest: atRest.checked, recording_number });
    saved = true;
    aside.hidden = true;
    await app.refresh();
    draw();
  }) }, 'Save');
  frameInput.addEventListener('input', () => { frameText.textContent = nearest(Number(frameInput.value)); });
  let wanted = number;
  frameInput.addEventListener('change', () => app.doing(async () => {
    const asked = wanted = nearest(Number(frameInput.value));
    try {
      const picture = await frame(asked);
      if (asked !== wanted) return; // another one was asked for meanwhile
      number = asked;
      pending.pixel = null;
      image.setImage(picture);
    } finally {
      if (asked === wanted) frameInput.value = frameText.textContent = wanted = number;
      draw();
    }
  }));
  app.panel.append(
    el('div', { className: 'row' }, el('span', { className: 'fixed' }, 'Frame'), frameInput, frameText),
    check('The object is undeformed in this frame', atRest),
    el('p', { className: 'note' }, 'Tick this only if no load deforms it there. Otherwise the pairs give its parameters too.'),
    list, result,
    el('div', { className: 'row' }, el('span', { className: 'fixed' }, 'Overlay'), opacity),
    el('div', { className: 'row' }, save, el('button', { id: 'clear', onclick: () => { pairs = []; fit(); } }, 'Clear')),
    command('writes landmarks.csv'),
    el('details', {}, el('summary', {}, 'Use a file of landmarks'),
      dropZone('drop-landmarks', 'Drop landmarks.csv', 'x_mm, y_mm, z_mm, u_px, v_px', '.csv', ([file]) => app.doing(async () => {
        await upload('landmarks', file);
        pairs = (await call('start_files')).pairs;
        clickedIn = number;
        await call('save_start', { pairs, frame: number, at_rest: atRest.checked, recording_number });
        aside.hidden = true;
        await app.refresh();
        await fit();
      }))),
    el('button', { id: 'to-track', onclick: () => app.show('track') }, 'Next: track'),
  );

  function paired() {
    if (pending.point && pending.pixel) {
      if (!pairs.length) clickedIn = number;
      pairs = [...pairs, [...pending.point.map((x) => Math.round(1e6 * x) / 1e3), ...pending.pixel]];
      pending = { point: null, pixel: null };
      fit();
    } else draw();
  }

  // Clicks that come while one is fitted are fitted together when it is done. Each is fitted at once from the fit before;
  // when no more come, once more from everywhere, which shows what else the pairs may mean.
  let fitting = false;
  let again = false;
  let thorough = null;
  async function fit(quick = true) {
    if (quick) saved = false;
    clearTimeout(thorough);
    draw();
    again = true;
    if (fitting) return;
    fitting = true;
    while (again) {
      again = false;
      const began = performance.now();
      try {
        fitted = { ...await call('fit', { pairs, at_rest: atRest.checked, quick }), ms: fitted?.ms };
        if (quick) fitted.ms = performance.now() - began;
      } catch (error) {
        fitted = { message: error.message, refused: true };
      }
    }
    fitting = false;
    if (quick) thorough = setTimeout(() => fit(false), SOON);
    draw();
  }

  function draw() {
    const worst = fitted?.residuals_px ? fitted.worst : -1;
    const errors = fitted?.residuals_px ?? [];
    const colour = (i) => (i === worst && errors.length > 4 ? WORST : GOOD);
    const elsewhere = isElsewhere();
    image.marks = elsewhere ? [] : pairs.map(([, , , u, v], i) => ({ pixel: [u, v], colour: colour(i), label: String(i + 1) }));
    if (pending.pixel) image.marks.push({ pixel: pending.pixel, colour: PENDING });
    image.setOverlay(elsewhere ? null : fitted, mesh.triangles, atRest.checked ? PLAIN : colours);
    const points = pairs.map(([x, y, z], i) => ({ point: [x / 1000, y / 1000, z / 1000], colour: colour(i) }));
    if (pending.point) points.push({ point: pending.point, colour: PENDING });
    solid.mark(points);
    list.replaceChildren(...pairs.map((pair, i) => el('li', {},
      el('span', {}, `${i + 1}  `, el('small', {}, `${pair.slice(0, 3).map((x) => digits(x)).join(', ')} mm`)),
      el('small', { className: i === worst && errors.length > 4 ? 'problem' : '' }, errors[i] === undefined ? '' : `${errors[i].toFixed(2)} px`),
      el('button', { className: 'plain', title: 'take out', onclick: () => { pairs.splice(i, 1); fit(); } }, '✕'))));
    const waiting = pending.point ? 'Now click the same point in the image.' : pending.pixel ? 'Now click the same point on the mesh.' : '';
    if (elsewhere) {
      result.replaceChildren(el('p', { className: 'warning', id: 'elsewhere' },
        `The pairs belong to frame ${clickedIn}: go back to it, or clear them to click pairs in this one.`));
    } else if (waiting) result.replaceChildren(el('p', { className: 'warning' }, waiting));
    else if (!fitted) result.replaceChildren();
    else if (fitted.message) result.replaceChildren(el('p', { className: fitted.refused ? 'problem' : 'note' }, fitted.message));
    else {
      const values = model.parameters.map((p) => [p.name, `${digits(fitted.parameters[p.name] * p.factor)} ${p.unit}`]);
      result.replaceChildren(facts([['Error, rms', `${fitted.rms_px.toFixed(2)} px`],
        ['Worst pair', `${fitted.worst + 1}, ${errors[fitted.worst].toFixed(2)} px`],
        ...(atRest.checked ? [] : values), ...(fitted.ms ? [['Fitted in', `${Math.round(fitted.ms)} ms`]] : [])]),
      ...fitted.warnings.map((one) => el('p', { className: 'warning note' }, one)));
    }
    left.querySelector('.bar')?.remove();
    if (fitted?.pixels && !elsewhere && !atRest.checked) left.append(colourBar(colours, fitted));
    save.disabled = !fitted?.pixels || saved || elsewhere;
    save.textContent = saved && pairs.length ? 'Saved' : 'Save';
    result.dataset.pairs = fitting ? '' : String(pairs.length);
  }

  image.setImage(await frame(number));
  if (pairs.length) { const was = saved; await fit(); saved = was; }
  draw();
  return { close: () => { clearTimeout(thorough); solid.dispose(); }, recording: () => app.show('start') };
}
