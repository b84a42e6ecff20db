// The hand in a page: `new HandView(container, options)`, then `push(json)` whenever a pose comes.
//
// How to embed it is in the docstring of the package (`master/outputs/web/__init__.py`). Shown is always the newest pose; nothing
// is drawn while nothing changes.

import { THREE, OrbitControls } from "./three.js";
import { JointMarks, ObjectMark } from "./hand_marks.js";
import { RiggedHand, boneLengths, complete } from "./hand_mesh.js";

const SILENT_MS = 2000; // a hand of which nothing is heard any longer is shown as a ghost
const REBUILD_M = 0.001; // a bone that differs by more is that of another hand
const TURN_RAD = Math.PI / 24, ZOOM = 1.15, NEAR_M = 0.08, FAR_M = 3, REACH_M = 0.22;
const HELP = "Arrow keys turn, plus and minus zoom, 0 centres.";

export const THEMES = {
  light: { background: "#f4f6f8", tracked: "#8fb4d2", held: "#e69f00", invalid: "#8a8f98", grid: "#c3cad2", line: "#1d2733" },
  dark: { background: "#14181d", tracked: "#9cc3e2", held: "#e69f00", invalid: "#868c96", grid: "#333b45", line: "#f2f5f8" },
};
const OPACITY = { tracked: 1, held: 0.8, invalid: 0.3 };

/** What is known of a joint: tracked (observed now), held (inferred, may be used) or invalid. */
export const stateOf = (joint) => (!joint.valid ? "invalid" : joint.tracked ? "tracked" : "held");

/** A 3D view of hands and objects in an element of the page. */
export class HandView {
  /**
   * `container`: an element with a size. Options: `theme` "light", "dark" or "auto" (as the system has it),
   * `label` (what it is, for a screen reader), `grid` (a floor, default true), `joints` (dots and bones, default false).
   */
  constructor(container, { theme = "auto", label = "3D view of the hands", grid = true, joints = false } = {}) {
    this.container = container;
    this.hands = new Map();
    this.objects = new Map();
    this._label = label;
    this._joints = joints;
    this._stop = new AbortController();
    this._scene(grid);
    this._canvas();
    this._system = matchMedia("(prefers-color-scheme: dark)");
    this._system.addEventListener("change", () => this.setTheme(this._theme), { signal: this._stop.signal });
    this.setTheme(theme);
    this._resizes = new ResizeObserver(() => this.resize());
    this._resizes.observe(container);
    this.resize();
    this.resetCamera();
  }

  /** Show a hand or an object: what `webxr_json` or `object_json` returned, as text or parsed. Others are ignored. */
  push(json) {
    const message = typeof json === "string" ? JSON.parse(json) : json;
    if (message.type === "hand") this._pushHand(message);
    else if (message.type === "object") this._pushObject(message);
    else return;
    this._draw();
  }

  /** Forget all hands and objects. */
  clear() {
    for (const name of [...this.hands.keys()]) this._removeHand(name);
    for (const { group } of this.objects.values()) removeTree(group);
    this.objects.clear();
    this._draw();
  }

  /** "light", "dark" or "auto". */
  setTheme(theme) {
    this._theme = theme;
    const dark = theme === "dark" || (theme === "auto" && this._system.matches);
    this.colours = THEMES[dark ? "dark" : "light"];
    this.scene.background = new THREE.Color(this.colours.background);
    if (this.floor) this.floor.material.color.set(this.colours.grid);
    for (const hand of this.hands.values()) this._paint(hand, hand.states);
    this._draw();
  }

  /** Dots and lines of the joints through the skin: on or off. */
  setJoints(on) {
    this._joints = on;
    for (const hand of this.hands.values()) hand.marks.group.visible = on;
    this._draw();
  }

  /** Turn the view [rad]: to the right, and up. */
  orbit(right, up) {
    const from = this.camera.position.clone().sub(this.controls.target);
    const place = new THREE.Spherical().setFromVector3(from);
    place.theta += right;
    place.phi -= up;
    this._place(place.makeSafe());
  }

  /** Come nearer by a factor (below 1: go away). */
  zoom(factor) {
    const place = new THREE.Spherical().setFromVector3(this.camera.position.clone().sub(this.controls.target));
    place.radius = Math.min(FAR_M, Math.max(NEAR_M, place.radius / factor));
    this._place(place);
  }

