// Shows a stream (docs/streams.md): the deforming surface, its parameters and the forces on its supports.

import { SolidView } from './solid_view.js';
import { ColourBar } from './colour_bar.js';

const TYPES = { '<f4': Float32Array, '<i4': Int32Array };
const element = (id) => document.getElementById(id);
let scene = null, view = null, chosen = 0, received = 0, firstNumber = 0;

// The head of a message, with its arrays by name.
function unpack(buffer) {
  const length = new DataView(buffer).getUint32(0, true);
  const head = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 4, length)));
  let offset = 4 + length;
  const arrays = {};
  for (const [name, type, size] of head.arrays) {
    arrays[name] = new TYPES[type](buffer, offset, size);
    offset += 4 * size;
  }
  return { ...head, arrays };
}

function row(table, name, value) {
  const line = table.insertRow(), header = document.createElement('th');
  header.textContent = name;
  line.append(header);
  line.insertCell().textContent = value;
}

function fill(id, rows) {
  const table = element(id);
  table.hidden = rows.length === 0;
  table.tBodies[0].replaceChildren();
  for (const [name, value] of rows) row(table.tBodies[0], name, value);
}

// "12.3 ± 0.4 mm", with two digits of the deviation.
function measured(value, deviation, factor, unit) {
  if (value === null || value === undefined) return '–';
  const shown = unit === '1' ? '' : ` ${unit}`;
  if (!deviation) return `${(value / factor).toPrecision(4)}${shown}`;
  const digits = Math.min(6, Math.max(0, 1 - Math.floor(Math.log10(deviation / factor))));
  return `${(value / factor).toFixed(digits)} ± ${(deviation / factor).toFixed(digits)}${shown}`;
}

function showScene(message) {
  scene = message;
  received = 0;
  element('status').textContent = 'waiting for a frame ...';
  const list = element('objects');
  list.replaceChildren(...scene.objects.map((object, i) => new Option(object.name, i)));
  list.hidden = scene.objects.length < 2;
  choose(Math.min(chosen, scene.objects.length - 1));
}

function choose(number) {
  chosen = number;
  const { name, scalar } = scene.objects[chosen];
  element('name').textContent = document.title = name;
  view?.dispose();
  const rest = scene.arrays[`${name}/rest`];
  let reach = 0;
  for (let axis = 0; axis < 3; axis++) {
    const along = rest.filter((_, i) => i % 3 === axis);
    reach = Math.max(reach, along.reduce((a, b) => Math.max(a, b)) - along.reduce((a, b) => Math.min(a, b)));
  }
  const triangles = new Uint32Array(scene.arrays[`${name}/triangles`]);
  view = new SolidView(element('view'), rest, triangles, scene.colours, reach / 4);
  element('bar').hidden = !scalar;
  if (scalar) {
    new ColourBar(element('bar'), scene.colours).show(scalar.name, scalar.shown_unit, scalar.high / scalar.shown_factor);
  }
  view.show(new Float32Array(rest.length), new Float32Array(rest.length / 3).fill(NaN), 1, 1);
}

function showFrame(message) {
  if (!scene) return;
  if (!received) firstNumber = message.number;
  received += 1;
  const object = scene.objects[chosen], { name, scalar } = object;
  const state = message.objects[chosen];
  element('status').textContent = state.status === 'tracked' ? `tracked: ${state.text}` : state.text;
  element('status').className = state.status;
  fill('parameters', object.parameters.map((one, i) => [
    one.name, measured(state.parameters[i], state.parameter_std[i], one.shown_factor, one.shown_unit)]));
  fill('reactions', Object.entries(state.reactions).map(([on, one]) => [
    on, measured(Math.hypot(...one.force), one.force_size_std, 1, 'N')]));
  fill('frame', [['frame', message.frame], ['time', `${message.timestamp.toFixed(2)} s`],
    ['frames missed', message.number - firstNumber + 1 - received]]);
  const vertices = message.arrays[`${name}/vertices`];
  if (!vertices) return; // the last shape stays
  const rest = scene.arrays[`${name}/rest`];
  const displacement = vertices.map((value, i) => value - rest[i]);
  const values = message.arrays[`${name}/scalar`] ?? new Float32Array(rest.length / 3).fill(NaN);
  view.show(displacement, values, scalar?.high ?? 1, 1);
  element('view').dataset.frame = message.frame;
}

function connect() {
  const socket = new WebSocket(`ws://${location.host}/stream`);
  let ended = false;
  socket.binaryType = 'arraybuffer';
  socket.onmessage = ({ data }) => {
    const message = unpack(data);
    if (message.type === 'scene') showScene(message);
    if (message.type === 'frame') showFrame(message);
    ended ||= message.type === 'end';
    if (ended) element('status').textContent = 'the stream has ended';
  };
  socket.onclose = () => {
    if (ended) return;
    element('status').textContent = 'no connection; trying again ...';
    setTimeout(connect, 1000);
  };
}

element('objects').addEventListener('change', (event) => choose(Number(event.target.value)));
connect();
