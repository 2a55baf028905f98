// The picture: splats drawn with WebGL (Spark, three.js), their colors, and places on the screen.
import { Mover, still } from "./move.js";
import { Part } from "./part.js";
import { Scene, SparkRenderer, Vector3, WebGLRenderer } from "./library.js";
import { FAN } from "./tree.js";

const BLUR = 0.3; // square pixels
const FLUENT = 40, COARSEST = 0.3, STILL = 150, REST = 2; // milliseconds of a frame, least share of pixels a side, milliseconds; times of a sharp picture until the next one

export class View extends EventTarget {
  /** Fill an element. about: the page's description; frame: the element. Fires `moved`, `drawn`, `click` and
   * `double` (a double click). */
  constructor(about, frame) {
    super();
    Object.assign(this, { about, frame, parts: new Map(), heat: () => undefined }); // parts: by number, chunk 0 first; heat: see Part.paint
    this.renderer = new WebGLRenderer({ antialias: false });
    Object.assign(this, { cost: 4 * FLUENT, sharp: false, changed: false, unsorted: false, ended: 0, asked: false, drawing: null, order: "" });
    const [red, green, blue] = about.background.map((value) => Math.round(255 * value));
    this.renderer.setClearColor(`rgb(${red}, ${green}, ${blue})`);
    this.canvas = frame.appendChild(this.renderer.domElement);
    const [preBlurAmount, blurAmount] = about.antialiased ? [0, BLUR] : [BLUR, 0];
    this.scene = new Scene();
    this.spark = new SparkRenderer({ renderer: this.renderer, preBlurAmount, blurAmount, enableLod: false, onDirty: () => this.sorted() });
    this.scene.add(this.spark);
    this.mover = new Mover(about, this.canvas, frame, () => this.wake());
    Object.assign(this, { camera: this.mover.camera, controls: this.mover.controls });
    this.mover.addEventListener("grab", () => (this.held = true));
    this.mover.addEventListener("release", () => (this.held = false));
    new ResizeObserver(() => this.resize()).observe(frame);
    this.resize();
    this.listen();
  }

  // ── splats ──

  /** Draw packed splats, 16 bytes each. */
  async show(buffer) {
    const root = await Part.of(buffer, this.about.center);
    this.scene.add(root.mesh);
    this.root = root;
    this.parts.set(0, root);
    this.mover.refit(); // now that the page's strip of photos covers its part
    this.recolor();
  }

  /** Draw a chunk in place of a quarter of its parent. */
  async add(buffer, number, floats) {
    const part = await Part.of(buffer, this.about.center, number, floats);
    part.light(this.root.own, this.root.plain);
    this.parts.set(number, part);
    this.repaint(number);
    this.scene.add(part.mesh);
    this.cover(number, true);
  }

  /** Draw a quarter of a chunk's parent in its place. */
  remove(number) {
    const part = this.parts.get(number);
    this.parts.delete(number);
    this.cover(number, false);
    this.scene.remove(part.mesh);
    part.dispose();
  }

  cover(number, covered) {
    this.unsorted = true;
    const parent = Math.floor((number - 1) / FAN);
    this.parts.get(parent).covered[(number - 1) % FAN] = covered;
    this.repaint(parent);
  }

  /** Set the colors and opacities of all splats, four bytes each, before heat. */
  light(colors) {
    this.root.plain = colors;
    for (const part of this.parts.values()) if (part.number) part.light(this.root.own, colors);
    this.layers = null;
    this.recolor(this.shown);
  }

  /** Show heat: layers of { relevancy, threshold, peak, color }, the strongest where several match. */
  recolor(layers = []) {
    const told = [this.limit, this.only, ...layers.flatMap(({ relevancy, threshold, color }) => [relevancy, threshold, color])];
    if (!this.root || (told.length === this.layers?.length && told.every((value, k) => value === this.layers[k]))) return;
    Object.assign(this, { layers: told, shown: layers });
    for (const number of this.parts.keys()) this.repaint(number);
    this.wake();
    this.dispatchEvent(new Event("heated"));
  }

  repaint(number) {
    this.parts.get(number)?.paint(this.shown ?? [], this.heat, this.limit, this.only);
    this.refresh();
  }

  /** Hide the Gaussians that float more than a limit, 0…255. */
  hide(limit) {
    this.limit = limit;
    this.recolor(this.shown);
  }

  // ── frames ──

  /** Redraw: a draft that keeps up on slow machines and, once nothing changes, a sharp picture. */
  wake() {
    this.changed = true;
    this.moved = performance.now();
    this.request();
  }

  /** Redraw what has changed before an eye that rests: the picture stays sharp, however long detail arrives. */
  refresh() {
    this.sharp = false;
    if (this.held || this.mover.moving) this.changed = true;
    this.request();
  }

  request() {
    if (!this.asked) requestAnimationFrame((now) => this.step(now));
    this.asked = true;
  }

  /** Whether nothing is left to draw. */
  get resting() {
    return !this.mover.moving && !this.changed && this.sharp && !this.drawing;
  }

