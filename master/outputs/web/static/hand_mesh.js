// A rigged hand: 25 bones, one per WebXR joint, and a skin that follows them.
//
// The skin is made once for a hand, of its own bone lengths and radii, in a bind pose with straight, spread fingers, and
// then each bone is simply put where the pose says that the joint is.

import { THREE } from "./three.js";
import { coneDistance, handSolid, surfaceOf } from "./hand_shape.js";

export const WRIST = 0;
export const CHAINS = [[0, 1, 2, 3, 4], [0, 5, 6, 7, 8, 9], [0, 10, 11, 12, 13, 14], [0, 15, 16, 17, 18, 19], [0, 20, 21, 22, 23, 24]];
const SPREAD_DEG = { 6: 8, 11: 0, 16: -8, 21: -17 }; // of the fingers at their knuckles in the bind pose
const THUMB_WAY = [-0.6, -0.36, -0.71]; // of a right thumb
const SOFT_M = 0.0022; // how far around a joint the skin follows both bones
const WIDE = new Set([0, 1, 5]), WIDE_M = 0.008; // the ball of the thumb stretches from its bone to the palm
const TIPS = new Set([4, 9, 14, 19, 24]);

/** Whether positions and orientations of all joints are there to make a hand of. */
export const complete = (joints) => joints.length === 25 && joints.every((j) => j.position && j.orientation && j.radius > 0);

/** Bone lengths [m] by which a hand is known again: a hand that was calibrated anew has others. */
export function boneLengths(joints) {
  return CHAINS.flatMap((chain) => chain.slice(1).map((j, k) => distance(joints[chain[k]].position, joints[j].position)));
}

const distance = (a, b) => Math.hypot(a[0] - b[0], a[1] - b[1], a[2] - b[2]);

/** +1 for a right hand, -1 for a left one: said by the message, or seen from where its knuckles are. */
function sideOf(side, relative) {
  if (side === "right" || side === "left") return side === "right" ? 1 : -1;
  return relative[6].p.x < relative[21].p.x ? 1 : -1;
}

/** The bind pose of a complete message: {p, q} per joint in the frame of the wrist, and the side. */
function bindPose(message) {
  const world = message.joints.map((j) => ({
    p: new THREE.Vector3(...j.position),
    q: new THREE.Quaternion(...j.orientation),
  }));
  const back = world[WRIST].q.clone().invert();
  const relative = world.map(({ p, q }) => ({
    p: p.clone().sub(world[WRIST].p).applyQuaternion(back),
    q: back.clone().multiply(q),
  }));
  const side = sideOf(message.side, relative);
  const bind = relative.map(({ p, q }) => ({ p: p.clone(), q: q.clone() }));
  // The next joint, in the frame of each one: this never changes.
  const bone = (j) => world[j + 1].p.clone().sub(world[j].p).applyQuaternion(world[j].q.clone().invert());
  for (const chain of CHAINS) {
    const first = chain[1] === 1 ? 1 : chain[2];
    bind[first].q = first === 1 ? thumbTurn(relative[1].q, bone(1), side) : knuckleTurn(first, side);
    for (let j = first; j < chain.at(-1); j++) {
      bind[j + 1].p = bone(j).applyQuaternion(bind[j].q).add(bind[j].p);
      bind[j + 1].q = bind[j].q.clone();
    }
  }
  return { bind, side };
}

/** A finger's first bone points forwards and a little aside, its back up. */
function knuckleTurn(joint, side) {
  const angle = THREE.MathUtils.degToRad(side * SPREAD_DEG[joint]);
  return new THREE.Quaternion().setFromAxisAngle(new THREE.Vector3(0, 1, 0), angle);
}

/** The thumb as it is, turned the shortest way so that its bone points where it does in the bind pose. */
function thumbTurn(q, bone, side) {
  const now = bone.clone().applyQuaternion(q).normalize();
  const way = new THREE.Vector3(side * THUMB_WAY[0], THUMB_WAY[1], THUMB_WAY[2]).normalize();
  return new THREE.Quaternion().setFromUnitVectors(now, way).multiply(q);
}

/** Segments that pull at the skin: [joint that moves it, from, to]. The palm's bones all move with the wrist. */
const PULLS = CHAINS.flatMap((chain) =>
  chain.slice(0, -1).map((j, k) => [j, chain[k], chain[k + 1]]).filter(([j]) => !(j === WRIST && chain[1] !== 1)),
);

/** The four bones that move a vertex, and how much each. */
function pulls(p, at, radius) {
  const found = PULLS.map(([joint, a, b]) => [joint, coneDistance(p, at[a], at[b], radius[a], radius[b])]);
  const least = Math.min(...found.map(([, d]) => d));
  const nearest = found.find(([, d]) => d === least)[0];
  const soft = (joint) => (WIDE.has(joint) && WIDE.has(nearest) ? WIDE_M : SOFT_M);
  const weights = found.map(([joint, d]) => [joint, Math.exp(-(((d - least) / soft(joint)) ** 2))]);
  weights.sort((a, b) => b[1] - a[1]);
  const four = weights.slice(0, 4).map(([j, w]) => [j, w < 0.02 ? 0 : w]);
  const sum = four.reduce((s, [, w]) => s + w, 0);
  return four.map(([j, w]) => [j, w / sum]);
}

