// What the live camera sees, with the object drawn over it as long as it is tracked; and the camera of this page.

import { call } from './server.js';
import { el, there } from './parts.js';
import { LiveCamera, figuresText, openSocket, pictureOf } from './live_camera.js';

// The camera of this page goes on from step to step; the view that is open is told of it.
let own = null;
let problem = '';
let redraw = () => {};

async function toggleOwn() {
  if (own) {
    own.stop();
    return;
  }
  const camera = new LiveCamera({
    told: (facts) => { if (facts.problem !== undefined) { problem = facts.problem; redraw(); } },
    ended: () => { own = null; camera.video.remove(); redraw(); },
  });
  own = camera;
  problem = '';
  camera.video.className = 'unseen';
  document.body.append(camera.video); // browsers slow down a video that is in no page
  redraw();
  await camera.start();
}

// Buttons for a live camera, and its view.
// container: where pictures go; told: called whenever what is known of the camera has changed. What is returned has
// `parts` for the panel, `facts` of the camera, and `isCovered`, to be set where something else may be shown there.
export function liveView(app, container, told) {
  const canvas = el('canvas', { className: 'seen', id: 'live-picture', hidden: true });
  const status = el('p', { id: 'live-status', className: 'note' });
  const button = el('button', { id: 'live-camera', onclick: () => app.doing(toggleOwn) });
  const take = el('button', { id: 'take-frame', onclick: () => app.doing(async () => {
    await call('take_frame');
    await app.show('start');
  }) }, 'Take this frame');
  const live = { facts: {}, isCovered: () => false, parts: [status, el('div', { className: 'row' }, button, take)] };
  let closed = false;
  let socket = null;
  container.append(canvas);

  function listen() {
    socket = openSocket('/api/watch');
    socket.addEventListener('message', async ({ data }) => {
      if (typeof data === 'string') {
        Object.assign(live.facts, JSON.parse(data));
        draw();
        told();
        return;
      }
      const [number, bitmap] = await pictureOf(data);
      if (canvas.width !== bitmap.width || canvas.height !== bitmap.height) {
        Object.assign(canvas, { width: bitmap.width, height: bitmap.height });
      }
      canvas.getContext('2d').drawImage(bitmap, 0, 0);
      canvas.dataset.frame = number;
      bitmap.close();
    });
    socket.addEventListener('close', () => { if (!closed) setTimeout(() => { if (!closed) listen(); }, 1000); });
  }

  function draw() {
    const { camera, refused, tracking } = live.facts;
    canvas.hidden = !camera || live.isCovered();
    button.textContent = own ? 'Stop the camera' : 'Start a camera here';
    take.disabled = !camera || Boolean(refused) || tracking;
    const figures = own && tracking ? figuresText(own.figures()) : '';
    const nothing = app.state.phone ? 'No camera yet: start one here, or press Live on the phone.' : 'No camera yet.';
    const words = camera ? there([`Camera ${camera}`, tracking ? 'tracked' : null, figures || null]).join(', ') : nothing;
    status.textContent = problem || refused || words;
    status.className = problem || refused ? 'problem' : 'note';
  }

  function close() {
    closed = true;
    if (redraw === draw) redraw = () => {};
    clearInterval(timer);
    socket.close();
  }

  const timer = setInterval(draw, 1000);
  redraw = draw;
  app.whenLeft(close);
  listen();
  draw();
  return live;
}