  step(now) {
    this.asked = false;
    if (this.lost) return; // until the browser restores the context
    if (!this.root || !this.drawn()) return this.root && this.request();
    this.mover.update(now);
    if (this.changed) {
      this.draw(Math.max(Math.min(Math.sqrt(FLUENT / this.cost), 1), COARSEST));
      this.dispatchEvent(new Event("moved"));
    } else if (!this.sharp && !this.held && now - this.moved > Math.max(STILL, this.cost / 4) && now - this.ended > REST * this.cost) this.draw(1);
    if (!this.resting) this.request();
  }

  /** Whether the browser has taken the picture's WebGL context away. */
  get lost() {
    return this.renderer.getContext().isContextLost();
  }

  /** Return whether the last frame has been drawn. Its time determines how many pixels a fluent frame may have. */
  drawn() {
    if (!this.drawing) return true;
    const { fence, start, share } = this.drawing, gl = this.renderer.getContext();
    if (gl.getSyncParameter(fence, gl.SYNC_STATUS) !== gl.SIGNALED) return false;
    gl.deleteSync(fence);
    this.drawing = null;
    this.dispatchEvent(new Event("drawn"));
    if (share === 1 || !this.measured) this.cost = Math.min((performance.now() - start) / share ** 2, 2000);
    if (share === 1) Object.assign(this, { measured: true, ended: performance.now() });
    this.controls.enableDamping = !still.matches && this.cost < 2 * FLUENT; // damping takes a hundred frames
    return true;
  }

  /** Draw with this share of the screen's pixels along each side. */
  draw(share) {
    if (this.lost) return;
    const gl = this.renderer.getContext(), ratio = share * Math.min(devicePixelRatio, 2), start = performance.now();
    if (this.renderer.getPixelRatio() !== ratio) this.renderer.setPixelRatio(ratio);
    if (!this.spark.sorting) this.unsorted = false; // Spark takes no new chunks while it sorts
    this.renderer.render(this.scene, this.camera);
    this.drawing = { fence: gl.fenceSync(gl.SYNC_GPU_COMMANDS_COMPLETE, 0), start, share };
    gl.flush();
    Object.assign(this, { changed: false, sharp: share === 1 });
  }

  /** Draw the splats after sorting, if their order has changed. */
  sorted() {
    const { sortedCenter, sortedDir, sorting, display } = this.spark, order = [...sortedCenter, ...sortedDir, display.mappingVersion].join();
    if (sorting || (order === this.order && !this.unsorted)) return;
    this.order = order;
    this.refresh();
  }

  resize() {
    const { clientWidth: width, clientHeight: height } = this.frame;
    if (!width || !height) return;
    this.renderer.setSize(width, height);
    this.camera.aspect = width / height;
    this.camera.updateProjectionMatrix();
    this.mover.refit();
    this.wake();
  }

  // ── places on the screen ──

  /** Project a point of the world to a pixel; null behind the camera. */
  pixel(point) {
    const seen = new Vector3(...point).project(this.camera);
    if (!(seen.z <= 1) || !Number.isFinite(seen.x + seen.y)) return null;
    return [((seen.x + 1) / 2) * this.frame.clientWidth, ((1 - seen.y) / 2) * this.frame.clientHeight];
  }

  /** The camera as a view of find.js, in the frame of the packed splats. */
  get picking() {
    const { clientWidth: width, clientHeight: height } = this.frame, focal = height / 2 / Math.tan((this.camera.fov * Math.PI) / 360);
    this.camera.updateMatrixWorld();
    const m = this.camera.matrixWorld.elements, pose = [0, 1, 2].map((row) => [m[row], m[4 + row], m[8 + row], m[12 + row] - this.about.center[row]]);
    return { pose, fx: focal, fy: focal, cx: width / 2, cy: height / 2, width, height };
  }

  listen() {
    let down = null, before = null;
    const near = (one, other) => Math.hypot(one.clientX - other.clientX, one.clientY - other.clientY) < 6;
    this.canvas.addEventListener("pointerdown", (event) => (down = event.isPrimary ? event : null));
    // A click on anything between two clicks on one place makes them two single ones.
    addEventListener("pointerdown", (event) => { if (event.target !== this.canvas) before = null; }, true); // prettier-ignore
    this.canvas.addEventListener("pointerup", (event) => {
      if (!down || !near(event, down) || event.timeStamp - down.timeStamp > 600 || event.button > 0) return;
      const corner = this.canvas.getBoundingClientRect();
      const detail = { x: event.clientX - corner.left, y: event.clientY - corner.top, without: event.altKey };
      const again = before && near(event, before) && event.timeStamp - before.timeStamp < 400;
      before = again ? null : event;
      this.dispatchEvent(new CustomEvent(again ? "double" : "click", { detail }));
    });
    this.canvas.addEventListener("webglcontextlost", () => (this.drawing = null));
    this.canvas.addEventListener("webglcontextrestored", () => {
      for (const part of this.parts.values()) part.upload();
      this.wake();
    });
  }

  /** Return the picture as a PNG. */
  picture() {
    this.draw(1);
    return new Promise((done) => this.canvas.toBlob(done, "image/png"));
  }
}