  /** Look at all that is there, from where the reference camera looks and a little from above. */
  resetCamera() {
    const box = new THREE.Box3();
    const point = new THREE.Vector3();
    for (const { rig } of this.hands.values()) {
      rig.group.updateWorldMatrix(true, true);
      for (const bone of rig.bones) box.expandByPoint(bone.getWorldPosition(point));
      box.expandByPoint(rig.bones[0].localToWorld(point.set(0, 0, 0.05))); // the piece of the forearm
      box.expandByPoint(rig.bones[0].localToWorld(point.set(0, 0, -REACH_M))); // where stretched fingers will be
    }
    for (const { group } of this.objects.values()) box.expandByPoint(group.getWorldPosition(point));
    if (box.isEmpty()) box.setFromCenterAndSize(new THREE.Vector3(0, 0, -0.5), new THREE.Vector3(0.2, 0.2, 0.2));
    const sphere = box.getBoundingSphere(new THREE.Sphere());
    this.controls.target.copy(sphere.center);
    const half = THREE.MathUtils.degToRad(this.camera.fov / 2);
    const narrow = Math.min(half, Math.atan(Math.tan(half) * this.camera.aspect));
    const radius = Math.max(0.12, sphere.radius + 0.015) / Math.sin(narrow);
    if (this.floor) this.floor.position.set(sphere.center.x, box.min.y - 0.06, sphere.center.z);
    this._place(new THREE.Spherical(radius, 1.28, 0.3));
    this._moved = false;
  }

  /** Fit the size of the container; called by itself when that changes. */
  resize() {
    const width = Math.max(1, this.container.clientWidth), height = Math.max(1, this.container.clientHeight);
    this.renderer.setPixelRatio(Math.min(devicePixelRatio, 2));
    this.renderer.setSize(width, height);
    this.camera.aspect = width / height;
    this.camera.updateProjectionMatrix();
    if (!this._moved && this.hands.size) this.resetCamera();
    this._draw();
  }

  /** Where the bones of a hand are drawn: 25 × [x, y, z] [m] in the frame of the view (WebXR axes), or null. */
  bonePositions(name) {
    const hand = this.hands.get(name);
    if (!hand) return null;
    hand.rig.group.updateWorldMatrix(true, true);
    return hand.rig.bones.map((bone) => bone.getWorldPosition(new THREE.Vector3()).toArray());
  }

  /** Remove it from the page, with its timers, listeners and memory. */
  dispose() {
    this.clear();
    this._stop.abort();
    this._resizes.disconnect();
    cancelAnimationFrame(this._frame);
    this._frame = -1;
    this.controls.dispose();
    removeTree(this.scene);
    this.renderer.dispose();
    this.canvas.remove();
  }

  _scene(grid) {
    this.scene = new THREE.Scene();
    this.camera = new THREE.PerspectiveCamera(32, 1, 0.01, 20);
    this.scene.add(new THREE.HemisphereLight("#ffffff", "#8d95a0", 1.5), this.camera);
    // Lights go with the camera: a hand is lit from wherever it is looked at.
    for (const [x, y, strength] of [[-0.6, 0.9, 2.1], [0.9, 0.1, 0.7]]) {
      const lamp = new THREE.DirectionalLight("#ffffff", strength);
      lamp.position.set(x, y, 0.6);
      lamp.target.position.set(0, 0, -1);
      this.camera.add(lamp, lamp.target);
    }
    if (!grid) return;
    this.floor = new THREE.GridHelper(0.8, 16);
    this.floor.geometry.deleteAttribute("color");
    this.floor.material.dispose();
    this.floor.material = new THREE.LineBasicMaterial();
    this.scene.add(this.floor);
  }

  _canvas() {
    this.renderer = new THREE.WebGLRenderer({ antialias: true });
    const canvas = (this.canvas = this.renderer.domElement);
    canvas.style.display = "block";
    canvas.tabIndex = 0;
    canvas.setAttribute("role", "application");
    canvas.setAttribute("aria-roledescription", "3D view");
    this.container.append(canvas);
    this.controls = new OrbitControls(this.camera, canvas);
    Object.assign(this.controls, { minDistance: NEAR_M, maxDistance: FAR_M });
    this.controls.addEventListener("change", () => this._draw());
    this.controls.addEventListener("start", () => (this._moved = true));
    canvas.addEventListener("keydown", (event) => this._key(event), { signal: this._stop.signal });
    this._describe();
  }