/** How much a vertex is nail, 0...1: on the back of a fingertip. */
function nail(p, bind, radius) {
  for (const tip of TIPS) {
    const { p: at, q } = bind[tip];
    const local = new THREE.Vector3(...p).sub(at).applyQuaternion(q.clone().invert()).divideScalar(radius[tip]);
    const across = (local.x / 0.72) ** 2 + ((local.z - 0.05) / 0.95) ** 2;
    if (local.y > 0 && across < 1) return Math.min(1, (1 - across) * 2.2) * Math.min(1, local.y * 2);
  }
  return 0;
}

/** A skin and its skeleton; holds the geometry, its weights and its colours. */
export class RiggedHand {
  /** `message`: a complete one. */
  constructor(message) {
    const { bind, side } = bindPose(message);
    const at = bind.map(({ p }) => p.toArray());
    const radius = message.joints.map((j) => j.radius);
    this.lengths = boneLengths(message.joints);
    this.bones = message.joints.map((j) => Object.assign(new THREE.Bone(), { name: j.name }));
    this.group = new THREE.Group();
    this.group.add(...this.bones);
    this.geometry = this._geometry(bind, at, radius, side);
    const inverses = bind.map(({ p, q }) => new THREE.Matrix4().compose(p, q, new THREE.Vector3(1, 1, 1)).invert());
    this.skeleton = new THREE.Skeleton(this.bones, inverses);
    this.material = new THREE.MeshPhysicalMaterial({ vertexColors: true, roughness: 0.62, sheen: 0.35, sheenRoughness: 0.6 });
    // Where the skin is translucent, what lies behind its own front is not to shine through.
    const depthOnly = new THREE.MeshBasicMaterial({ colorWrite: false });
    for (const [material, order] of [[depthOnly, 0], [this.material, 1]]) {
      const mesh = new THREE.SkinnedMesh(this.geometry, material);
      mesh.bind(this.skeleton, new THREE.Matrix4());
      mesh.frustumCulled = false; // its box is that of the bind pose
      mesh.renderOrder = order;
      this.group.add(mesh);
    }
    this.pose(message.joints);
  }

  _geometry(bind, at, radius, side) {
    const room = 0.03, low = [0, 0, 0], high = [0, 0, 0];
    for (const p of at) {
      for (let i = 0; i < 3; i++) {
        low[i] = Math.min(low[i], p[i] - room);
        high[i] = Math.max(high[i], p[i] + room);
      }
    }
    high[2] += 0.045; // the piece of the forearm
    const { positions, normals, triangles } = surfaceOf(handSolid(at, radius, side), low, high);
    const count = positions.length / 3, indices = new Uint16Array(4 * count), weights = new Float32Array(4 * count);
    this.nails = new Float32Array(count);
    for (let v = 0; v < count; v++) {
      const p = positions.slice(3 * v, 3 * v + 3);
      pulls(p, at, radius).forEach(([joint, weight], k) => {
        indices[4 * v + k] = joint;
        weights[4 * v + k] = weight;
      });
      this.nails[v] = nail(p, bind, radius);
    }
    const geometry = new THREE.BufferGeometry();
    geometry.setIndex(triangles);
    geometry.setAttribute("position", new THREE.Float32BufferAttribute(positions, 3));
    geometry.setAttribute("normal", new THREE.Float32BufferAttribute(normals, 3));
    geometry.setAttribute("skinIndex", new THREE.BufferAttribute(indices, 4));
    geometry.setAttribute("skinWeight", new THREE.BufferAttribute(weights, 4));
    geometry.setAttribute("color", new THREE.BufferAttribute(new Float32Array(4 * count).fill(1), 4));
    return geometry;
  }

  /** Put the bones where the joints are; a joint without a place keeps the one it had before the wrist. */
  pose(joints) {
    const wrist = this.bones[WRIST], before = new THREE.Matrix4().compose(wrist.position, wrist.quaternion, wrist.scale);
    joints.forEach(({ position, orientation }, j) => {
      if (position && orientation) {
        this.bones[j].position.fromArray(position);
        this.bones[j].quaternion.fromArray(orientation);
      }
    });
    wrist.updateMatrix();
    const moved = wrist.matrix.clone().multiply(before.invert());
    joints.forEach(({ position, orientation }, j) => {
      if (!(position && orientation) && j !== WRIST) this.bones[j].applyMatrix4(moved);
    });
  }

  /** Colour the skin: `colours[j]` = [r, g, b, alpha] (linear, 0...1) of each joint, blended as the skin is. */
  paint(colours) {
    const { skinIndex, skinWeight, color } = this.geometry.attributes;
    let least = 1;
    for (let v = 0; v < color.count; v++) {
      const mixed = [0, 0, 0, 0];
      for (let k = 0; k < 4; k++) {
        const colour = colours[skinIndex.array[4 * v + k]], weight = skinWeight.array[4 * v + k];
        for (let i = 0; i < 4; i++) mixed[i] += weight * colour[i];
      }
      for (let i = 0; i < 3; i++) mixed[i] += 0.35 * this.nails[v] * (1 - mixed[i]);
      color.array.set(mixed, 4 * v);
      least = Math.min(least, mixed[3]);
    }
    color.needsUpdate = true;
    const translucent = least < 0.99;
    if (this.material.transparent !== translucent) {
      this.material.transparent = translucent;
      this.material.needsUpdate = true;
    }
  }

  /** Give the memory of the graphics card back. */
  dispose() {
    this.group.traverse((thing) => thing.material?.dispose());
    this.geometry.dispose();
    this.skeleton.dispose();
    this.group.removeFromParent();
  }
}
