// As much of a browser as the studio's pages ask for, without any picture.

export class Node {
  constructor(tag) {
    Object.assign(this, {
      tag, id: '', className: '', type: '', title: '', min: '', max: '', step: '', placeholder: '', accept: '', src: '',
      href: '', alt: '', hidden: false, disabled: false, checked: false, readOnly: false, open: false, multiple: false,
      spellcheck: false, tabIndex: 0, maxLength: 0, muted: false, playsInline: false, autoplay: false, srcObject: null,
      scrollTop: 0, clientWidth: 600, clientHeight: 400, width: 0, height: 0,
      children: [], parent: null, listeners: {}, dataset: {}, style: {}, attributes: {}, ownText: '', ownValue: '',
      classList: { add() {}, remove() {} },
    });
  }

  get firstChild() { return this.children[0] ?? null; }

  get parentElement() { return this.parent; }

  get textContent() { return this.ownText + this.children.map((one) => one.textContent).join(''); }

  set textContent(text) { this.children = []; this.ownText = String(text); }

  get value() { return this.tag === 'select' ? this.ownValue || (this.children[0]?.ownValue ?? '') : this.ownValue; }

  set value(value) { this.ownValue = String(value); }

  get valueAsNumber() { return Number(this.ownValue); }

  append(...parts) {
    for (const part of parts) {
      const child = part instanceof Node ? part : Object.assign(new Node('text'), { ownText: String(part) });
      child.remove();
      child.parent = this;
      this.children.push(child);
    }
  }

  replaceChildren(...parts) {
    for (const child of this.children) child.parent = null;
    this.children = [];
    this.append(...parts);
  }

  remove() {
    if (this.parent) this.parent.children = this.parent.children.filter((one) => one !== this);
    this.parent = null;
  }

  after(part) { this.parent.append(part); }

  setAttribute(name, value) { this.attributes[name] = value; }

  addEventListener(name, listener) { (this.listeners[name] ??= []).push(listener); }

  fire(name, event = {}) {
    const whole = { preventDefault() {}, stopPropagation() {}, target: this, ...event };
    return Promise.all((this.listeners[name] ?? []).map((listener) => listener(whole)));
  }

  click() { return this.disabled ? Promise.resolve() : this.fire('click'); }

  all() { return this.children.flatMap((child) => [child, ...child.all()]); }

  querySelector(selector) {
    const name = selector.slice(1);
    return this.all().find((one) => (selector[0] === '#' ? one.id === name : one.className.split(' ').includes(name))) ?? null;
  }

  getBoundingClientRect() { return { left: 0, top: 0, width: 600, height: 400 }; }

  setPointerCapture() {}

  getContext() { return new Proxy({}, { get: () => () => {}, set: () => true }); }

  async play() {}
}

export const body = new Node('body');
export const wait = (milliseconds = 5) => new Promise((done) => { setTimeout(done, milliseconds); });

// An empty page with elements of these names.
export function page(...names) {
  body.replaceChildren(...names.map((id) => Object.assign(new Node('div'), { id })));
  return names.map((id) => body.querySelector(`#${id}`));
}

// Answers requests by functions of their content; a text is refused with it, a bitmap is a frame.
export function serve(answers) {
  globalThis.fetch = async (path, { body: content } = {}) => {
    const name = path.split('/').slice(2, 3)[0];
    const found = await answers[name](typeof content === 'string' ? JSON.parse(content) : path.split('/').at(-1));
    if (typeof found === 'string') return { ok: false, text: async () => found };
    if (found instanceof ArrayBuffer) {
      return { ok: true, headers: { get: () => 'application/octet-stream' }, arrayBuffer: async () => found };
    }
    return { ok: true, headers: { get: () => 'application/json' }, json: async () => found, blob: async () => found };
  };
}

// Facts and arrays as the server packs them; arrays: [name, type, values].
export function packed(facts, arrays) {
  const head = new TextEncoder().encode(JSON.stringify({ ...facts, arrays: arrays.map(([name, type, all]) => [name, type, all.length]) }));
  const start = 4 + Math.ceil(head.length / 4) * 4;
  const values = arrays.flatMap(([, type, all]) => [...new Uint8Array((type === '<f4' ? Float32Array : Int32Array).from(all).buffer)]);
  const whole = new Uint8Array(start + values.length).fill(32);
  new DataView(whole.buffer).setUint32(0, start - 4, true);
  whole.set(head, 4);
  whole.set(values, start);
  return whole.buffer;
}

// What a step is given; refused: messages of what went wrong.
export function stepApp(state = {}) {
  const [panel, view] = page('panel', 'view');
  const refused = [];
  const doing = async (action) => {
    try { return await action(); } catch (error) { refused.push(error.message); return undefined; }
  };
  return { panel, view, state, refused, doing, shown: [], refresh: async () => {}, message: (text) => refused.push(text),
    show(id) { this.shown.push(id); } };
}

// A camera that is given when the user allows it.
export class Camera {
  constructor() {
    this.given = [];
    this.asked = [];
    const devices = { getUserMedia: () => new Promise((given) => { this.asked.push(given); }) };
    Object.defineProperty(globalThis, 'navigator', { value: { mediaDevices: devices }, configurable: true });
  }

  async allow() {
    for (const given of this.asked.splice(0)) {
      const track = { isOn: true, stop() { this.isOn = false; }, applyConstraints: async () => {} };
      this.given.push(track);
      given({ getTracks: () => [track], getVideoTracks: () => [track] });
    }
    await wait();
  }

  get isOn() { return this.given.some((track) => track.isOn); }
}

class Socket {
  static OPEN = 1;

  static last = null;

  constructor() {
    Object.assign(this, { listeners: {}, readyState: 1 });
    Socket.last = this;
  }

  addEventListener(name, listener) { this.listeners[name] = listener; }

  tell(name, event) { this.listeners[name](event); return wait(); }

  close() { this.isClosed = true; }
}

class Recorder {
  static isTypeSupported() { return true; }

  constructor() { this.listeners = {}; }

  addEventListener(name, listener) { this.listeners[name] = listener; }

  start() {}

  stop() { this.listeners.stop(); }
}

// A page's clock does not keep the tests from ending.
const repeat = globalThis.setInterval;
globalThis.setInterval = (...words) => repeat(...words).unref();

export const events = {}; // listeners of the server's events by name
Object.assign(globalThis, {
  document: { body, createElement: (tag) => new Node(tag), getElementById: (id) => body.querySelector(`#${id}`) },
  window: { devicePixelRatio: 1 },
  location: { hash: '', protocol: 'http:', host: '127.0.0.1:1' },
  history: { replaceState() {} },
  Option: class extends Node { constructor(text, value) { super('option'); this.ownText = text; this.ownValue = String(value); } },
  ResizeObserver: class { observe() {} },
  EventSource: class { addEventListener(name, listener) { events[name] = (content) => listener({ data: JSON.stringify(content) }); } },
  createImageBitmap: async () => ({ width: 640, height: 480, close() {} }),
  WebSocket: Socket,
  MediaRecorder: Recorder,
  File: class { constructor(parts, name) { this.name = name; } },
});
