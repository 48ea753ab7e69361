// The colour bar: the model's colours with numbers beside them.

const TICKS = 6;

export class ColourBar {
  constructor(figure, colours) {
    this.caption = figure.querySelector('figcaption');
    this.numbers = figure.querySelector('ol');
    const canvas = figure.querySelector('canvas');
    const context = canvas.getContext('2d');
    const image = context.createImageData(1, colours.length);
    // The highest value is on top.
    colours.forEach((colour, i) => image.data.set(colour, 4 * (colours.length - 1 - i)));
    context.putImageData(image, 0, 0);
  }

  show(label, unit, top) {
    this.caption.textContent = `${label} [${unit}]`;
    const digits = Math.max(0, 2 - Math.floor(Math.log10(top)));
    this.numbers.replaceChildren(...Array.from({ length: TICKS }, (_, i) => {
      const item = document.createElement('li');
      item.textContent = (top * (1 - i / (TICKS - 1))).toFixed(Math.min(digits, 9));
      return item;
    }));
  }
}
