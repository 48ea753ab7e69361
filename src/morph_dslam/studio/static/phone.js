// The page of a phone: records, and hands the video to the project; or is the camera of live tracking.

import { upload } from './server.js';
import { el } from './parts.js';
import { LiveCamera, figuresText } from './live_camera.js';
import { recordButton } from './recorder.js';

const said = document.getElementById('said');
const say = (text, isProblem = false) => Object.assign(said, { textContent: text, className: isProblem ? 'problem' : '' });
const app = {
  view: document.getElementById('view'),
  async doing(action) {
    try {
      return await action();
    } catch (error) {
      say(error.message, true);
      return undefined;
    }
  },
};
const { button: record } = recordButton(app, 'record', 'Record', 'phone', async ([file]) => {
  say('sending …');
  await upload('recording', file);
  say('The video is in the project. Record again to replace it.');
});
const live = el('button', { id: 'live', onclick: () => app.doing(toggle) }, 'Live');
const picture = el('canvas', { id: 'live-picture', className: 'seen over', hidden: true });
const facts = {};
let camera = null;
let awake = null;

async function toggle() {
  if (camera) {
    camera.stop();
    return;
  }
  camera = new LiveCamera({
    told: (news) => { Object.assign(facts, news); tell(); },
    picture(bitmap) {
      if (picture.width !== bitmap.width || picture.height !== bitmap.height) {
        Object.assign(picture, { width: bitmap.width, height: bitmap.height });
      }
      picture.getContext('2d').drawImage(bitmap, 0, 0);
      bitmap.close();
    },
    ended() {
      camera = null;
      awake?.release().catch(() => {});
      app.view.replaceChildren(el('div', { className: 'empty' }, 'What the camera sees appears here.'));
      live.textContent = 'Live';
      record.disabled = false;
      if (!facts.problem) say('Live has ended.');
    },
  });
  for (const name of Object.keys(facts)) delete facts[name];
  record.disabled = true;
  live.textContent = 'Stop';
  picture.camera = camera;
  app.view.replaceChildren(camera.video, picture);
  await camera.start();
  // The screen stays on, where the browser can see to it.
  awake = await navigator.wakeLock?.request('screen').catch(() => null);
}

function tell() {
  if (!camera) return; // what was told last stays, until something else happens
  picture.hidden = !facts.tracking;
  const problem = facts.problem || facts.refused;
  const figures = camera?.figures();
  say(problem || (facts.tracking ? figuresText(figures) || 'Tracking begins.'
    : 'The studio sees what the camera sees. Take a frame there, click pairs on it, and go live.'), Boolean(problem));
  if (figures) Object.assign(said.dataset, { rate: figures.rate.toFixed(2), latency: figures.latency.toFixed(1) });
}

setInterval(tell, 500);
live.className = 'main';
document.getElementById('controls').append(record, live);
