// In the place of views that need WebGL.

export const colourOf = () => [1, 2, 3, 255];

export class MeshView {
  colour() {}

  mark() {}

  dispose() { this.isGone = true; }
}

export class SolidView extends MeshView {
  static all = [];

  constructor() {
    super();
    Object.assign(this, { renderer: { setClearColor() {} }, shown: 0 });
    SolidView.all.push(this);
  }

  show() { this.shown += 1; }
}
