// The frame of the studio: steps, the command that runs, messages.

import * as server from './server.js';
import { el, time, title } from './parts.js';
import { objectStep } from './object_step.js';
import { studyStep } from './study_step.js';
import { buildStep } from './build_step.js';
import { cameraStep } from './camera_step.js';
import { startStep } from './start_step.js';
import { trackStep } from './track_step.js';
import { resultsStep } from './results_step.js';

const STEPS = [
  ['object', 'Object', objectStep], ['study', 'Study', studyStep], ['build', 'Build', buildStep],
  ['camera', 'Camera', cameraStep], ['start', 'Start', startStep], ['track', 'Track', trackStep],
  ['results', 'Results', resultsStep],
];

class Studio {
  constructor() {
    this.run = { frames: [] };
    this.open = {};
    this.makeBar();
    // Files that miss a place to be dropped on would take the place of the page.
    for (const name of ['dragover', 'drop']) document.body.addEventListener(name, (event) => event.preventDefault());
    // Steps call these through an object of their own.
    for (const name of ['refresh', 'show', 'doing', 'message']) this[name] = this[name].bind(this);
  }

  async start() {
    try {
      await this.refresh();
    } catch (error) {
      document.getElementById('panel').replaceChildren(...title('The studio cannot begin', 'Load this page again once this is mended.'),
        el('p', { className: 'problem' }, error.message));
      return;
    }
    server.listen({
      phone: (address) => { this.state.phone = address; this.open.phone?.(); },
      recording: () => this.doing(async () => { await this.refresh(); await this.open.recording?.(); }),
      job: (job) => this.takeJob(job), frames: (news) => this.takeFrames(news),
    });
    const wanted = location.hash.slice(1);
    const first = STEPS.find(([id]) => id === wanted) ?? STEPS.find(([id]) => !this.state.done[id]) ?? STEPS.at(-1);
    await this.show(first[0]);
  }

  async refresh() {
    this.state = await server.state();
    document.getElementById('folder').textContent = this.state.folder.split('/').at(-1);
    document.getElementById('folder').title = this.state.folder;
    const note = document.getElementById('settings-note');
    note.textContent = this.state.notes.settings ?? '';
    note.hidden = !note.textContent;
    this.drawSteps();
    this.drawJob();
  }

  drawSteps() {
    document.getElementById('steps').replaceChildren(...STEPS.map(([id, name], i) => {
      const done = this.state.done[id];
      const button = el('button', {
        id: `step-${id}`, className: done ? 'done' : '', onclick: () => this.show(id),
      }, el('b', {}, done && id !== this.current ? '✓' : String(i + 1)), name);
      if (id === this.current) button.setAttribute('aria-current', 'step');
      return button;
    }));
  }

  async show(id) {
    this.leave?.();
    this.current = id;
    history.replaceState(null, '', `#${id}`);
    this.drawSteps();
    // Each step fills parts of its own, so that one that is still being opened does not write into the next.
    const [panel, view] = [el('div'), el('div', { className: 'fill' })];
    document.getElementById('panel').replaceChildren(panel);
    document.getElementById('view').replaceChildren(view);
    document.getElementById('panel').scrollTop = 0;
    const opened = {};
    const left = [];
    const leave = () => { opened.close?.(); left.splice(0).forEach((action) => action()); };
    Object.assign(this, { open: opened, leave });
    await this.doing(async () => {
      await this.refresh();
      // A step that fails while it is opened has something to let go, too.
      const whenLeft = (action) => left.push(action);
      const step = Object.create(this, { panel: { value: panel }, view: { value: view }, whenLeft: { value: whenLeft } });
      Object.assign(opened, await STEPS.find(([key]) => key === id)[2](step));
    });
    if (this.open === opened) document.getElementById('panel').dataset.ready = id;
    else leave();
  }

  async doing(action) {
    try {
      this.message('');
      return await action();
    } catch (error) {
      this.message(error.message);
      return undefined;
    }
  }

  message(text) {
    const place = document.getElementById('message');
    place.textContent = text;
    place.hidden = !text;
    clearTimeout(this.hiding);
    if (text) this.hiding = setTimeout(() => { place.hidden = true; }, 15000);
  }

  async takeJob(job) {
    const ended = this.state.job?.running && job && !job.running;
    this.state.job = job;
    this.drawJob();
    if (ended) await this.doing(() => this.refresh());
    this.open.job?.(job, ended);
  }

  takeFrames(news) {
    if (news.anew) this.run.frames = [];
    for (const row of news.frames) this.run.frames.push(row);
    this.open.frames?.(this.run.frames);
  }

  // Made once: a button that another one takes the place of between press and release is not clicked.
  makeBar() {
    const done = el('i');
    this.bar = {
      words: el('strong', { id: 'job-words' }), command: el('code'), done, progress: el('div', { className: 'progress' }, done),
      stop: el('button', { id: 'job-stop', onclick: () => this.doing(() => server.call('stop')) }, 'Stop'),
    };
    const { words, command, progress, stop } = this.bar;
    document.getElementById('job').append(words, command, progress, stop);
  }

  drawJob() {
    const { job } = this.state;
    document.getElementById('job').hidden = !job;
    if (!job) return;
    const share = job.total ? Math.min(1, job.done / job.total) : 0;
    const words = job.running
      ? `${job.what}${job.total ? ` ${job.done} of ${job.total}` : ''}${job.left_s ? `, ${time(job.left_s)} left` : ''}`
      : job.status === 0 ? `done in ${time(job.seconds)}` : job.stopped ? 'stopped' : 'ended with an error';
    const kind = job.running ? '' : job.status === 0 ? 'good' : job.stopped ? 'warning' : 'problem';
    Object.assign(this.bar.words, { className: kind, textContent: words });
    Object.assign(this.bar.command, { title: job.command, textContent: job.command });
    this.bar.done.style.width = `${100 * share}%`;
    this.bar.progress.hidden = this.bar.stop.hidden = !job.running;
  }
}

await new Studio().start();
