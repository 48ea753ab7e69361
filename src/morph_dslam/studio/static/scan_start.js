// Start by a scan: the still scene is mapped, the object is found in its map, and the place is looked at and accepted.

import { call, scanFrame, upload } from './server.js';
import { check, command, digits, dropZone, el, facts, field, there } from './parts.js';
import { MeshView } from './mesh_view.js';
import { ImageView } from './overlay.js';
import { recordButton } from './recorder.js';

const VIDEOS = '.mp4,.mov,.avi,.mkv,.webm,.m4v';
const PLAIN = Array(256).fill([40, 170, 200]);
const COLOUR = '#0f6e8c';
const PENDING = '#f08c00';

export async function scanStart(app) {
  const mesh = await call('model_mesh');
  let scan = null;
  let image = null;
  let solid = null;
  let number = 0; // of the keyframe that is shown
  let shown = null; // number of another place that is shown, null for the one that was found
  let hints = null;
  let failure = null; // what the command said that ended with an error
  const panel = el('div');
  app.panel.append(panel);
  const distance = el('input', { id: 'scan-distance', type: 'number', min: 0, step: 'any', placeholder: 'unknown' });
  const record = recordButton(app, 'record-scan', 'Record the scan', 'scan', takeScan);

  async function takeScan([file]) {
    await upload('scan', file);
    await app.refresh();
    await load();
  }

  const noHints = () => ({ pairs: [], pending: { point: null, pixel: null }, corners: [], boxing: false });

  async function load() {
    scan = await call('scan');
    shown = null;
    hints = noHints();
    const known = scan.map?.keyframes;
    if (known) number = known.includes(number) ? number : known[Math.floor(known.length / 2)];
    else number = scan.recording.first;
    drawPanel();
    drawView();
    await app.doing(showFrame);
  }

  // -- the panel ---------------------------------------------------------------------------------

  function drawPanel() {
    panel.replaceChildren(...[scan.problem, failure].filter(Boolean).map((one) => el('p', { className: 'problem' }, one)), ...scanPart(), ...(scan.map ? placePart() : []), ...(scan.place ? judgePart() : []));
  }

  function scanPart() {
    const last = el('input', { id: 'scan-last', type: 'number', min: scan.recording.first + 1, step: 1,
      value: scan.last ?? '', placeholder: 'all frames' });
    const start = el('button', { id: 'map-scan', className: scan.map ? '' : 'main', onclick: () => app.doing(() => call('map_scan',
      { last: last.value ? Number(last.value) : null })) }, scan.map ? 'Map anew' : 'Map the scan');
    return there([
      el('p', { className: 'note' }, scan.is_own ? `The scan is ${scan.source}, ${scan.recording.frames} frames.`
        : 'The scan is the first part of the recording, in which nothing moves or deforms but the camera.'),
      dropZone('drop-scan', 'Drop another video of the still scene', 'of the same camera, from around the object', VIDEOS,
        (files) => app.doing(() => takeScan(files))),
      el('div', { className: 'row' }, record.button, scan.is_own ? el('button', { id: 'scan-recording',
        onclick: () => app.doing(async () => { await call('scan_the_recording'); await load(); }) }, 'Use the recording') : null),
      field('Last frame of the scan', last),
      start, command('morph slam … -o map'),
      scan.map ? facts([['Mapped', `${scan.map.n_tracked} frames, ${scan.map.n_map_points} points`]]) : null,
      ...(scan.map?.flags ?? []).map((flag) => el('p', { className: 'warning note' }, flag)),
    ]);
  }

  function placePart() {
    const { keyframes } = scan.map;
    const box = hints.corners.length === 2;
    const keyframe = el('input', { id: 'keyframe', type: 'range', min: 0, max: keyframes.length - 1,
      value: keyframes.indexOf(number) });
    const text = el('output', { className: 'fixed' }, String(number));
    keyframe.addEventListener('input', () => { text.textContent = keyframes[keyframe.value]; });
    keyframe.addEventListener('change', () => app.doing(async () => {
      try {
        await showFrame(keyframes[keyframe.value]);
      } finally {
        drawPanel();
      }
    }));
    return there([
      el('h3', {}, 'Find the object'),
      el('div', { className: 'row' }, el('span', { className: 'fixed' }, 'Keyframe'), keyframe, text),
      el('details', { id: 'hints', open: hints.pairs.length > 0 || hints.boxing || box || !scan.place }, el('summary', {}, 'Hints, where it is not found or in doubt'),
        el('p', { className: 'note' }, 'Click a point on the mesh and the same point in the keyframe, three pairs or more; or draw a box.'),
        el('div', { className: 'row' },
          el('span', { id: 'scan-pairs' }, `${hints.pairs.length} pairs`),
          el('button', { onclick: () => { hints.pairs = []; redraw(); } }, 'Clear'),
          el('button', { id: 'scan-box', onclick: () => { hints.boxing = true; hints.corners = []; redraw(); } },
            hints.boxing ? 'Click two corners…' : box ? 'Box set' : 'Box around it')),
        field('Rough distance from the camera, m', distance)),
      el('button', { id: 'find-place', className: scan.place ? '' : 'main', onclick: () => app.doing(() => call('find_place', {
        pairs: hints.pairs.length ? hints.pairs : null, frame: number, distance: distance.value ? Number(distance.value) : null,
        region: box ? boxOf(hints.corners) : null })) }, scan.place ? 'Find anew' : 'Find the object'),
      command('morph register map/map.h5 … -o place'),
    ]);
  }

  function judgePart() {
    const { place } = scan;
    const sure = el('input', { id: 'sure' });
    const accept = el('button', { id: 'accept-place', className: 'main', disabled: Boolean(place.accepted), onclick: () => app.doing(async () => {
      await call('accept_place', { despite_ambiguity: sure.checked });
      await app.refresh();
      await load();
    }) }, place.accepted ? 'Accepted' : 'Accept this place');
    const look = (which) => app.doing(async () => { shown = which; await showFrame(); drawPanel(); });
    const others = place.rivals.map((share, i) => el('li', {},
      el('span', {}, share === null ? `Place ${i + 2}` : `Place ${i + 2}: ${digits(100 * share, 2)} %`),
      el('button', { id: `rival-${i}`, disabled: i === shown, onclick: () => look(i) }, 'Show'),
      el('button', { id: `take-rival-${i}`, onclick: () => app.doing(() => call('find_place', { frame: number, rival: i })) }, 'Find it there')));
    const rivals = others.length ? [el('p', { className: 'note' }, 'Other places, with their score over that of the first:'),
      el('ul', { className: 'list', id: 'rivals' }, ...others)] : [];
    // The evidence is of the first place, and so is what is accepted: it must be the one that is seen.
    if (shown !== null) {
      return [el('h3', {}, `Place ${shown + 2}`), el('p', { className: 'note' }, 'Find the object there to see what speaks for it.'), ...rivals,
        el('button', { id: 'first-place', onclick: () => look(null) }, 'Show the first place')];
    }
    return there([
      el('h3', {}, 'The place'),
      el('p', { id: 'judgement', className: place.ambiguous ? 'warning' : 'good' }, place.ambiguous ? 'Ambiguous: look at it in every keyframe.'
        : 'Clear. Look at it in every keyframe all the same.'),
      ...place.warnings.map((one) => el('p', { className: 'warning note' }, one)),
      ...place.evidence.map((one) => el('p', { className: 'note' }, one)),
      ...rivals,
      place.ambiguous && !place.accepted ? check('I looked: the drawing is where the object is', sure) : null,
      accept,
      el('p', { className: 'note' }, 'studio.json keeps that the place was accepted, and whether it was ambiguous.'),
      place.accepted ? el('button', { id: 'to-track', onclick: () => app.show('track') }, 'Next: track') : null,
    ]);
  }

  // -- the view ----------------------------------------------------------------------------------

  function drawView() {
    const imagePlace = el('div', { className: 'fill', id: 'scan-image' });
    const left = el('div', {}, el('span', { className: 'tag' }, scan.map ? 'keyframe' : 'scan'), imagePlace);
    const meshPlace = el('div', { className: 'fill', id: 'scan-mesh' });
    const right = el('div', {}, el('span', { className: 'tag' }, 'undeformed model'), meshPlace);
    app.view.replaceChildren(el('div', { className: 'split' }, left, right));
    image = new ImageView(imagePlace, pixelClicked);
    image.opacity = 0.5;
    const every = Int32Array.from({ length: mesh.triangles.length / 3 }, (_, i) => i);
    solid?.dispose();
    solid = new MeshView(meshPlace, mesh.nodes, mesh.triangles, every, ({ point }) => {
      if (!scan.map) return;
      hints.pending.point = point;
      paired();
    });
    Object.assign(imagePlace, { view: image });
    Object.assign(meshPlace, { view: solid });
  }

  // Hints are of the keyframe that is shown; one that does not come leaves both.
  async function showFrame(wanted = number) {
    const [picture, overlay] = await Promise.all([scanFrame(wanted),
      scan.place ? call('place_overlay', { frame: wanted, rival: shown }) : null]);
    if (wanted !== number) hints = noHints();
    number = wanted;
    image.setOverlay(overlay, mesh.triangles, PLAIN);
    image.setImage(picture);
    image.container.dataset.frame = number;
    drawMarks();
  }

  function pixelClicked(pixel) {
    if (!scan.map) return;
    if (hints.boxing) {
      hints.corners.push(pixel);
      hints.boxing = hints.corners.length < 2;
      redraw();
      return;
    }
    hints.pending.pixel = pixel;
    paired();
  }

  function paired() {
    const { point, pixel } = hints.pending;
    if (point && pixel) {
      hints.pairs.push([...point.map((x) => Math.round(1e6 * x) / 1e3), ...pixel]);
      hints.pending = { point: null, pixel: null };
    }
    redraw();
  }

  function redraw() {
    drawPanel();
    drawMarks();
  }

  function drawMarks() {
    const { pairs, pending, corners } = hints;
    image.marks = [...pairs.map(([, , , u, v], i) => ({ pixel: [u, v], colour: COLOUR, label: String(i + 1) })),
      ...(pending.pixel ? [{ pixel: pending.pixel, colour: PENDING }] : []),
      ...corners.map((pixel) => ({ pixel, colour: PENDING }))];
    image.draw();
    solid.mark([
      ...pairs.map(([x, y, z]) => ({ point: [x / 1000, y / 1000, z / 1000], colour: COLOUR })),
      ...(pending.point ? [{ point: pending.point, colour: PENDING }] : [])]);
  }

  await load();
  return {
    close: () => { record.close(); solid.dispose(); },
    job: (job, ended) => {
      if (!ended || !['slam', 'register'].includes(job.kind)) return;
      failure = job.status === 0 || job.stopped ? null : job.lines.at(-1);
      app.doing(load);
    },
  };
}

function boxOf([[a, b], [c, d]]) {
  return [Math.min(a, c), Math.min(b, d), Math.max(a, c), Math.max(b, d)];
}