  _key(event) {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    const ways = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] };
    const way = ways[event.key];
    if (way) this.orbit(way[0] * TURN_RAD, way[1] * TURN_RAD);
    else if (event.key === "+" || event.key === "=") this.zoom(ZOOM);
    else if (event.key === "-" || event.key === "_") this.zoom(1 / ZOOM);
    else if (event.key === "0" || event.key === "Home") this.resetCamera();
    else return;
    event.preventDefault();
  }

  _place(spherical) {
    this._moved = true;
    this.camera.position.setFromSpherical(spherical).add(this.controls.target);
    this.controls.update();
    this._draw();
  }

  _draw() {
    this._frame ??= requestAnimationFrame(() => {
      this._frame = undefined;
      this.renderer.render(this.scene, this.camera);
      for (const hand of this.hands.values()) if (hand.fresh) this._listen(hand);
    });
  }

  _pushHand(message) {
    const name = message.hand;
    let hand = this.hands.get(name);
    if (!hand || (complete(message.joints) && differs(hand.rig.lengths, boneLengths(message.joints)))) {
      if (!complete(message.joints)) return; // its bones are not known yet
      hand = this._newHand(name, message);
    }
    hand.rig.pose(message.joints);
    hand.rig.group.visible = message.joints.some((joint) => joint.position);
    this._paint(hand, message.joints.map(stateOf));
    hand.marks.place(hand.rig.bones);
    hand.fresh = true;
  }

  _newHand(name, message) {
    const first = !this.hands.has(name);
    this._removeHand(name);
    const rig = new RiggedHand(message);
    const marks = new JointMarks(rig.bones.length);
    marks.group.visible = this._joints;
    rig.group.add(marks.group);
    this.scene.add(rig.group);
    const hand = { name, rig, marks, side: message.side, states: [], painted: "" };
    this.hands.set(name, hand);
    if (first && !this._moved) this.resetCamera();
    return hand;
  }

  _removeHand(name) {
    const hand = this.hands.get(name);
    if (!hand) return;
    clearTimeout(hand.silence);
    removeTree(hand.marks.group);
    hand.rig.dispose();
    this.hands.delete(name);
    this._describe();
  }

  _paint(hand, states) {
    const wanted = `${this.colours.background} ${states}`;
    if (hand.painted === wanted) return;
    hand.painted = wanted;
    hand.states = states;
    const colour = Object.fromEntries(
      Object.keys(OPACITY).map((state) => [state, [...new THREE.Color(this.colours[state]).toArray(), OPACITY[state]]]),
    );
    hand.rig.paint(states.map((state) => colour[state]));
    hand.marks.paint(this.colours.line, states.map((state) => this.colours[state === "tracked" ? "line" : state]));
    this._describe();
  }

  /** Silence counts from what was drawn last: a page that draws slowly is no hand that is gone. */
  _listen(hand) {
    hand.fresh = false;
    clearTimeout(hand.silence);
    hand.silence = setTimeout(() => this._silent(hand), SILENT_MS);
  }

  _silent(hand) {
    this._paint(hand, hand.states.map(() => "invalid"));
    this._draw();
  }

  _pushObject(message) {
    let mark = this.objects.get(message.object);
    if (!mark) {
      this.objects.set(message.object, (mark = new ObjectMark()));
      this.scene.add(mark.group);
    }
    const state = message.tracked ? "tracked" : "held";
    mark.show(message, this.colours[state], OPACITY[state]);
  }

  /** Say to a screen reader what is shown; only when that changed. */
  _describe() {
    const said = [...this.hands.values()].map(({ name, side, states }) => {
      const count = (state) => states.filter((s) => s === state).length;
      return `${side ?? "unknown"} hand ${name}: ${count("tracked")} joints tracked, ${count("held")} held, ${count("invalid")} invalid`;
    });
    this.canvas.setAttribute("aria-label", `${this._label}. ${said.join("; ") || "No hand yet"}. ${HELP}`);
  }
}

const differs = (a, b) => a.some((length, k) => Math.abs(length - b[k]) > REBUILD_M);

function removeTree(root) {
  root.traverse((thing) => {
    thing.geometry?.dispose();
    thing.material?.dispose();
  });
  root.removeFromParent();
}
