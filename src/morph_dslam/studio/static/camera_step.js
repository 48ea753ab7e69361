// Camera: the recording, and the camera's intrinsics from a file, a board, or a guess.

import { call, frame, upload } from './server.js';
import { choice, command, digits, dropZone, el, facts, field, there, title } from './parts.js';
import { ImageView } from './overlay.js';
import { liveView } from './live_view.js';
import { recordButton } from './recorder.js';

const PICTURES = '.png,.jpg,.jpeg,.bmp,.tif,.tiff';
const VIDEOS = '.mp4,.mov,.avi,.mkv,.webm,.m4v';
const isPicture = (file) => PICTURES.split(',').some((ending) => file.name.toLowerCase().endsWith(ending));

export async function cameraStep(app) {
  const recording = el('div');
  const camera = el('div');
  const phone = el('div');
  const board = el('input', { id: 'board', value: '9x6' });
  const square = el('input', { id: 'square', value: '25 mm' });
  const lens = choice('lens', [['radial-tangential', 'normal'], ['fisheye', 'fisheye']]);
  let boards = app.state.files.includes('board') ? 'Pictures of the board are there.' : 'No pictures yet.';
  const boardNote = el('p', { className: 'note' }, boards);
  const takeRecording = async (files) => {
    if (isPicture(files[0])) {
      await call('forget_frames', { folder: 'frames' });
      for (const [i, file] of files.entries()) {
        app.message(`uploading image ${i + 1} of ${files.length}`);
        await upload('frame', file);
      }
      app.message('');
    } else await upload('recording', files[0]);
    await refresh();
  };
  const takeBoard = async (files) => {
    await call('forget_frames', { folder: 'board' });
    for (const file of files) await upload('board', file);
    boardNote.textContent = `${files.length} file${files.length > 1 ? 's' : ''} uploaded.`;
    await draw();
  };
  const record = recordButton(app, 'record', 'Record with a camera of this computer', 'webcam', takeRecording);
  const liveWhere = el('div', { className: 'fill', style: 'z-index: 3' });
  const live = liveView(app, liveWhere, () => showLive());
  const recordBoard = recordButton(app, 'record-board', 'Record the board', 'board', takeBoard);
  app.panel.append(
    ...title('Camera', 'The video of the object, and what is known of the camera that took it.'),
    el('h3', { style: 'margin-top: 8px' }, 'Recording'),
    dropZone('drop-recording', 'Drop a video, or numbered images', 'MP4, MOV, AVI, MKV, WebM; PNG, JPEG', `${VIDEOS},${PICTURES}`,
      (files) => app.doing(() => takeRecording(files))),
    el('p', {}, record.button), phone, recording,
    el('h3', {}, 'Live'), ...live.parts,
    el('h3', {}, 'Intrinsics'),
    dropZone('drop-camera', 'Drop a camera file', 'of this program, OpenCV, ROS, Kalibr, COLMAP', '.yaml,.yml,.txt',
      ([file]) => app.doing(async () => { await upload('camera', file); await refresh(); })),
    camera,
    el('details', {}, el('summary', {}, 'Calibrate with a checkerboard'),
      dropZone('drop-board', 'Drop 15 to 30 pictures of the board', 'or a slow video of it', `${VIDEOS},${PICTURES}`,
        (files) => app.doing(() => takeBoard(files))),
      el('p', {}, recordBoard.button), boardNote,
      el('div', { className: 'row' }, field('Inner corners', board), field('Square', square), field('Lens', lens)),
      el('button', { id: 'calibrate', onclick: () => app.doing(() => call('calibrate',
        { board: board.value, square: square.value, lens: lens.value })) }, 'Calibrate'),
      command('morph calibrate board -o camera.yaml')),
    el('details', {}, el('summary', {}, 'Guess from a photograph'),
      el('p', { className: 'note' }, 'A photograph of the same phone says its focal length. Good for a first look, not for measurements.'),
      dropZone('drop-photo', 'Drop a photograph', 'JPEG straight from the phone', '.jpg,.jpeg', ([file]) => app.doing(async () => {
        await call('guess_camera', { photo: await upload('photo', file) });
        await refresh();
      }))),
    el('button', { id: 'to-start', onclick: () => app.show('start') }, 'Next: start'),
  );

  // A live camera is shown in place of the recording, over which its view lies.
  function showLive() {
    if (live.facts.camera && !liveWhere.parentElement) app.view.append(liveWhere);
    else if (!live.facts.camera) liveWhere.remove();
  }

  async function refresh() { await app.refresh(); await draw(); }

  // The address of a phone works once, then it is another one.
  function drawPhone() {
    const { state } = app;
    phone.replaceChildren(...there([state.phone && el('div', { className: 'box' },
      el('p', {}, 'Record with a phone, or let it be the live camera: scan the code, or open the address there. It works once, and the browser warns of the certificate.'),
      el('img', { id: 'phone-code', src: `/api/phone.png?${Date.now()}`, alt: 'QR code' }),
      el('p', { className: 'mono', id: 'phone-address' }, state.phone))]));
  }

  async function draw() {
    const { state } = app;
    drawPhone();
    const found = state.recording;
    recording.replaceChildren();
    if (found?.message) recording.append(el('p', { className: 'problem' }, found.message));
    else if (found) {
      recording.append(facts([['File', state.choices.recording], ['Frames', `${found.frames}, from ${found.first}`],
        ['Size', `${found.width} × ${found.height}`], ['Rate', `${digits(found.fps, 3)} a second`]]));
      const container = el('div', { className: 'fill' });
      app.view.replaceChildren(container, el('span', { className: 'tag' }, `frame ${found.first}`));
      new ImageView(container).setImage(await frame(found.first));
    } else app.view.replaceChildren(el('div', { className: 'empty' }, 'The first frame appears here.'));
    if (state.notes.start) recording.append(el('p', { className: 'warning note', id: 'pairs-note' }, state.notes.start));
    const one = state.camera;
    camera.replaceChildren();
    if (one?.message) camera.append(el('p', { className: 'problem' }, one.message));
    else if (one) {
      camera.append(facts([['From', state.choices.camera_from ?? 'camera.yaml'], ['Size', `${one.width} × ${one.height}`],
        ['Focal length', `${digits(one.fx)}, ${digits(one.fy)} px`], ['Centre', `${digits(one.cx)}, ${digits(one.cy)} px`],
        ['Distortion', one.distortion.length ? one.distortion.map((k) => digits(k, 3)).join(', ') : 'none']]));
      if (state.choices.camera_note) camera.append(el('p', { className: 'warning note' }, state.choices.camera_note));
      if (state.notes.camera) camera.append(el('p', { className: 'problem' }, state.notes.camera));
      camera.append(command('writes camera.yaml'));
    }
  }

  await draw();
  showLive();
  return {
    close: () => [record, recordBoard].forEach((one) => one.close()),
    recording: draw,
    phone: drawPhone,
    job: (job, ended) => { if (ended && job.kind === 'calibrate') app.doing(draw); },
  };
}
