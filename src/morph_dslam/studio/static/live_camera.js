// Sends what a camera sees to the studio, frame by frame, and hands on the pictures that come back.

import { el } from './parts.js';

const MOST_OPEN = 2; // frames that are sent and not answered; the next one is then the newest
const PATIENCE = 1000; // milliseconds after which no answer is waited for
const MOST_KNOWN = 300; // frames whose times are kept
const QUALITY = 0.9;
const WINDOW = 2000; // milliseconds over which figures are taken
const REPLACED = 4000; // how the studio closes the connection of a camera whose place another one takes
const TOO_LARGE = 1009; // how it closes that of a camera whose frame has too many bytes

// A WebSocket of the page's own server.
export function openSocket(path) {
  const socket = new WebSocket(`${location.protocol === 'https:' ? 'wss' : 'ws'}://${location.host}${path}`);
  socket.binaryType = 'arraybuffer';
  return socket;
}

// The number of a frame, and its picture.
export async function pictureOf(message) {
  return [new DataView(message).getUint32(0, true), await createImageBitmap(new Blob([new Uint8Array(message, 4)]))];
}

export class LiveCamera {
  // told: called with facts of the studio, and with { problem }; picture: with each bitmap, which it closes; ended: when it is over.
  constructor({ told, picture = (bitmap) => bitmap.close(), ended = () => {} }) {
    Object.assign(this, { told, picture, ended });
    this.video = el('video', { className: 'seen', muted: true, playsInline: true });
    this.canvas = document.createElement('canvas');
    this.open = new Map(); // when frames that are not answered were seen, by number
    this.seen = new Map(); // the same of those whose picture may still come
    this.drawn = [];
    this.number = 0;
    this.running = false;
  }

  async start() {
    if (!navigator.mediaDevices) throw new Error('the browser gives no camera to this page: open it as http://127.0.0.1');
    this.running = true;
    try {
      const size = await new Promise((found, lost) => { this.connect(found, lost); });
      this.stream = await navigator.mediaDevices.getUserMedia({
        video: { ...sized(size), facingMode: { ideal: 'environment' } }, audio: false,
      });
      if (!this.running) { // while the browser asked
        this.stream.getTracks().forEach((track) => track.stop());
        throw new Error('the camera was stopped');
      }
      this.video.srcObject = this.stream;
      await this.video.play();
    } catch (error) {
      this.stop();
      throw error;
    }
    this.await();
  }

  stop() {
    if (!this.running) return;
    this.running = false;
    this.socket?.close();
    this.stream?.getTracks().forEach((track) => track.stop());
    this.ended();
  }

  connect(found = () => {}, lost = () => {}) {
    this.socket = openSocket('/api/camera');
    this.open.clear();
    this.socket.addEventListener('message', ({ data }) => {
      if (typeof data !== 'string') {
        this.show(data);
        return;
      }
      const facts = JSON.parse(data);
      if (facts.size !== undefined) {
        found(facts.size);
        this.stream?.getVideoTracks()[0].applyConstraints(sized(facts.size)).catch(() => {});
      }
      if (facts.seen !== undefined) this.answered(facts.seen);
      this.told(facts);
    });
    this.socket.addEventListener('close', ({ code, reason }) => {
      if (!this.running) return;
      if (code === TOO_LARGE) {
        this.told({ problem: `The studio takes no frames as large as those of this camera: choose a smaller size (${reason}).` });
        this.stop();
        return;
      }
      if (code === REPLACED || !this.stream) {
        this.told({ problem: reason || 'the studio refused the camera: open its address anew' });
        lost(new Error('the studio refused the camera: open its address anew'));
        this.stop();
        return;
      }
      this.told({ problem: 'The connection is lost; trying again.' });
      setTimeout(() => { if (this.running) this.connect(() => this.told({ problem: '' })); }, PATIENCE);
    });
  }

  // Wait for the camera's next frame.
  await() {
    if (!this.running) return;
    const next = () => {
      this.cameAt = performance.now();
      this.isFresh = true;
      this.send();
      this.await();
    };
    if (this.video.requestVideoFrameCallback) this.video.requestVideoFrameCallback(next);
    else setTimeout(next, 33);
  }

  send() {
    const now = performance.now();
    for (const [number, began] of this.open) if (now - began > PATIENCE) this.open.delete(number);
    if (!this.isFresh || this.encoding || this.open.size >= MOST_OPEN || this.socket.readyState !== WebSocket.OPEN) return;
    const { videoWidth: width, videoHeight: height } = this.video;
    if (!width) return;
    if (this.canvas.width !== width || this.canvas.height !== height) Object.assign(this.canvas, { width, height });
    const [number, began] = [this.number, this.cameAt];
    this.number += 1;
    this.isFresh = false;
    this.encoding = true;
    this.canvas.getContext('2d', { willReadFrequently: true }).drawImage(this.video, 0, 0);
    this.canvas.toBlob(async (blob) => {
      const message = new Uint8Array(4 + blob.size);
      new DataView(message.buffer).setUint32(0, number, true);
      message.set(new Uint8Array(await blob.arrayBuffer()), 4);
      this.encoding = false;
      if (this.socket.readyState !== WebSocket.OPEN) return;
      this.open.set(number, began);
      this.seen.set(number, began);
      this.seen.delete(number - MOST_KNOWN);
      this.socket.send(message);
      this.send();
    }, 'image/jpeg', QUALITY);
  }

  answered(number) {
    for (const one of this.open.keys()) if (one <= number) this.open.delete(one);
    this.send();
  }

  async show(message) {
    this.answered(new DataView(message).getUint32(0, true));
    const [number, bitmap] = await pictureOf(message);
    this.picture(bitmap);
    const now = performance.now();
    if (this.seen.has(number)) this.drawn.push([now, now - this.seen.get(number)]);
    while (this.drawn.length && now - this.drawn[0][0] > WINDOW) this.drawn.shift();
  }

  // Pictures a second, and the median time from the camera's frame until its picture is drawn, milliseconds.
  figures() {
    if (this.drawn.length < 2) return null;
    const latencies = this.drawn.map(([, latency]) => latency).sort((a, b) => a - b);
    const rate = 1000 * (this.drawn.length - 1) / (this.drawn.at(-1)[0] - this.drawn[0][0]);
    return { rate, latency: latencies[Math.floor(latencies.length / 2)] };
  }
}

// As the camera file wants it, and as the camera gives it: a browser would else cut frames to any size.
function sized(size) {
  const [width, height] = size ?? [640, 480];
  return { width: { ideal: width }, height: { ideal: height }, resizeMode: { ideal: 'none' } };
}

export function figuresText(figures) {
  return figures ? `${figures.rate.toFixed(1)} pictures a second, ${Math.round(figures.latency)} ms after the camera` : '';
}
