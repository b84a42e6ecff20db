// What is drawn beside the skin: dots and lines for joints, a small box with axes for an object.

import { THREE } from "./three.js";
import { CHAINS } from "./hand_mesh.js";

const DOT_M = 0.0028, BOX_M = 0.03;
const through = { depthTest: false, transparent: true }; // seen through the skin

/** Dots and bones of one hand; `group` is to be put into that of the hand. */
export class JointMarks {
  /** `count`: how many joints. */
  constructor(count) {
    this.group = new THREE.Group();
    const ball = new THREE.SphereGeometry(DOT_M, 12, 8);
    this._dots = Array.from({ length: count }, () => new THREE.Mesh(ball, new THREE.MeshBasicMaterial(through)));
    const lines = new THREE.BufferGeometry();
    lines.setAttribute("position", new THREE.BufferAttribute(new Float32Array(3 * count), 3));
    lines.setIndex(CHAINS.flatMap((chain) => chain.slice(1).flatMap((j, k) => [chain[k], j])));
    this._lines = new THREE.LineSegments(lines, new THREE.LineBasicMaterial({ ...through, opacity: 0.7 }));
    this._lines.frustumCulled = false; // its box is that of the first pose
    this.group.add(this._lines, ...this._dots);
    this.group.children.forEach((mark, order) => (mark.renderOrder = 2 + order));
  }

  /** Put them where the bones are. */
  place(bones) {
    const places = this._lines.geometry.attributes.position;
    bones.forEach(({ position }, j) => {
      this._dots[j].position.copy(position);
      places.setXYZ(j, position.x, position.y, position.z);
    });
    places.needsUpdate = true;
  }

  /** Colour the lines, and each dot. */
  paint(line, dots) {
    this._lines.material.color.set(line);
    this._dots.forEach((dot, j) => dot.material.color.set(dots[j]));
  }
}

/** Where an object is and how it is turned. Its shape is not told, so it is a box of 3 cm with three axes. */
export class ObjectMark {
  constructor() {
    this.group = new THREE.Group();
    this._box = new THREE.Mesh(
      new THREE.BoxGeometry(BOX_M, BOX_M, BOX_M),
      new THREE.MeshStandardMaterial({ transparent: true }),
    );
    this.group.add(this._box, new THREE.AxesHelper(1.7 * BOX_M));
  }

  /** Show a message of `object_json`; one without a place hides it. */
  show({ position, orientation }, colour, opacity) {
    this.group.visible = Boolean(position && orientation);
    if (!this.group.visible) return;
    this.group.position.fromArray(position);
    this.group.quaternion.fromArray(orientation);
    this._box.material.color.set(colour);
    this._box.material.opacity = opacity;
  }
}
