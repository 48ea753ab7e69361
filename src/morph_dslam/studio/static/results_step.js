// Results: any frame in the image and in space, plots, and files for other programs.

import { call, explored } from './server.js';
import { command, digits, el, facts, there, title } from './parts.js';
import { SolidView } from './solid_view.js';
import { RunPicture } from './track_step.js';
import { makePlots } from './plot.js';

const download = (name, text) => el('a', { href: `/files/${name}`, download: '', className: 'button' }, text);
const downloads = () => el('div', { className: 'row' }, download('run/frames.csv', 'CSV'), download('run/augmented.mp4', 'MP4'),
  download('run/result.h5', 'HDF5'));

export async function resultsStep(app) {
  app.panel.append(...title('Results', 'Every frame in the image and in space, and files for other programs.'));
  if (!app.state.done.track) {
    const problem = app.state.notes.run;
    app.panel.append(el('p', { className: 'problem', id: 'run-note' }, problem ?? 'Track the video first.'));
    if (problem) {
      app.panel.append(el('p', { className: 'note' }, 'The files of that run are kept until then:'), downloads());
    }
    return {};
  }
  const [mesh, model, surface, run] = await Promise.all([
    call('model_mesh'), call('model'), explored('model.json'), call('tracked_frames')]);
  const { frames, summary } = run;
  if (!frames.length) {
    app.panel.append(el('p', { className: 'problem' }, 'The run holds no frames: track the video here once more.'));
    return {};
  }
  const slider = el('input', { id: 'scrub', type: 'range', min: 0, max: frames.length - 1, value: 0 });
  const values = el('div', { id: 'frame-facts' });
  const exported = el('p', { className: 'note' });
  const write = (format, text) => el('button', { id: `export-${format}`, onclick: () => app.doing(async () => {
    await call('export', { format });
    exported.replaceChildren();
  }) }, text);
  const pictureplace = el('div', { className: 'fill', id: 'result-image' });
  const solidPlace = el('div', { className: 'fill', id: 'result-solid' });
  const plots = el('div', { className: 'plots' });
  app.view.append(el('div', { className: 'runview' },
    el('div', { className: 'split' }, el('div', {}, pictureplace), el('div', {}, solidPlace)), plots));
  const picture = new RunPicture(pictureplace, mesh, surface.colours);
  const reach = surface.fields.find((field) => field.key === 'displacement').top / 1000;
  const solid = new SolidView(solidPlace, mesh.nodes, new Uint32Array(mesh.triangles), surface.colours, reach);
  solid.renderer.setClearColor(0xe9edf2);
  const plot = makePlots(plots, model);

  function show() {
    const row = frames[Number(slider.value)];
    plot(frames, row.frame);
    const scaled = model.parameters.map((p) => [p.name, `${digits(row.parameters[p.name] === null ? null : row.parameters[p.name] * p.factor)} ${p.unit}`]);
    const parts = [['Frame', String(row.frame)], ['Status', row.status], ...scaled];
    if (row.largest_displacement !== null) parts.push(['Largest displacement', `${digits(1e3 * row.largest_displacement)} mm`]);
    if (row.largest_von_mises !== null) parts.push(['Largest stress', `${digits(row.largest_von_mises / model.stress.factor)} ${model.stress.unit}`]);
    for (const [name, force] of Object.entries(row.forces)) {
      if (force) parts.push([`Force on ${name}`, `${digits(Math.hypot(...force))} N`]);
    }
    values.replaceChildren(facts(parts));
    app.doing(() => picture.show(row, (_, overlay) => {
      if (overlay) solid.show(overlay.displacement, overlay.values, overlay.top, 1);
    }));
  }

  slider.addEventListener('input', show);
  const has = (name) => app.state.files.includes(name);
  app.panel.append(...there([
    slider, values,
    ...(summary?.flags ?? []).map((flag) => el('p', { className: 'warning note' }, flag)),
    facts([['Tracked', `${summary.n_tracked} of ${summary.n_frames} frames`],
      ['Time a frame', `${summary.median_ms.toFixed(0)} ms`]]),
    el('h3', {}, 'Files'),
    el('p', { className: 'note' }, 'Download'),
    downloads(),
    el('p', { className: 'note' }, 'Write the tracked states into the project folder'),
    el('div', { className: 'row' }, write('vtu', 'VTU'), write('xdmf', 'XDMF'), write('gltf', 'glTF')),
    exported, command('morph export model.morph --path run/frames.csv …'),
    has('model.report.html') ? el('p', {}, el('a', { href: '/report', target: '_blank' }, 'Report of the model')) : null,
  ]));
  show();
  return {
    close: () => { picture.close(); solid.dispose(); },
    job: (job, ended) => {
      if (!ended || job.kind !== 'export' || job.status !== 0) return;
      const format = job.command.match(/--format (\w+)/)[1];
      exported.replaceChildren(`written to export-${format} in the project folder `,
        format === 'gltf' ? download('export-gltf/model.glb', 'Download') : '');
    },
  };
}
