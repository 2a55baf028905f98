// The eye: orbiting and walking by mouse, touch and keys, flights, and the space where it may be.
import { OrbitControls, PerspectiveCamera, Vector3 } from "./library.js";
import { isFree } from "./space.js";

const FLIGHT = 1200, WIDEST = 110, ROOM = 8; // milliseconds, degrees of a lens, pixels between a landmark and buttons
const STANDS = 1e-4; // share of the distance to the target within which an eye only turns: links have five digits
const TURN = 0.1, TAP = 0.1, NEARER = 0.1, PACE = 0.25; // radians, seconds and share of the distance of a key press; share of the overview's depth walked in a second
const LOOK = 0.003, WHEEL = 0.001, STEEPEST = 1.5; // radians per pixel, seconds per unit of the wheel, radians
const WAYS = { w: [0, 0, 1], s: [0, 0, -1], a: [-1, 0, 0], d: [1, 0, 0], q: [0, -1, 0], e: [0, 1, 0] }; // right, up, ahead
export const still = matchMedia("(prefers-reduced-motion: reduce)");

/** Name a key: letters in lower case, and those of other scripts by their place. Some events of browsers have no key. */
export function keyName({ key = "", code }) {
  const letter = key.length === 1 && !/[ -~]/.test(key) ? /^Key([A-Z])$/.exec(code)?.[1] : null;
  return key.length === 1 ? (letter ?? key).toLowerCase() : key;
}

/** Read a viewpoint's text, the opposite of `Mover.address`; null if it is none. */
function standOf(text) {
  const numbers = text.split(",").map(Number);
  if (numbers.length !== 7 || !numbers.every(Number.isFinite) || !(numbers[6] > 1 && numbers[6] < 170)) return null;
  const [position, target] = [0, 3].map((k) => new Vector3(...numbers.slice(k, k + 3)));
  return position.distanceTo(target) > 0 ? { position, target, fov: numbers[6] } : null;
}

export class Mover extends EventTarget {
  /** Steer a camera. about: the page's description; canvas, frame: what is dragged, and what takes keys. wake: asks
   * for a new frame. Fires `walks` when the way of moving changes, `blocked` where the eye may not go, and `far`
   * before a flight. */
  constructor(about, canvas, frame, wake) {
    super();
    Object.assign(this, { about, canvas, frame, wake, walking: false, free: false, space: null, flight: null, held: new Map(), fingers: new Map() });
    const start = this.standing(about.start), distance = start.position.distanceTo(start.target);
    this.pace = PACE * (about.extent?.[4] ?? distance);
    this.camera = new PerspectiveCamera(50, 1, 1e-3 * distance, 1e3 * distance);
    this.camera.up.fromArray(about.up);
    this.controls = new OrbitControls(this.camera, canvas);
    this.controls.enableDamping = false;
    this.controls.addEventListener("change", () => this.orbited());
    this.controls.addEventListener("start", () => this.dispatchEvent(new Event("grab")));
    this.controls.addEventListener("end", () => this.dispatchEvent(new Event("release")));
    this.place(this.overviewStand());
    this.listen();
  }

  // ── places ──

  get stand() {
    return { position: this.camera.position.clone(), target: this.controls.target.clone(), fov: this.camera.fov };
  }

  /** Stand somewhere. whole: whether the stand is the overview of this window. */
  place({ position, target, fov, whole = false }) {
    this.placing = true;
    this.camera.position.copy(position);
    this.controls.target.copy(target);
    this.camera.fov = fov;
    this.camera.updateProjectionMatrix();
    this.controls.update();
    Object.assign(this, { placing: false, last: this.stand, whole });
    this.wake();
  }

  /** The viewpoint as text, seven numbers: position, orbit center, field of view. */
  get address() {
    const { position, target, fov } = this.stand;
    return [...position.toArray(), ...target.toArray(), fov].map((value) => +value.toPrecision(5)).join();
  }

