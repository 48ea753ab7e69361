// Small parts of pages.

export function el(tag, attributes = {}, ...children) {
  const element = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) {
    if (name.startsWith('on')) element.addEventListener(name.slice(2), value);
    else if (name in element && name !== 'list') element[name] = value;
    else element.setAttribute(name, value);
  }
  element.append(...there(children));
  return element;
}

// The parts that are there: null stands for one that is not.
export function there(parts) {
  return parts.filter((part) => part !== null && part !== undefined);
}

export function title(text, lead) {
  return [el('h2', {}, text), el('p', { className: 'lead' }, lead)];
}

export function field(text, input) {
  return el('label', {}, el('span', {}, text), input);
}

export function check(text, input) {
  input.type = 'checkbox';
  return el('label', { className: 'check' }, input, el('span', {}, text));
}

export function choice(id, options, value) {
  const select = el('select', { id }, ...options.map(([key, text]) => new Option(text, key)));
  if (value !== undefined) select.value = value;
  return select;
}

export function facts(entries) {
  const parts = entries.flatMap(([name, value]) => [el('dt', {}, name), el('dd', {}, value)]);
  return el('dl', { className: 'facts' }, ...parts);
}

export function command(text) {
  return el('p', { className: 'command mono', title: 'what this step writes or runs' }, text);
}

// A place to drop files on, or to click.
export function dropZone(id, heading, kinds, accept, taken) {
  const input = el('input', { type: 'file', id: `${id}-file`, accept, multiple: true, hidden: true });
  const zone = el('div', { id, className: 'drop', tabIndex: 0, role: 'button' },
    el('strong', {}, heading), el('span', { className: 'note' }, kinds), input);
  const take = (files) => { if (files.length) taken([...files]); };
  input.addEventListener('change', () => { take(input.files); input.value = ''; });
  input.addEventListener('click', (event) => event.stopPropagation());
  zone.addEventListener('click', () => input.click());
  zone.addEventListener('keydown', (event) => { if (event.key === 'Enter') input.click(); });
  zone.addEventListener('dragover', (event) => { event.preventDefault(); zone.classList.add('over'); });
  zone.addEventListener('dragleave', () => zone.classList.remove('over'));
  zone.addEventListener('drop', (event) => {
    event.preventDefault();
    zone.classList.remove('over');
    take(event.dataTransfer.files);
  });
  return zone;
}

export function time(seconds) {
  if (seconds === null || seconds === undefined) return '';
  const whole = Math.round(seconds);
  return whole < 60 ? `${whole} s` : `${Math.floor(whole / 60)} min ${String(whole % 60).padStart(2, '0')} s`;
}

export function digits(value, count = 4) {
  return value === null || value === undefined ? '' : String(Number(value.toPrecision(count)));
}
