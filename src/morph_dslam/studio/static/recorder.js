// Records what a camera of this computer sees. Browsers allow it to pages of this computer alone, or over HTTPS.

import { el } from './parts.js';

const KINDS = [['video/webm;codecs=vp8', 'webm'], ['video/webm', 'webm'], ['video/mp4', 'mp4']];

// A button that starts and ends a recording, which is handed on as a file; what is seen is shown in the view.
export function recordButton(app, id, text, name, taken) {
  const button = el('button', { id }, text);
  let stop = null;
  let isAsking = false;
  let isClosed = false;
  button.addEventListener('click', () => app.doing(async () => {
    if (stop) return stop();
    if (!navigator.mediaDevices) throw new Error('the browser gives no camera to this page: open it as http://127.0.0.1');
    if (isAsking) return undefined;
    const [type, ending] = KINDS.find(([kind]) => MediaRecorder.isTypeSupported(kind));
    isAsking = true;
    let stream;
    try {
      stream = await navigator.mediaDevices.getUserMedia({
        video: { width: { ideal: 1280 }, facingMode: { ideal: 'environment' } }, audio: false,
      });
    } finally {
      isAsking = false;
    }
    if (isClosed) { // the step was left while the browser asked
      stream.getTracks().forEach((track) => track.stop());
      return undefined;
    }
    const recorder = new MediaRecorder(stream, { mimeType: type, videoBitsPerSecond: 20e6 });
    const parts = [];
    recorder.addEventListener('dataavailable', (event) => parts.push(event.data));
    recorder.addEventListener('stop', () => {
      stream.getTracks().forEach((track) => track.stop());
      app.doing(() => taken([new File(parts, `${name}.${ending}`)]));
    });
    const video = el('video', { id: `${id}-video`, className: 'seen', autoplay: true, muted: true, srcObject: stream });
    app.view.replaceChildren(video, el('span', { className: 'tag problem' }, 'recording'));
    recorder.start();
    button.textContent = 'Stop recording';
    stop = () => {
      stop = null;
      button.textContent = text;
      recorder.stop();
    };
    return undefined;
  }));
  return { button, close: () => { isClosed = true; stop?.(); } };
}
