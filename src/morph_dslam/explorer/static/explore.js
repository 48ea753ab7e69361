// The page: sliders ask the server for the state they stand for, and the view shows the answer.

import { ColourBar } from './colour_bar.js';
import { SolidView } from './solid_view.js';

const element = (id) => document.getElementById(id);

async function request(path) {
  const response = await fetch(path);
  if (!response.ok) throw new Error(await response.text());
  return response;
}

function makeSlider(parameter, moved) {
  const label = document.createElement('label');
  const slider = document.createElement('input');
  const output = document.createElement('output');
  const name = document.createElement('span');
  name.textContent = parameter.name;
  if (parameter.description) {
    const note = document.createElement('small');
    note.textContent = parameter.description;
    name.append(note);
  }
  Object.assign(slider, {
    type: 'range', id: `parameter-${parameter.name}`, min: parameter.lower, max: parameter.upper, step: 'any',
  });
  slider.defaultValue = parameter.default;
  label.htmlFor = slider.id;
  label.append(name, output);
  const write = () => { output.textContent = `${Number(slider.valueAsNumber.toPrecision(4))} ${parameter.unit}`; };
  slider.addEventListener('input', () => { write(); moved(); });
  write();
  element('parameters').append(label, slider);
  return { slider, write };
}

class Page {
  constructor(model, shape) {
    this.model = model;
    const nodes = new Float32Array(shape, 0, 3 * model.nodes);
    const triangles = new Uint32Array(shape, 12 * model.nodes);
    const reach = model.fields.find((field) => field.key === 'displacement').top / 1000;
    this.view = new SolidView(element('view'), nodes, triangles, model.colours, reach);
    this.bar = new ColourBar(element('bar'), model.colours);
    this.sliders = model.parameters.map((parameter) => makeSlider(parameter, () => this.update()));
    this.addControls();
    document.title = model.name;
    element('name').textContent = model.name;
    element('size').textContent = `${model.nodes} surface nodes, ${model.triangles} triangles`;
  }

  addControls() {
    const fields = this.model.fields.map((field) => new Option(field.label, field.key));
    element('field').append(...fields);
    const stressed = this.model.fields.findIndex((field) => field.unit !== 'mm');
    if (stressed >= 0) fields[stressed].defaultSelected = fields[stressed].selected = true;
    element('field').addEventListener('change', () => this.update());
    element('fit').addEventListener('change', () => this.draw());
    element('scale').addEventListener('input', () => this.draw());
    element('rest').addEventListener('change', (event) => this.view.showRest(event.target.checked));
    element('controls').addEventListener('submit', (event) => event.preventDefault());
    element('controls').addEventListener('reset', () => setTimeout(() => { // after the values are back
      this.sliders.forEach(({ write }) => write());
      this.view.showRest(false);
      this.update();
    }));
  }

  // One request at a time; a slider that moves meanwhile is asked about when the answer is there.
  async update() {
    this.outdated = true;
    if (this.asking) return;
    this.asking = true;
    try {
      while (this.outdated) {
        this.outdated = false;
        await this.ask();
      }
      element('message').textContent = '';
    } catch (error) {
      element('message').textContent = `No answer from morph explore: ${error.message}`;
    } finally {
      this.asking = false;
    }
  }

  async ask() {
    const mu = this.sliders.map(({ slider }) => slider.value).join(',');
    const field = this.model.fields.find(({ key }) => key === element('field').value);
    const query = new URLSearchParams({ mu, field: field.key });
    const numbers = new Float32Array(await (await request(`state.bin?${query}`)).arrayBuffer());
    const { nodes } = this.model;
    this.state = { field, displacement: numbers.subarray(0, 3 * nodes), values: numbers.subarray(3 * nodes) };
    this.draw();
  }

  draw() {
    const { field, displacement, values } = this.state;
    const largest = values.reduce((most, value) => Math.max(most, value), 0);
    const top = element('fit').checked && largest > 0 ? largest : field.top;
    const scale = element('scale').valueAsNumber;
    this.view.show(displacement, values, top, Number.isFinite(scale) ? scale : 1);
    this.bar.show(field.label, field.unit, top);
    element('largest').textContent = `${largest.toPrecision(4)} ${field.unit}`;
  }
}

try {
  const model = await (await request('model.json')).json();
  const shape = await (await request('shape.bin')).arrayBuffer();
  await new Page(model, shape).update();
} catch (error) {
  element('message').textContent = error.message;
}
