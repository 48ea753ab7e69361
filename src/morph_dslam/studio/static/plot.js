// A small plot of lines over frames.

const INK = ['#0f6e8c', '#be4b6e', '#468232', '#7855b4', '#c87828', '#3c64be'];

export class Plot {
  constructor(container, heading, unit) {
    this.figure = document.createElement('figure');
    this.caption = document.createElement('figcaption');
    this.canvas = document.createElement('canvas');
    this.canvas.setAttribute('role', 'img');
    this.figure.append(this.caption, this.canvas);
    container.append(this.figure);
    Object.assign(this, { heading, unit, lines: [], current: null });
    new ResizeObserver(() => this.draw()).observe(this.figure);
  }

  // lines: [{ name, points: [[frame, value or null]] }]
  set(lines, current = null) {
    this.lines = lines;
    this.current = current;
    this.draw();
  }

  draw() {
    const title = document.createElement('b');
    title.textContent = `${this.heading}${this.unit ? ` [${this.unit}]` : ''}`;
    const names = this.lines.length > 1 ? this.lines.map(({ name }, i) => {
      const span = document.createElement('span');
      span.style.color = INK[i % INK.length];
      span.textContent = name;
      return span;
    }) : [];
    this.caption.replaceChildren(title, ...names);
    const width = this.figure.clientWidth - 28;
    const height = this.figure.clientHeight - this.caption.offsetHeight - 20;
    if (width < 20 || height < 20) return;
    const ratio = window.devicePixelRatio;
    Object.assign(this.canvas, { width: width * ratio, height: height * ratio });
    const context = this.canvas.getContext('2d');
    context.scale(ratio, ratio);
    const known = this.lines.flatMap(({ points }) => points).filter(([, y]) => y !== null && Number.isFinite(y));
    if (!known.length) return;
    const [x0, x1] = range(known.map(([x]) => x), 1);
    const ticks = steps(...range(known.map(([, y]) => y), 1e-9));
    const [y0, y1] = [ticks[0], ticks.at(-1)];
    const left = 46;
    const bottom = height - 16;
    const place = ([x, y]) => [left + (width - left - 6) * (x - x0) / (x1 - x0), bottom - (bottom - 6) * (y - y0) / (y1 - y0)];
    context.font = '11px system-ui';
    context.textBaseline = 'middle';
    for (const tick of ticks) {
      const [, y] = place([x0, tick]);
      context.strokeStyle = '#e4e8ed';
      context.beginPath();
      context.moveTo(left, y);
      context.lineTo(width - 6, y);
      context.stroke();
      context.fillStyle = '#8a95a3';
      context.textAlign = 'right';
      context.fillText(String(Number(tick.toPrecision(4))), left - 6, y);
    }
    context.textAlign = 'left';
    context.fillText(String(x0), left, height - 5);
    context.textAlign = 'right';
    context.fillText(`frame ${x1}`, width - 6, height - 5);
    this.lines.forEach(({ points }, i) => {
      context.strokeStyle = INK[i % INK.length];
      context.lineWidth = 1.6;
      context.beginPath();
      let drawing = false;
      for (const point of points) {
        if (point[1] === null || !Number.isFinite(point[1])) { drawing = false; continue; }
        context[drawing ? 'lineTo' : 'moveTo'](...place(point));
        drawing = true;
      }
      context.stroke();
    });
    if (this.current !== null) {
      const [x] = place([this.current, y0]);
      context.strokeStyle = '#1c2430';
      context.lineWidth = 1;
      context.beginPath();
      context.moveTo(x, 4);
      context.lineTo(x, bottom);
      context.stroke();
    }
  }
}

function range(values, least) {
  const low = values.reduce((a, b) => Math.min(a, b));
  const high = values.reduce((a, b) => Math.max(a, b));
  return high - low < least ? [low, low + least] : [low, high];
}

// Round numbers that enclose a range.
function steps(low, high) {
  const raw = (high - low) / 3;
  const power = 10 ** Math.floor(Math.log10(raw));
  const step = [1, 2, 5, 10].map((n) => n * power).find((n) => n >= raw);
  const first = Math.floor(low / step);
  return Array.from({ length: Math.ceil(high / step) - first + 1 }, (_, i) => (first + i) * step);
}

// Lines of a run's frames: parameters in their own units, forces, the largest stress or displacement.
export function makePlots(container, model) {
  const parameters = model.parameters.slice(0, 3).map((p) => ({ p, plot: new Plot(container, p.name, p.unit) }));
  const largest = model.stress ? new Plot(container, 'largest von Mises stress', model.stress.unit)
    : new Plot(container, 'largest displacement', 'mm');
  const forces = model.supports.length ? new Plot(container, 'reactions', 'N') : null;
  return (frames, current = null) => {
    const line = (name, value) => ({ name, points: frames.map((row) => [row.frame, value(row)]) });
    const scaled = (value, factor) => (value === null || value === undefined ? null : value * factor);
    for (const { p, plot } of parameters) {
      plot.set([line(p.name, (row) => scaled(row.parameters[p.name], p.factor))], current);
    }
    largest.set([line('', (row) => (model.stress ? scaled(row.largest_von_mises, 1 / model.stress.factor)
      : scaled(row.largest_displacement, 1e3)))], current);
    forces?.set(model.supports.map((name) => line(name, (row) => {
      const force = row.forces[name];
      return force ? Math.hypot(...force) : null;
    })), current);
  };
}
