// Study: material, supports, loads and parameters by forms, and the file beside them; each changes the other.

import { call } from './server.js';
import { check, choice, command, el, field, there, title } from './parts.js';

const UNITS = {
  stress: 'MPa', pressure: 'kPa', ratio: '', density: 'kg/m3', traction: 'kPa', force: 'N', x: 'mm', y: 'mm', z: 'mm',
  angle: 'deg', stiffness: 'N/mm3', acceleration: 'm/s2', centre: 'mm', translation: 'mm', point: 'mm', width: 'mm',
  radius: 'mm',
};
const FLAGS = { first: 'apply it before all others', normal_only: 'in the normal direction alone' };
const LISTS = { supports: 'Supports', loads: 'Loads', contacts: 'Contacts' };
const FIRST = { supports: 'fixed', loads: 'pressure', contacts: 'plane' };

const plainNumber = (text) => (/^[-+]?(\d+\.?\d*|\.\d+)(e[-+]?\d+)?$/i.test(text) ? Number(text) : text);

function words(entry) {
  const parts = Object.entries(entry).filter(([key]) => key !== 'kind' && key !== 'on' && key !== 'law');
  return parts.map(([key, value]) => `${key} ${Array.isArray(value) ? value.join(', ') : value}`).join(', ');
}

export async function studyStep(app) {
  const [forms, first] = await Promise.all([call('forms'), call('study')]);
  let study = first;
  const panel = el('div');
  const text = el('textarea', { id: 'study-text', spellcheck: false, 'aria-label': 'study.toml' });
  const save = el('button', { id: 'save-study', className: 'main', onclick: () => write() }, 'Save');
  const says = el('div', { className: 'says', id: 'study-says' });
  app.panel.append(...title('Study', 'What the object is made of, what holds and loads it, and what may vary.'), panel);
  app.view.append(el('div', { className: 'studyview' },
    el('div', { className: 'head' }, el('strong', { className: 'mono' }, 'study.toml'), save), text, says));
  text.addEventListener('input', () => { save.disabled = false; });
  text.addEventListener('keydown', (event) => {
    if (event.key === 's' && (event.ctrlKey || event.metaKey)) { event.preventDefault(); write(); }
  });

  const take = (found) => { study = found; draw(); app.refresh(); };
  const show = () => { text.value = study.text; save.disabled = true; };
  const write = () => app.doing(async () => {
    const sent = text.value;
    take(await call('write_study', { text: sent }));
    if (text.value === sent) show(); // what was typed meanwhile is kept
  });
  // changes: [section, key, value], of which the last one is shown. The text is not to be typed in until it has them all.
  const change = (...changes) => app.doing(async () => {
    text.readOnly = true;
    try {
      if (!save.disabled) await call('write_study', { text: text.value });
      let found = study;
      for (const [section, key, value] of changes) found = await call('change_study', { section, key, value });
      take(found);
      show();
    } finally {
      text.readOnly = false;
    }
  });
  // An entry that a form has changed, under a name that may be another one now.
  function changeNamed(section, known, before, name, value) {
    const changes = [[section, name, value]];
    if (before !== null && before !== name) {
      if (name in known) { app.message(`There is another ${name} already.`); return; }
      changes.push([section, before, null]);
    }
    change(...changes);
  }

  function draw() {
    const content = study.content ?? {};
    const lists = Object.keys(LISTS).map((section) => listed(section, content[section] ?? []));
    panel.replaceChildren(...materials(content.materials ?? {}), ...lists.flat(), ...parameters(content.parameters ?? {}),
      command('writes study.toml'), el('button', { id: 'to-build', onclick: async () => {
        if (!save.disabled) await write();
        if (save.disabled) app.show('build'); // else it could not be saved, which is said
      } }, 'Next: build'));
    const lines = [...study.problems.map((one) => ['problem', one]), ...study.warnings.map((one) => ['warning', one])];
    says.replaceChildren(lines.length
      ? el('ul', {}, ...lines.map(([kind, one]) => el('li', { className: kind }, one)))
      : el('p', { className: 'good', id: 'study-good' }, 'The study can be built.'));
  }

  function entries(id, rows) {
    return el('ul', { className: 'list', id }, ...rows.map(([name, small, edit, remove]) => el('li', {},
      el('span', { title: small }, name, ' ', el('small', {}, small)),
      ...there([edit && el('button', { className: 'plain', onclick: edit }, 'edit')]),
      el('button', { className: 'plain', title: 'take out', onclick: remove }, '✕'))));
  }

  function materials(known) {
    const form = el('div');
    const rows = Object.entries(known).map(([name, entry]) => [name, `${entry.law}: ${words(entry)}`,
      entry.law in forms.laws ? () => lawForm(form, known, name, entry, name) : null, () => change(['materials', name, null])]);
    const pick = choice('material', [['', 'Choose a material …'],
      ...forms.materials.map((one, i) => [String(i), one.title]), ['own', 'Own constants …']]);
    pick.addEventListener('change', () => {
      if (pick.value === 'own') lawForm(form, known, 'material', { law: 'neo_hookean' });
      else if (pick.value) libraryForm(form, forms.materials[Number(pick.value)]);
      else form.replaceChildren();
    });
    return [el('h3', {}, 'Material'), entries('materials', rows), pick, el('p', { style: 'margin-bottom: 8px' }), form];
  }

  function libraryForm(form, entry) {
    form.replaceChildren(el('div', { className: 'box' },
      el('p', {}, words(entry.section), ` (${entry.section.law})`),
      el('p', { className: 'note' }, entry.note), el('p', { className: 'note' }, `Source: ${entry.source}`),
      el('button', { id: 'add-material', className: 'main', onclick: () => change(['materials', entry.name, entry.section]) },
        'Use it')));
  }

  // before: name of the entry that is edited, null for a new one.
  function lawForm(form, known, name, entry, before = null) {
    const nameInput = el('input', { id: 'material-name', value: name });
    const law = choice('law', Object.keys(forms.laws).map((one) => [one, one]), entry.law);
    const place = el('div');
    const fill = () => place.replaceChildren(...forms.laws[law.value].map(([key, quantity]) => field(
      `${key}${quantity === 'ratio' ? '' : `, ${UNITS[quantity] ?? quantity}`}`,
      el('input', { id: `constant-${key}`, value: entry[key] ?? '', placeholder: quantity === 'ratio' ? '0.45' : `3 ${UNITS[quantity] ?? ''}` }))));
    law.addEventListener('change', fill);
    fill();
    form.replaceChildren(el('div', { className: 'box' },
      el('div', { className: 'row' }, field('Name', nameInput), field('Law', law)), place,
      el('button', { id: 'add-material', className: 'main', onclick: () => {
        // What the form does not show stays, constants of another law go.
        const section = { ...entry, law: law.value };
        for (const [key] of [...forms.laws[entry.law], ...forms.laws[law.value]]) delete section[key];
        for (const [key, quantity] of forms.laws[law.value]) {
          const value = place.querySelector(`#constant-${key}`).value.trim();
          if (value) section[key] = withUnit(value, quantity);
        }
        changeNamed('materials', known, before, nameInput.value.trim(), section);
      } }, 'Save material')));
  }

  // A number alone gets the unit that the form shows; lists are written with commas.
  function withUnit(value, quantity) {
    const one = (part) => {
      const number = plainNumber(part.trim());
      return typeof number === 'number' && UNITS[quantity] ? `${number} ${UNITS[quantity]}` : number;
    };
    return value.includes(',') ? value.split(',').map(one) : one(value);
  }

  function listed(section, known) {
    const form = el('div');
    const rows = known.map((entry, i) => [`${entry.kind}${entry.on ? ` on ${entry.on}` : ''}`, words(entry),
      () => kindForm(form, section, i, entry), () => change([section, i, null])]);
    const add = el('button', { id: `add-${section}`, className: 'plain', onclick: () => kindForm(form, section, known.length,
      { kind: FIRST[section] }) }, '+ add');
    return [el('div', { className: 'row', style: 'margin: 24px 0 4px; align-items: center' },
      el('h3', { style: 'margin: 0' }, LISTS[section]), add), entries(section, rows), form];
  }

  function kindForm(form, section, position, entry) {
    const kinds = forms.kinds[section];
    const kind = choice(`${section}-kind`, Object.keys(kinds).map((one) => [one, one.replaceAll('_', ' ')]), entry.kind);
    const place = el('div');
    const inputs = () => kinds[kind.value].fields;
    const fill = () => place.replaceChildren(el('p', { className: 'note' }, kinds[kind.value].help.replaceAll('``', '')),
      ...inputs().map((one) => input(section, one, entry)));
    kind.addEventListener('change', fill);
    fill();
    form.replaceChildren(el('div', { className: 'box' }, field('Kind', kind), place,
      el('button', { id: `save-${section}`, className: 'main', onclick: () => {
        const value = { kind: kind.value };
        for (const one of inputs()) {
          const found = read(place.querySelector(`#${section}-${one.key}`), one);
          if (found !== null) value[one.key] = found;
        }
        change([section, position, value]);
      } }, 'Save')));
  }

  function input(section, { key, kind, required }, entry) {
    const id = `${section}-${key}`;
    const value = entry[key];
    if (kind === 'flag') return check(FLAGS[key] ?? key.replaceAll('_', ' '), el('input', { id, checked: value ?? false }));
    if (kind === 'set') {
      const sets = required ? study.sets : ['', ...study.sets, ...study.cell_sets];
      return field(key === 'on' ? 'On' : 'Against', choice(id, sets.map((one) => [one, one || 'everything']), value));
    }
    const unit = kind === 'numbers' ? '' : UNITS[key] ?? '';
    const many = kind !== 'value';
    return field(`${key}${unit ? `, ${unit} or a parameter` : ''}${required ? '' : ' (optional)'}`, el('input', {
      id, value: Array.isArray(value) ? value.join(', ') : value ?? '',
      placeholder: many ? `0${unit && ` ${unit}`}, 0${unit && ` ${unit}`}, 1${unit && ` ${unit}`}` : `1 ${unit}`,
    }));
  }

  function read(element, { key, kind }) {
    if (kind === 'flag') return element.checked ? true : null;
    const value = element.value.trim();
    if (!value) return null;
    if (kind === 'set') return value;
    const one = (part) => {
      const number = plainNumber(part.trim());
      return kind !== 'numbers' && typeof number === 'number' && UNITS[key] ? `${number} ${UNITS[key]}` : number;
    };
    return kind === 'value' || !value.includes(',') ? one(value) : value.split(',').map(one);
  }

  function parameters(known) {
    const form = el('div');
    const rows = Object.entries(known).map(([name, entry]) => [name, `${entry.range?.join(' to ')}`,
      () => parameterForm(form, known, name, entry, name), () => change(['parameters', name, null])]);
    return [el('div', { className: 'row', style: 'margin: 24px 0 4px; align-items: center' },
      el('h3', { style: 'margin: 0' }, 'Parameters'),
      el('button', { id: 'add-parameters', className: 'plain', onclick: () => parameterForm(form, known, '', {}) }, '+ add')),
    el('p', { className: 'note' }, 'What is estimated in every frame: a motion, a load, a modulus.'),
    entries('parameters', rows), form];
  }

  function parameterForm(form, known, name, entry, before = null) {
    const [low, high] = entry.range ?? ['', ''];
    const inputs = {
      name: el('input', { id: 'parameter-name', value: name, placeholder: 'push' }),
      low: el('input', { id: 'parameter-low', value: low, placeholder: '0 mm' }),
      high: el('input', { id: 'parameter-high', value: high, placeholder: '12 mm' }),
      start: el('input', { id: 'parameter-default', value: entry.default ?? '', placeholder: 'nearest to zero' }),
    };
    form.replaceChildren(el('div', { className: 'box' }, field('Name, as values above use it', inputs.name),
      el('div', { className: 'row' }, field('From', inputs.low), field('To', inputs.high), field('Default', inputs.start)),
      el('button', { id: 'save-parameters', className: 'main', onclick: () => {
        const value = { ...entry, range: [plainNumber(inputs.low.value.trim()), plainNumber(inputs.high.value.trim())] };
        delete value.default;
        if (inputs.start.value.trim()) value.default = plainNumber(inputs.start.value.trim());
        changeNamed('parameters', known, before, inputs.name.value.trim(), value);
      } }, 'Save')));
  }

  draw();
  show();
  return {};
}