  /** Go to a viewpoint that is written as `address` is, at once or in a flight. shape: width over height of the window
   * that it was seen in; a narrower one shows as much to both sides. Returns whether the text is a viewpoint. */
  goTo(text = "", flying = false, shape = 0) {
    const stand = standOf(text);
    if (!stand) return false;
    const widened = (360 / Math.PI) * Math.atan(Math.tan((stand.fov * Math.PI) / 360) * Math.max(shape / this.aspect, 1));
    stand.fov = Math.min(widened, Math.max(WIDEST, stand.fov));
    flying ? this.fly(stand) : this.jump(stand);
    return true;
  }

  /** Stand somewhere at once, without a flight. */
  jump(stand) {
    this.flight = null;
    this.place(stand);
  }

  get aspect() {
    return this.frame.clientWidth / Math.max(this.frame.clientHeight, 1);
  }

  /** Compute the viewpoint of a photo whose whole picture the window shows (up to a widest lens). target: point to
   * orbit, moved onto the photo's axis; the scene's center by default. */
  standing({ pose, fx, fy, cx, cy, width, height }, target = this.about.center) {
    const [position, ahead] = [3, 2].map((k) => new Vector3(...pose.slice(0, 3).map((row) => (k === 3 ? row[3] : -row[2]))));
    const distance = Math.max(new Vector3(...target).sub(position).dot(ahead), 0.05);
    const high = Math.max(cy, height - cy) / fy, wide = Math.max(cx, width - cx) / fx;
    const fov = (360 / Math.PI) * Math.atan(Math.max(high, wide / this.aspect));
    return { position, target: position.clone().addScaledVector(ahead, distance), fov: Math.min(fov, Math.max(WIDEST, (360 / Math.PI) * Math.atan(high))) };
  }

  /** Compute the viewpoint that shows the whole landmark in what buttons and photos leave free of this window: from the
   * overview's photo, with a wider lens. Farther back the eye would stand among what no photo shows from behind. */
  overviewStand() {
    const start = this.standing(this.about.start), [left, top, right, bottom, depth] = this.about.extent ?? [0, 0, 0, 0, 0];
    if (!depth) return start;
    const rows = this.about.start.pose.slice(0, 3), axis = (k) => new Vector3(...rows.map((row) => row[k]));
    const middle = (low, high) => (Math.atan(low) + Math.atan(high)) / 2, half = (low, high) => Math.tan((Math.atan(high) - Math.atan(low)) / 2);
    const { clientHeight: height } = this.frame, [above, below] = this.covered.map((side) => side + ROOM), clear = Math.max(height - above - below, height / 2);
    const slope = Math.min(Math.max((half(top, bottom) * height) / clear, half(left, right) / this.aspect), Math.tan((WIDEST * Math.PI) / 360));
    const lift = Math.atan((slope * (above - below)) / height); // how far above the axis the middle of what is free lies
    const ahead = axis(2).negate().addScaledVector(axis(0), Math.tan(middle(left, right))).addScaledVector(axis(1), -Math.tan(middle(top, bottom) - lift)).normalize();
    return { position: start.position, target: start.position.clone().addScaledVector(ahead, depth), fov: (360 / Math.PI) * Math.atan(slope), whole: true };
  }

  /** Pixels that buttons cover at the top of the frame, and photos at its bottom. */
  get covered() {
    const [tools, strip] = ["tools", "strip"].map((id) => document.getElementById(id));
    return [tools.offsetTop + tools.offsetHeight, strip.offsetHeight];
  }

  // ── flights ──

  /** Fly to a viewpoint, around its target rather than through it. */
  fly(stand) {
    this.walk(false);
    this.dispatchEvent(new Event("far"));
    this.flight = { from: this.stand, to: stand, start: performance.now() };
    this.wake();
  }

  overview() {
    this.fly(this.overviewStand());
  }

  /** Show the whole landmark again in a window of another shape, if it is shown. */
  refit() {
    if (this.whole) this.place(this.overviewStand());
  }

  /** Turn to a point of the world, and orbit around it from now on. */
  focus(point) {
    this.fly({ ...this.stand, target: new Vector3(...point) });
  }

