// Photos: a strip of them, one over the rendering with a divider, and the cameras that took them.
import { $, element, say } from "./cards.js";

const LONG = 0.07; // length of a drawn camera, share of the overview's depth

export class Photos {
  /** about: the page's description; view: the picture; looks: called with a photo's name, to show its lighting. */
  constructor(about, view, light) {
    Object.assign(this, { about, view, light, list: about.cameras ?? [], shown: null, at: -1, buttons: new Map() });
    const pictured = this.list.filter(({ photo }) => photo);
    $("strip").hidden = !pictured.length;
    $("strip").append(...pictured.map((photo) => this.thumbnail(photo)));
    for (const name of ["before", "after", "cameras"]) $(name).disabled = !this.list.length;
    $("before").addEventListener("click", () => this.step(-1));
    $("after").addEventListener("click", () => this.step(1));
    $("divider").addEventListener("input", () => this.divide());
    $("away").addEventListener("click", () => this.hide());
    $("photo").addEventListener("error", () => this.shown && (say(`${this.shown.name} can't be shown: it is missing or damaged.`), this.hide()));
    $("photo").addEventListener("load", () => $("over").classList.add("there"));
    view.addEventListener("moved", () => this.follow());
  }

  thumbnail(photo) {
    const picture = element("img", { src: photo.photo, alt: "", loading: "lazy", decoding: "async" });
    const button = element("button", { ariaLabel: `Photo ${photo.name}`, title: photo.name, onclick: () => this.visit(photo), tabIndex: this.buttons.size ? -1 : 0 }, picture); // one stop of the tabulator; keys lead on
    this.buttons.set(photo, button);
    return button;
  }

  /** Fly to the previous or next photo. */
  step(by) {
    const count = this.list.length, from = this.at < 0 && by < 0 ? 0 : this.at;
    this.visit(this.list[(from + by + count) % count]);
  }

  /** Fly into a photo's pose, where it fades over the rendering if the page has it. */
  visit(photo) {
    this.hide(false);
    this.at = this.list.indexOf(photo);
    this.view.mover.fly(this.view.mover.standing(photo));
    this.coming = photo.photo ? photo : null;
    say(photo.doubtful ? `${photo.name}: its place is doubtful: ${photo.doubtful}.` : `Photo ${this.at + 1} of ${this.list.length}: ${photo.name}.`);
  }

  /** Show the photo that was flown to once it is reached, and hide it when the eye leaves. */
  follow() {
    const { mover } = this.view;
    if (this.coming && !mover.flight) this.show(this.coming);
    else if (this.shown && mover.address !== this.place) this.hide();
    if (this.shown) this.arrange();
    this.draw();
  }

  /** Lay a photo over the rendering, which stands at its pose. */
  show(photo) {
    Object.assign(this, { shown: photo, coming: null, place: this.view.mover.address, at: this.list.indexOf(photo) });
    $("over").classList.remove("there");
    $("photo").src = photo.photo;
    $("photo").alt = `Photo ${photo.name}`;
    $("divider").value = 50;
    $("over").hidden = false;
    this.buttons.get(photo)?.setAttribute("aria-current", "true");
    this.buttons.get(photo)?.scrollIntoView({ block: "nearest", inline: "nearest" });
    this.arrange();
    this.light(photo.name);
    this.changed?.(false);
  }

  /** Hide the photo. own: whether that is a step of its own, rather than part of a flight. */
  hide(own = true) {
    const { shown } = this;
    Object.assign(this, { shown: null, coming: null });
    $("over").hidden = true;
    if (!shown) return;
    this.buttons.get(shown)?.removeAttribute("aria-current");
    this.light(null);
    if (own) this.changed?.();
  }

  /** Put the photo exactly where the rendering shows what it shows. */
  arrange() {
    const { fx, fy, cx, cy, width, height } = this.shown, { clientWidth, clientHeight } = this.view.frame;
    const focal = clientHeight / 2 / Math.tan((this.view.camera.fov * Math.PI) / 360);
    const [left, top] = [clientWidth / 2 - (cx * focal) / fx, clientHeight / 2 - (cy * focal) / fy];
    this.box = { left, top, width: (width * focal) / fx, height: (height * focal) / fy };
    for (const [side, value] of Object.entries(this.box)) $("photo").style[side] = `${value}px`;
    this.divide();
  }

  divide() {
    const share = Number($("divider").value) / 100, { clientWidth } = this.view.frame, { left, width } = this.box;
    const line = share * clientWidth;
    $("photo").style.clipPath = `inset(0 ${Math.max(0, Math.min(left + width - line, width))}px 0 0)`;
    $("line").style.left = `${line}px`;
  }

  /** Return where a pixel of the window lies in the shown photo, in shares of its sides; null outside. */
  within([x, y]) {
    if (!this.shown) return null;
    const { left, top, width, height } = this.box, place = [(x - left) / width, (y - top) / height];
    return place.every((value) => value >= 0 && value <= 1) ? place : null;
  }

  /** Draw the photos' cameras as pyramids, doubtful ones in a color of their own. */
  draw() {
    const paths = { sure: "", doubtful: "" };
    for (const photo of $("cameras").ariaPressed === "true" ? this.list : []) {
      const corners = this.corners(photo).map((point) => this.view.pixel(point));
      if (!corners.every(Boolean)) continue;
      const [eye, ...rim] = corners.map((pixel) => pixel.map((value) => value.toFixed(1)));
      paths[photo.doubtful ? "doubtful" : "sure"] += rim.map((corner, k) => `M${eye}L${corner}L${rim[(k + 1) % 4]}`).join("");
    }
    for (const [kind, d] of Object.entries(paths)) $("pyramids").querySelector(`.${kind}`).setAttribute("d", d);
  }

  /** The eye of a photo and the four corners of its picture, in the world. */
  corners({ pose, fx, fy, cx, cy, width, height }) {
    const long = LONG * (this.about.extent?.[4] ?? 1), eye = pose.slice(0, 3).map((row) => row[3]);
    const at = (x, y) => pose.slice(0, 3).map((row) => row[3] + long * (((x - cx) / fx) * row[0] - ((y - cy) / fy) * row[1] - row[2]));
    return [eye, at(0, 0), at(width, 0), at(width, height), at(0, height)];
  }
}

/** Distort a place in a photo's undistorted picture (shares of its sides) to pixels of its file. */
export function inFile([u, v], { fx, fy, cx, cy, width, height, file, distortion, fisheye }) {
  if (!distortion) return [u * file[0], v * file[1]];
  const [x, y] = [(u * width - cx) / fx, (v * height - cy) / fy], [a, b, c, d, ...k] = distortion, [r2, r] = [x * x + y * y, Math.hypot(x, y)];
  if (fisheye) {
    const t = Math.atan(r), t2 = t * t, bent = t * (1 + t2 * (k[0] + t2 * (k[1] + t2 * (k[2] + t2 * k[3])))), scale = r > 1e-9 ? bent / r : 1;
    return [a * x * scale + c, b * y * scale + d];
  }
  const [k1, k2, p1, p2, k3 = 0, k4 = 0, k5 = 0, k6 = 0] = k;
  const radial = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)));
  return [a * (x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)) + c, b * (y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y) + d];
}
