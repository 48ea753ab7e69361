// Track: the command runs; its frames are plotted and drawn as they come.

import { call, explored, frame } from './server.js';
import { check, command, el, facts, title } from './parts.js';
import { ImageView, colourBar } from './overlay.js';
import { liveView } from './live_view.js';
import { makePlots } from './plot.js';

const MOST_PLOTTED = 600; // frames of a live run

// The picture of a frame with the model over it; of: the run in its folder, or the log of what is being tracked.
export class RunPicture {
  constructor(container, mesh, colours, of = 'run') {
    Object.assign(this, { container, mesh, colours, of, view: new ImageView(container), busy: false, wanted: null, isClosed: false });
  }

  // What comes later is not shown: the step is left.
  close() {
    this.isClosed = true;
    this.wanted = null;
  }

  // Shows the frame that was asked for last; ones in between are left out.
  async show(row, shown = () => {}) {
    this.wanted = row;
    if (this.busy) return;
    this.busy = true;
    try {
      while (this.wanted) {
        const next = this.wanted;
        this.wanted = null;
        const tracked = next.status === 'tracked';
        const [image, overlay] = await Promise.all([frame(next.frame), tracked ? call('overlay', { frame: next.frame, of: this.of }) : null]);
        if (this.isClosed) {
          image.close?.();
          return;
        }
        this.view.setOverlay(overlay, this.mesh.triangles, this.colours);
        this.view.setImage(image);
        this.container.parentElement.querySelector('.bar')?.remove();
        if (overlay) this.container.after(colourBar(this.colours, overlay));
        this.container.dataset.frame = next.frame;
        shown(next, overlay);
      }
    } catch (error) {
      if (!this.isClosed) throw error;
    } finally {
      this.busy = false;
    }
  }
}

export async function trackStep(app) {
  app.panel.append(...title('Track', 'Pose and parameters are found in every frame.'));
  if (!app.state.done.start || !app.state.done.build || !app.state.done.camera) {
    app.panel.append(el('p', { className: 'problem' }, 'This step needs the model, the camera, the recording and the saved start.'));
    return {};
  }
  const [mesh, model, { colours }] = await Promise.all([call('model_mesh'), call('model'), explored('model.json')]);
  const refine = el('input', { id: 'refine', checked: !app.state.choices.at_rest });
  const snap = el('input', { id: 'snap' });
  const outline = el('input', { id: 'outline' });
  const start = el('button', { id: 'track', className: 'main', onclick: () => app.doing(() => call('track',
    { refine: refine.checked, snap: snap.checked, outline: outline.checked })) });
  const goLive = el('button', { id: 'go-live', className: 'main', onclick: () => app.doing(() => call('go_live',
    { snap: snap.checked, outline: outline.checked })) }, 'Go live');
  const liveParts = el('div');
  const result = el('div', { id: 'track-result' });
  const byScan = app.state.choices.start === 'scan';
  if (byScan) refine.checked = false;
  app.panel.append(
    ...(byScan ? [el('p', { className: 'note' }, 'The object starts from its place in the scan, and stays in the map.')] : [
      check('Refine the start over the whole video, and track once more', refine),
      el('p', { className: 'note' }, 'Takes twice as long. The start is then not taken as undeformed.'),
      check('Snap the start to the outline', snap),
      el('p', { className: 'note' }, 'Corrects the clicks by the edges that their image shows, where the part has those of its mesh.')]),
    check('Use the outline too', outline),
    el('p', { className: 'note' }, 'Where the object stands out from the background.'),
    start, command('morph track … --frame-log track.jsonl -o run'), liveParts, result,
  );
  const picture = el('div', { className: 'fill', id: 'track-image' });
  const plots = el('div', { className: 'plots' });
  app.view.append(el('div', { className: 'runview' }, el('div', {}, picture), plots));
  const shown = new RunPicture(picture, mesh, colours, 'log');
  const live = liveView(app, picture, () => drawJob(app.state.job));
  liveParts.append(el('h3', {}, 'Live'), ...live.parts, goLive,
    command(`morph live … ${byScan ? '' : '--reference-image live/000000.png '}--frame-log track.jsonl -o run`));
  live.isCovered = () => !showsLive();
  const plot = makePlots(plots, model);

  // A live camera is shown in place of the recording, unless that is being tracked.
  function showsLive() {
    const { job } = app.state;
    return Boolean(live.facts.camera) && !(job?.running && job.kind === 'track');
  }

  function drawFrames(frames) {
    plot(app.state.job?.kind === 'live' ? frames.slice(-MOST_PLOTTED) : frames);
    if (frames.length && !showsLive()) shown.show(frames.at(-1)).catch(() => {});
  }

  function drawJob(job) {
    start.textContent = app.state.done.track ? 'Track again' : 'Track';
    start.disabled = Boolean(job?.running);
    if (showsLive()) picture.parentElement.querySelector('.bar')?.remove();
    goLive.disabled = Boolean(job?.running) || !live.facts.camera || Boolean(live.facts.refused);
    const tracked = app.run.frames.filter((row) => row.status === 'tracked').length;
    const mine = ['track', 'live'].includes(job?.kind) ? job : null;
    const parts = [facts([['Frames', String(app.run.frames.length)], ['Tracked', String(tracked)]])];
    if (mine && !mine.running && mine.status) {
      parts.push(el('p', { className: mine.stopped ? 'warning' : 'problem' }, mine.lines.at(-1) ?? 'it ended without a message'));
    }
    const { run: problem } = app.state.notes;
    if (problem && !mine?.running) parts.push(el('p', { className: 'warning', id: 'run-note' }, problem));
    if (app.state.done.track && !mine?.running) {
      parts.push(el('button', { id: 'to-results', onclick: () => app.show('results') }, 'Next: results'));
    }
    result.replaceChildren(...parts);
  }

  drawJob(app.state.job);
  drawFrames(app.run.frames);
  return { close: () => shown.close(), job: drawJob, frames: (frames) => { drawFrames(frames); drawJob(app.state.job); } };
}