  advance(now) {
    const { from, to, start } = this.flight, time = still.matches ? 1 : Math.min((now - start) / FLIGHT, 1);
    const eased = time * time * (3 - 2 * time), target = from.target.clone().lerp(to.target, eased);
    if (time === 1) this.flight = null;
    if (time === 1) return this.place(to);
    const fov = from.fov + (to.fov - from.fov) * eased;
    const [here, there] = [from, to].map((stand) => stand.position.clone().sub(stand.target));
    if (from.position.distanceTo(to.position) < STANDS * here.length()) return this.place({ position: from.position, target, fov });
    const distance = here.length() ** (1 - eased) * there.length() ** eased;
    const offset = here.normalize().lerp(there.normalize(), eased).normalize().multiplyScalar(distance);
    this.place({ position: target.clone().add(offset), target, fov });
  }

  // ── limits ──

  /** Whether photos show that a point is free: near where they were taken, and not within walls. */
  open(point) {
    return isFree(this.space, point.toArray().map((value, axis) => value - this.about.center[axis]));
  }

  /** Return how far the eye comes: to its aim, along one of the axes only, or nowhere. Whoever stands outside of the
   * free space may go anywhere. */
  reached(from, to, free = this.free) {
    if (free || !this.space || !this.open(from)) return to;
    const way = to.clone().sub(from), up = this.camera.up, rise = up.clone().multiplyScalar(way.dot(up));
    const parts = [way, way.clone().sub(rise), rise].filter((part) => part.length() > 0.2 * way.length());
    const clear = (part) => [0.25, 0.5, 0.75, 1].every((share) => this.open(from.clone().addScaledVector(part, share)));
    const part = parts.find(clear);
    if (part !== way) this.dispatchEvent(new Event("blocked"));
    return part ? from.clone().add(part) : from;
  }

  /** Keep what the orbiting controls did within the limits. */
  orbited() {
    if (this.placing) return;
    this.flight = null;
    const { position } = this.camera, { last } = this;
    if (this.reached(last.position, position, this.free || this.shift) !== position) this.place(last);
    Object.assign(this, { last: this.stand, whole: false });
    this.wake();
  }

  // ── walking ──

  /** Walk (drags look around), or orbit (drags turn around a point). */
  walk(walking = !this.walking) {
    if (walking === this.walking) return;
    Object.assign(this, { walking });
    this.controls.enabled = !walking;
    this.dispatchEvent(new Event("walks"));
  }

  /** Look aside and up, radians. */
  look(aside, up) {
    const { position, target, fov } = this.stand, ahead = target.clone().sub(position), axis = this.camera.up;
    const height = Math.PI / 2 - ahead.angleTo(axis), rise = Math.max(-STEEPEST, Math.min(height + up, STEEPEST)) - height;
    ahead.applyAxisAngle(ahead.clone().cross(axis).normalize(), rise).applyAxisAngle(axis, -aside);
    this.jump({ position, target: position.clone().add(ahead), fov });
  }

  /** Go some way to the right, up and ahead, in seconds of walking; level on the ground unless `diving`. */
  go([right, up, ahead], seconds, diving = false) {
    const { position, target, fov } = this.stand, axis = this.camera.up, view = target.clone().sub(position).normalize();
    const side = view.clone().cross(axis).normalize(), level = diving ? view : axis.clone().cross(side).normalize();
    const way = side.multiplyScalar(right).addScaledVector(axis, up).addScaledVector(level, ahead).multiplyScalar(this.pace * seconds);
    const place = this.reached(position, position.clone().add(way), this.free || this.shift);
    this.jump({ position: place, target: target.add(place).sub(position), fov });
  }

  /** Whether the eye flies, or keys that move it are held. */
  get moving() {
    return Boolean(this.flight) || this.held.size > 0;
  }

