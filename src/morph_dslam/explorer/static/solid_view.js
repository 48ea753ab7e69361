// The deformed surface, turned with the mouse. Colours come from a texture that holds the colour map and is
// looked up by value, so that they are interpolated as values, not as colours, between nodes.

import * as THREE from 'three';
import { OrbitControls } from './three/OrbitControls.js';

const VIEWED_FROM = new THREE.Vector3(-0.45, -0.9, 0.75).normalize();
const FIELD_OF_VIEW = 30;

// The colours, and above them the grey of nodes whose value is not a number.
function colourTexture(colours) {
  const grey = colours.map(() => [128, 128, 128, 255]);
  const texture = new THREE.DataTexture(new Uint8Array([...colours, ...grey].flat()), colours.length, 2);
  texture.colorSpace = THREE.SRGBColorSpace;
  texture.minFilter = texture.magFilter = THREE.LinearFilter;
  texture.needsUpdate = true;
  return texture;
}

export class SolidView {
  // nodes: Float32Array (3 n), metres; triangles: Uint32Array (3 m); reach: the largest displacement, metres.
  constructor(container, nodes, triangles, colours, reach) {
    this.container = container;
    this.nodes = nodes;
    this.geometry = new THREE.BufferGeometry();
    this.geometry.setIndex(new THREE.BufferAttribute(triangles, 1));
    this.geometry.setAttribute('position', new THREE.BufferAttribute(nodes.slice(), 3));
    this.geometry.setAttribute('uv', new THREE.BufferAttribute(new Float32Array(2 * nodes.length / 3), 2));
    // Flat shading takes its normals from the deformed triangles.
    const material = new THREE.MeshLambertMaterial({
      map: colourTexture(colours), side: THREE.DoubleSide, flatShading: true,
    });
    this.surface = new THREE.Mesh(this.geometry, material);
    this.surface.frustumCulled = false; // its bounding sphere is that of another state
    this.rest = this.restShape(nodes, triangles);
    this.scene = new THREE.Scene();
    this.scene.add(this.surface, this.rest, new THREE.AmbientLight(0xffffff, 0.6 * Math.PI));
    this.renderer = new THREE.WebGLRenderer({ antialias: true });
    this.renderer.setClearColor(0x5a646f);
    container.append(this.renderer.domElement);
    this.placeCamera(reach);
    this.resized = new ResizeObserver(() => this.resize());
    this.resized.observe(container);
    this.resize();
  }

  restShape(nodes, triangles) {
    const geometry = new THREE.BufferGeometry();
    geometry.setIndex(new THREE.BufferAttribute(triangles, 1));
    geometry.setAttribute('position', new THREE.BufferAttribute(nodes, 3));
    const material = new THREE.MeshBasicMaterial({
      color: 0xc8d0d8, wireframe: true, transparent: true, opacity: 0.18,
    });
    const mesh = new THREE.Mesh(geometry, material);
    mesh.visible = false;
    return mesh;
  }

  placeCamera(reach) {
    this.rest.geometry.computeBoundingSphere();
    const { center, radius } = this.rest.geometry.boundingSphere;
    const { clientWidth: width, clientHeight: height } = this.container;
    const narrow = Math.min(1, width / Math.max(height, 1)); // the field of view is that of the height
    const half = Math.atan(narrow * Math.tan(THREE.MathUtils.degToRad(FIELD_OF_VIEW / 2)));
    const distance = (radius + 0.7 * reach) / Math.sin(half);
    this.camera = new THREE.PerspectiveCamera(FIELD_OF_VIEW, 1, distance / 100, distance * 100);
    this.camera.up.set(0, 0, 1);
    this.camera.position.copy(center).addScaledVector(VIEWED_FROM, distance);
    const light = new THREE.DirectionalLight(0xffffff, 0.4 * Math.PI);
    light.position.set(-0.3, 0.5, 1); // over the viewer's left shoulder
    this.camera.add(light, light.target);
    this.scene.add(this.camera);
    this.controls = new OrbitControls(this.camera, this.renderer.domElement);
    this.controls.target.copy(center);
    this.controls.update();
    this.controls.addEventListener('change', () => this.draw());
  }

  // displacement: Float32Array (3 n), metres; values: Float32Array (n); top: the value of the last colour.
  show(displacement, values, top, scale) {
    const { position, uv } = this.geometry.attributes;
    for (let i = 0; i < displacement.length; i++) position.array[i] = this.nodes[i] + scale * displacement[i];
    for (let i = 0; i < values.length; i++) {
      uv.array[2 * i] = Math.min(Math.max((values[i] || 0) / top, 0), 1);
      uv.array[2 * i + 1] = Number.isNaN(values[i]) ? 0.75 : 0.25;
    }
    position.needsUpdate = uv.needsUpdate = true;
    this.draw();
  }

  showRest(visible) {
    this.rest.visible = visible;
    this.draw();
  }

  resize() {
    const { clientWidth: width, clientHeight: height } = this.container;
    this.renderer.setPixelRatio(window.devicePixelRatio);
    this.renderer.setSize(width, height);
    this.camera.aspect = width / Math.max(height, 1);
    this.camera.updateProjectionMatrix();
    this.draw();
  }

  // Take it off the page.
  dispose() {
    this.resized.disconnect();
    this.controls.dispose();
    this.geometry.dispose();
    this.renderer.dispose();
    this.renderer.domElement.remove();
  }

  draw() {
    this.renderer.render(this.scene, this.camera);
  }
}
