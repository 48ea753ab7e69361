// Build: solve and compress; then the explorer and the report.

import { call } from './server.js';
import { command, el, facts, field, there, time, title } from './parts.js';

export async function buildStep(app) {
  const study = await call('study');
  const good = !study.problems.length;
  const training = el('input', { id: 'training', type: 'number', min: 8, placeholder: '256',
    value: study.content?.sampling?.training ?? '' });
  const heldOut = el('input', { id: 'held-out', type: 'number', min: 4, placeholder: '59',
    value: study.content?.sampling?.held_out ?? '' });
  const start = el('button', { id: 'build', className: 'main', disabled: !good, onclick: () => app.doing(async () => {
    const sampling = { ...(study.content.sampling ?? {}) };
    for (const [key, input] of [['training', training], ['held_out', heldOut]]) {
      if (input.value) sampling[key] = Number(input.value); else delete sampling[key];
    }
    await call('change_study', { section: 'sampling', value: Object.keys(sampling).length ? sampling : null });
    await call('build');
  }) });
  const progress = el('div');
  const made = el('div');
  app.panel.append(...there([
    ...title('Build', 'The study is solved over all of its parameters, and the solutions are compressed into one model.'),
    good ? null : el('p', { className: 'problem' }, `The study is not finished: ${study.problems[0]}`),
    el('div', { className: 'row' }, field('Solutions', training), field('to measure the error', heldOut)),
    el('p', { className: 'note' }, 'Few solutions are quick and coarse; empty fields take the defaults.'),
    start, command('morph build study.toml -o model.morph'), progress, made,
  ]));

  function drawJob(job) {
    const mine = job?.kind === 'build' ? job : null;
    start.textContent = mine && !mine.running && mine.stopped ? 'Go on' : app.state.done.build ? 'Build again' : 'Build';
    start.disabled = !good || Boolean(job?.running);
    if (!mine) return;
    const share = mine.total ? 100 * mine.done / mine.total : 0;
    progress.replaceChildren(facts([['Now', mine.running ? mine.what : mine.status === 0 ? 'finished' : mine.stopped ? 'stopped' : 'ended with an error'],
      ['Done', mine.total ? `${mine.done} of ${mine.total}` : ''], ['Time', time(mine.seconds)],
      ['Left', mine.running ? time(mine.left_s) : '']]),
    mine.running ? el('div', { className: 'progress' }, el('i', { style: `width: ${share}%` })) : el('span'));
    if (mine.running || mine.status !== 0) {
      const log = el('pre', { className: 'log mono', id: 'log' }, mine.lines.join('\n'));
      app.view.replaceChildren(log);
      log.scrollTop = log.scrollHeight;
    }
  }

  async function drawModel() {
    if (!app.state.done.build) {
      if (!app.view.firstChild) app.view.append(el('div', { className: 'empty' }, 'The model appears here when it is built.'));
      return;
    }
    const model = await call('model');
    made.replaceChildren(el('h3', {}, 'model.morph'), facts([['Nodes', String(model.nodes)],
      ...model.parameters.map((p) => [p.name, `${+(p.lower * p.factor).toPrecision(4)} to ${+(p.upper * p.factor).toPrecision(4)} ${p.unit}`])]),
    el('button', { id: 'to-camera', onclick: () => app.show('camera') }, 'Next: camera'));
    const page = el('iframe', { id: 'model-page', title: 'model' });
    const tabs = [['Explorer', '/explore/'], ['Report', '/report']].map(([name, address]) => el('button', {
      className: 'plain', onclick: (event) => {
        page.src = address;
        tabs.forEach((tab) => tab.setAttribute('aria-pressed', tab === event.target));
      },
    }, name));
    app.view.replaceChildren(el('div', { className: 'buildview' }, el('div', { className: 'tabs' }, ...tabs), page));
    tabs[0].click();
  }

  drawJob(app.state.job);
  if (!app.state.job?.running || app.state.job.kind !== 'build') await drawModel();
  return {
    job: (job, ended) => {
      drawJob(job);
      if (ended && job.kind === 'build' && job.status === 0) app.doing(drawModel);
    },
  };
}
