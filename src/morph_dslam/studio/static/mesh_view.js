// A surface whose faces and points are picked with the mouse. Each triangle has its own corners, so that a face has a
// colour of its own: an entry of a palette, looked up as the explorer looks up values.

import * as THREE from 'three';
import { SolidView } from './solid_view.js';

const BODY = [176, 190, 204, 255];
export const PICKED = [240, 140, 0, 255];
const SETS = [
  [15, 110, 140, 255], [190, 75, 110, 255], [70, 130, 60, 255], [120, 85, 180, 255], [200, 120, 40, 255],
  [60, 100, 190, 255], [150, 130, 30, 255], [90, 90, 100, 255],
];
export const colourOf = (number) => SETS[number % SETS.length];
const MOST_MOVED = 4; // pixels between press and release of a click

export class MeshView extends SolidView {
  // nodes (3 n) in metres, triangles (3 t); faces (t): number of the face that each triangle is a part of.
  constructor(container, nodes, triangles, faces, picked) {
    const corners = new Float32Array(3 * triangles.length);
    triangles.forEach((node, i) => corners.set(nodes.subarray(3 * node, 3 * node + 3), 3 * i));
    const palette = [BODY, PICKED, ...SETS];
    super(container, corners, Uint32Array.from(triangles.keys()), palette, 0);
    Object.assign(this, { faces, size: palette.length, none: new Float32Array(corners.length) });
    this.renderer.setClearColor(0xe9edf2);
    this.rest.material.color.set(0x1c2430);
    this.rest.material.opacity = 0.12;
    this.showRest(true);
    this.markers = new THREE.Group();
    this.scene.add(this.markers);
    this.colour(new Map());
    const canvas = this.renderer.domElement;
    let pressed = null;
    canvas.addEventListener('pointerdown', (event) => { pressed = [event.clientX, event.clientY]; });
    canvas.addEventListener('pointerup', (event) => {
      const moved = pressed && Math.hypot(event.clientX - pressed[0], event.clientY - pressed[1]);
      if (event.button === 0 && moved !== null && moved <= MOST_MOVED) this.pick(event, picked);
    });
  }

  // colours: entry of the palette by face; 0 is the body, 1 what is picked, then sets.
  colour(colours) {
    const values = new Float32Array(3 * this.faces.length);
    this.faces.forEach((face, t) => values.fill((colours.get(face) ?? 0) + 0.5, 3 * t, 3 * t + 3));
    this.show(this.none, values, this.size, 0);
  }

  pick(event, picked) {
    const { left, top, width, height } = this.renderer.domElement.getBoundingClientRect();
    const at = new THREE.Vector2(2 * (event.clientX - left) / width - 1, 1 - 2 * (event.clientY - top) / height);
    const ray = new THREE.Raycaster();
    ray.setFromCamera(at, this.camera);
    const [hit] = ray.intersectObject(this.surface);
    if (hit) picked({ face: this.faces[hit.faceIndex], point: hit.point.toArray() }, event);
  }

  // Points (metres) with a colour each, as small balls.
  mark(points) {
    this.markers.clear();
    const radius = 0.012 * this.rest.geometry.boundingSphere.radius;
    for (const { point, colour } of points) {
      const ball = new THREE.Mesh(new THREE.SphereGeometry(radius, 16, 12), new THREE.MeshBasicMaterial({ color: colour }));
      ball.position.fromArray(point);
      this.markers.add(ball);
    }
    this.draw();
  }

  // Where a point (metres) is drawn, in page pixels.
  onPage(point) {
    const { left, top, width, height } = this.renderer.domElement.getBoundingClientRect();
    const at = new THREE.Vector3(...point).project(this.camera);
    return [left + width * (at.x + 1) / 2, top + height * (1 - at.y) / 2];
  }
}
