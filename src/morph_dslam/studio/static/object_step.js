// Object: a mesh file, its unit, and named sets of its faces.

import { call, upload } from './server.js';
import { choice, command, digits, dropZone, el, facts, field, there, title } from './parts.js';
import { MeshView, colourOf } from './mesh_view.js';

const KINDS = '.stl,.obj,.ply,.step,.stp,.inp,.msh,.vtk,.vtu';
const SURFACES = /\.(stl|obj|ply|step|stp)$/i;

export async function objectStep(app) {
  const chosen = { ...app.state.choices };
  let surface = null;
  let view = null;
  let picked = new Set();
  const place = el('div');
  const unit = choice('unit', [['mm', 'millimetres'], ['cm', 'centimetres'], ['m', 'metres'], ['um', 'micrometres']],
    chosen.unit ?? 'mm');
  const size = el('input', { id: 'cell-size', type: 'number', min: 0, step: 'any', placeholder: 'as in the file',
    value: chosen.size_mm ?? '' });
  app.panel.append(
    ...title('Object', 'Drop the mesh or the CAD surface of the undeformed object.'),
    dropZone('drop-object', 'Drop a mesh file, or click', 'STL, OBJ, PLY, STEP, INP, MSH, VTK, VTU', KINDS,
      ([file]) => app.doing(async () => {
        const name = await upload('object', file);
        if (name !== chosen.object) size.value = '';
        chosen.object = name;
        await load();
      })),
    place,
  );
  app.view.append(el('div', { className: 'empty' }, 'The object appears here.'));

  async function load() {
    const sizeMm = size.value ? Number(size.value) : null;
    surface = await call('load_object', { file: chosen.object, unit: unit.value, size_mm: sizeMm });
    await app.refresh();
    chosen.sets = app.state.choices.sets ?? {};
    picked = new Set();
    const container = el('div', { className: 'fill', id: 'object-view' });
    app.view.replaceChildren(container, el('p', { className: 'hint' },
      'Click a face to pick what belongs to it. Shift adds, drag turns, wheel zooms, right button shifts.'));
    view?.dispose();
    view = new MeshView(container, surface.nodes, surface.triangles, surface.faces, pick);
    container.view = view;
    draw();
  }

  function pick({ face }, event) {
    app.doing(async () => {
      const grown = await call('grow', { face, angle: Number(angle.value) });
      if (!event.shiftKey) picked = new Set(grown);
      else if (picked.has(face)) grown.forEach((one) => picked.delete(one));
      else grown.forEach((one) => picked.add(one));
      drawFaces();
    });
  }

  const angle = el('input', { id: 'grow-angle', type: 'range', min: 0, max: 90, value: 20,
    oninput: () => { angleText.textContent = `${angle.value}°`; } });
  const angleText = el('output', { className: 'fixed' }, '20°');
  const name = el('input', { id: 'set-name', placeholder: 'name, foot say', maxLength: 40,
    oninput: () => drawFaces(), onkeydown: (event) => { if (event.key === 'Enter') nameSet(); } });
  const save = el('button', { id: 'name-set', className: 'main', onclick: () => nameSet() }, 'Name');
  const count = el('p', { className: 'note', id: 'picked' });

  function nameSet() {
    app.doing(async () => {
      chosen.sets = (await call('name_set', { name: name.value, faces: [...picked] })).sets;
      name.value = '';
      picked = new Set();
      draw();
      await app.refresh();
    });
  }

  function drawFaces() {
    const colours = new Map();
    Object.values(chosen.sets ?? {}).forEach((faces, i) => faces.forEach((face) => colours.set(face, 2 + i % 8)));
    picked.forEach((face) => colours.set(face, 1));
    view.colour(colours);
    count.textContent = picked.size ? `${picked.size} faces picked` : 'no faces picked';
    save.disabled = !picked.size || !name.value;
  }

  function draw() {
    const rows = Object.entries(chosen.sets ?? {}).map(([set, faces], i) => el('li', {},
      el('i', { className: 'swatch', style: `background: rgb(${colourOf(i).slice(0, 3).join(' ')})` }),
      el('span', {}, set, ' ', el('small', {}, `${faces.length} faces`)),
      el('button', { className: 'plain', title: 'show', onclick: () => { picked = new Set(faces); drawFaces(); } }, 'pick'),
      el('button', { className: 'plain', title: 'take out', onclick: () => app.doing(async () => {
        chosen.sets = (await call('forget_set', { name: set })).sets;
        draw();
      }) }, '✕')));
    const own = Object.keys(surface.sets).filter((set) => !(set in (chosen.sets ?? {})));
    place.replaceChildren(...there([
      facts([['File', chosen.object], ['Size', `${surface.extent_mm.map((x) => digits(x)).join(' × ')} mm`],
        ['Cells', `${surface.n_cells} ${surface.cells.join(', ')}`], ['Nodes', String(surface.n_nodes)]]),
      ...surface.notes.map((note) => el('p', { className: 'warning note' }, note)),
      el('div', { className: 'row' }, field('Unit of the file', unit),
        SURFACES.test(chosen.object) ? field('Cell size, mm', size) : null),
      el('h3', {}, 'Sets of faces'),
      el('ul', { className: 'list', id: 'sets' }, ...rows),
      own.length ? el('p', { className: 'note' }, `From the file: ${own.slice(0, 12).join(', ')}${own.length > 12 ? ' …' : ''}`)
        : null,
      el('p', { className: 'note' }, 'Everything that is held or loaded needs a name.'),
      field('Angle up to which neighbours belong together', el('div', { className: 'row' }, angle, angleText)),
      el('div', { className: 'row' }, name, save), count,
      command('writes mesh.inp'),
      el('button', { id: 'to-study', onclick: () => app.show('study') }, 'Next: study'),
    ]));
    drawFaces();
  }

  unit.addEventListener('change', () => app.doing(load));
  size.addEventListener('change', () => app.doing(load));
  if (chosen.object) await load();
  return { close: () => view?.dispose() };
}
