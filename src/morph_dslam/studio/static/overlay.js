// An image with the model drawn over it. Wheel zooms, dragging shifts, a click tells its pixel.

import { digits } from './parts.js';

const MOST_MOVED = 4;

export class ImageView {
  constructor(container, clicked = null) {
    this.canvas = document.createElement('canvas');
    container.append(this.canvas);
    this.container = container;
    this.image = null;
    this.overlay = null;
    this.marks = [];
    this.opacity = 0.75;
    let start = null;
    this.canvas.addEventListener('pointerdown', (event) => {
      if (event.button !== 0) return;
      start = { x: event.clientX, y: event.clientY, left: this.left, top: this.top, moved: 0 };
      this.canvas.setPointerCapture(event.pointerId);
    });
    this.canvas.addEventListener('pointermove', (event) => {
      if (!start) return;
      const [dx, dy] = [event.clientX - start.x, event.clientY - start.y];
      start.moved = Math.max(start.moved, Math.hypot(dx, dy));
      if (start.moved > MOST_MOVED) {
        this.left = start.left + dx;
        this.top = start.top + dy;
        this.draw();
      }
    });
    this.canvas.addEventListener('pointerup', (event) => {
      if (start && start.moved <= MOST_MOVED && clicked && this.image) {
        const pixel = this.pixelAt(event.clientX, event.clientY);
        const inside = pixel[0] > -0.5 && pixel[1] > -0.5
          && pixel[0] < this.image.width - 0.5 && pixel[1] < this.image.height - 0.5;
        if (inside) clicked(pixel);
      }
      start = null;
    });
    this.canvas.addEventListener('pointercancel', () => { start = null; });
    this.canvas.addEventListener('wheel', (event) => {
      event.preventDefault();
      const { left, top } = this.canvas.getBoundingClientRect();
      const [x, y] = [event.clientX - left, event.clientY - top];
      const factor = Math.exp(-0.0015 * event.deltaY);
      this.scale *= factor;
      this.left = x - factor * (x - this.left);
      this.top = y - factor * (y - this.top);
      this.draw();
    }, { passive: false });
    new ResizeObserver(() => { this.fit(); this.draw(); }).observe(container);
  }

  // Pixel (0, 0) is the centre of the first pixel.
  pixelAt(x, y) {
    const { left, top } = this.canvas.getBoundingClientRect();
    return [(x - left - this.left) / this.scale - 0.5, (y - top - this.top) / this.scale - 0.5];
  }

  onPage([u, v]) {
    const { left, top } = this.canvas.getBoundingClientRect();
    return [left + this.left + this.scale * (u + 0.5), top + this.top + this.scale * (v + 0.5)];
  }

  setImage(image) {
    const isNew = !this.image || this.image.width !== image.width || this.image.height !== image.height;
    if (this.image !== image) this.image?.close?.();
    this.image = image;
    if (isNew) this.fit();
    this.draw();
  }

  fit() {
    if (!this.image) return;
    const { clientWidth: width, clientHeight: height } = this.container;
    this.scale = Math.min(width / this.image.width, height / this.image.height) * 0.96;
    this.left = (width - this.scale * this.image.width) / 2;
    this.top = (height - this.scale * this.image.height) / 2;
  }

  // overlay: pixels (2 n), order (t), values (n), top; with the model's triangles (3 t) and colours.
  setOverlay(overlay, triangles, colours) {
    this.overlay = overlay && overlay.pixels ? { ...overlay, triangles, colours } : null;
    this.draw();
  }

  draw() {
    const { clientWidth: width, clientHeight: height } = this.container;
    const ratio = window.devicePixelRatio;
    if (this.canvas.width !== Math.round(width * ratio) || this.canvas.height !== Math.round(height * ratio)) {
      this.canvas.width = Math.round(width * ratio);
      this.canvas.height = Math.round(height * ratio);
      this.canvas.style.width = `${width}px`;
      this.canvas.style.height = `${height}px`;
    }
    const context = this.canvas.getContext('2d');
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    context.clearRect(0, 0, width, height);
    if (!this.image) return;
    context.translate(this.left, this.top);
    context.scale(this.scale, this.scale);
    context.imageSmoothingEnabled = this.scale < 3;
    context.drawImage(this.image, 0, 0);
    context.translate(0.5, 0.5);
    if (this.overlay) this.drawOverlay(context);
    this.marks.forEach((mark) => this.drawMark(context, mark));
  }

  drawOverlay(context) {
    const { pixels, order, values, top, triangles, colours } = this.overlay;
    context.globalAlpha = this.opacity;
    context.lineWidth = 0.6 / this.scale;
    for (const t of order) {
      const corners = [triangles[3 * t], triangles[3 * t + 1], triangles[3 * t + 2]];
      const mean = corners.reduce((sum, node) => sum + values[node], 0) / 3;
      const entry = Math.min(255, Math.max(0, Math.round(255 * mean / top)));
      const [r, g, b] = colours[Number.isFinite(entry) ? entry : 0];
      context.fillStyle = context.strokeStyle = `rgb(${r} ${g} ${b})`;
      context.beginPath();
      corners.forEach((node, i) => context[i ? 'lineTo' : 'moveTo'](pixels[2 * node], pixels[2 * node + 1]));
      context.closePath();
      context.fill();
      context.stroke();
    }
    context.globalAlpha = 1;
  }

  drawMark(context, { pixel: [u, v], colour, label }) {
    const reach = 7 / this.scale;
    for (const [style, line] of [['#fff', 3.5], [colour, 1.6]]) {
      context.strokeStyle = style;
      context.lineWidth = line / this.scale;
      context.beginPath();
      context.moveTo(u - reach, v);
      context.lineTo(u + reach, v);
      context.moveTo(u, v - reach);
      context.lineTo(u, v + reach);
      context.stroke();
    }
    if (!label) return;
    context.font = `600 ${12 / this.scale}px system-ui`;
    context.lineWidth = 3 / this.scale;
    context.strokeStyle = '#fff';
    context.fillStyle = colour;
    context.strokeText(label, u + reach, v - reach);
    context.fillText(label, u + reach, v - reach);
  }
}

// The colours' ends beside their gradient.
export function colourBar(colours, overlay) {
  const bar = document.createElement('div');
  bar.className = 'bar';
  const stops = [0, 51, 102, 153, 204, 255].map((i) => `rgb(${colours[i].slice(0, 3).join(' ')})`);
  const gradient = document.createElement('i');
  gradient.style.background = `linear-gradient(90deg, ${stops.join(', ')})`;
  const words = overlay.unit === 'mm' ? 'displacement' : 'von Mises stress';
  bar.append(`${words}  0`, gradient, `${digits(overlay.top)} ${overlay.unit}`);
  return bar;
}