  /** Go on with what keys are held. Called before each frame. */
  update(now) {
    if (this.flight) this.advance(now);
    const seconds = Math.min((now - (this.before ?? now)) / 1000, 0.3);
    this.before = this.held.size ? now : undefined;
    for (const way of this.held.values()) if (seconds > 0) this.go(way, seconds);
    if (this.controls.enabled) this.controls.update();
    if (this.held.size) this.wake();
  }

  /** Steer by a key; returns whether it has a meaning. */
  steer(event) {
    const name = keyName(event), { repeat } = event, way = WAYS[name];
    const turn = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] }[name];
    const zoom = { "+": 1, "=": 1, "-": -1 }[name];
    if (name === "Home") this.overview();
    else if (way) this.stride(name, way, repeat);
    else if (turn && this.walking) turn[0] ? this.look(TURN * turn[0], 0) : this.stride(name, [0, 0, turn[1]], repeat);
    else if (turn) this.circle(TURN * turn[0], TURN * turn[1]);
    else if (zoom && this.walking) this.go([0, 0, zoom], 2 * TAP, true);
    else if (zoom) this.moveTo(this.stand.position.lerp(this.stand.target, zoom * NEARER));
    else return false;
    return true;
  }

  stride(name, way, repeat) {
    this.walk(true);
    if (repeat && this.held.has(name)) return;
    this.go(way, TAP);
    this.held.set(name, way);
  }

  /** Orbit by angles (radians). */
  circle(aside, up) {
    const { position, target } = this.stand, offset = position.clone().sub(target), axis = this.camera.up;
    const turned = offset.clone().applyAxisAngle(axis.clone().cross(offset).normalize(), -up);
    if (turned.angleTo(axis) > 0.05 && turned.angleTo(axis) < 3.09) offset.copy(turned);
    this.moveTo(target.clone().add(offset.applyAxisAngle(axis, aside)));
  }

  moveTo(aim) {
    const { position, target, fov } = this.stand, place = this.reached(position, aim, this.free || this.shift);
    this.jump({ position: place === aim ? aim : position, target, fov });
  }

  // ── pointers and keys ──

  listen() {
    const { canvas, frame, fingers } = this;
    canvas.addEventListener("pointerdown", ({ pointerId, clientX, clientY }) => {
      if (!this.walking) return;
      fingers.set(pointerId, [clientX, clientY]);
      canvas.setPointerCapture(pointerId);
    });
    canvas.addEventListener("pointermove", (event) => fingers.has(event.pointerId) && this.dragged(event));
    for (const kind of ["pointerup", "pointercancel"]) canvas.addEventListener(kind, ({ pointerId }) => fingers.delete(pointerId));
    canvas.addEventListener("wheel", (event) => {
      if (!this.walking) return;
      event.preventDefault();
      this.go([0, 0, -event.deltaY], WHEEL, true);
    }, { passive: false }); // prettier-ignore
    for (const kind of ["keydown", "keyup", "pointerdown", "pointermove"]) addEventListener(kind, ({ shiftKey }) => (this.shift = shiftKey), true);
    frame.addEventListener("keydown", (event) => {
      if (event.ctrlKey || event.metaKey || event.altKey || event.target.matches("input")) return; // a shortcut of the browser
      if (this.steer(event)) event.preventDefault();
    });
    addEventListener("keyup", (event) => this.held.delete(keyName(event)));
    addEventListener("blur", () => this.held.clear());
    frame.addEventListener("focusout", () => this.held.clear());
  }

  /** Look with one finger or the mouse; go with two: their middle moves aside and ahead, spreading goes ahead. */
  dragged({ pointerId, clientX, clientY }) {
    const { fingers } = this, [x, y] = fingers.get(pointerId), others = [...fingers].filter(([id]) => id !== pointerId);
    const apart = (place) => Math.hypot(place[0] - others[0][1][0], place[1] - others[0][1][1]);
    fingers.set(pointerId, [clientX, clientY]);
    if (!others.length) return this.look(-LOOK * (clientX - x), LOOK * (clientY - y));
    const spread = apart([clientX, clientY]) - apart([x, y]);
    this.go([(x - clientX) / 2, 0, spread + (y - clientY) / 2], 0.01);
  }
}
