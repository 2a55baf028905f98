// Detail of a large scene: chunks that replace a quarter of a coarser one where it looks coarse, within a budget.
import { FAN } from "./tree.js";

const BUDGET = 1_500_000, SMALL_BUDGET = 400_000; // Gaussians that are held; on phones
const FINE = 0.5, ASIDE = 0.1, PAUSE = 200; // pixels of a standard deviation that need no detail; worth of what is out of sight; milliseconds

export class Detail {
  /** Follow a view. read: fetches a file of the page; question: describes a prompt for the worker; failed: is told why
   * a chunk can't be read. */
  constructor(about, view, think, { read, question, failed }) {
    Object.assign(this, { about, view, think, read, question, failed, ...about.detail, known: new WeakMap(), ready: new Set() });
    const small = matchMedia("(pointer: coarse)").matches || navigator.deviceMemory <= 4;
    this.most = Math.max(Math.floor((small ? SMALL_BUDGET : BUDGET) / this.rows), FAN) + 1; // chunks, with chunk 0
    view.heat = ({ relevancy }, number) => this.known.get(relevancy)?.get(number);
    view.addEventListener("heated", () => this.warm());
    view.addEventListener("moved", () => this.follow());
    this.follow();
  }

  /** Load what is worth most, now and after further moves. */
  follow() {
    clearTimeout(this.timer);
    this.timer = setTimeout(() => (this.loading ??= this.load().catch(this.failed).finally(() => (this.loading = null))), PAUSE);
  }

  async load() {
    for (;;) {
      const wanted = this.wanted(), next = wanted.find((number) => !this.view.parts.has(number));
      if (next === undefined) return;
      const held = [...this.view.parts.keys()].sort((a, b) => b - a); // children before their parents
      const spare = held.filter((number) => number && !wanted.includes(number)).slice(0, Math.max(held.length + 1 - this.most, 0));
      for (const number of spare) await this.drop(number);
      await this.add(next);
    }
  }

  /** List the chunks worth holding, the best first: those whose parents look coarsest. */
  wanted() {
    const found = [0], open = this.childrenOf(0);
    while (open.length && found.length < this.most) {
      open.sort((a, b) => a.worth - b.worth);
      const { number, worth } = open.pop();
      if (worth < FINE) break;
      found.push(number);
      open.push(...this.childrenOf(number, worth));
    }
    return found;
  }

  childrenOf(number, most = Infinity) {
    const children = Array.from({ length: FAN }, (_, k) => FAN * number + 1 + k).filter((child) => child < this.chunks.length);
    return children.map((child) => ({ number: child, worth: Math.min(this.coarseness(child, this.chunks[number][4]), most) }));
  }

  /** How many pixels a standard deviation of size `size` spans at a chunk. */
  coarseness(number, size) {
    const { camera, frame } = this.view, [x, y, z, radius] = this.chunks[number], eye = camera.position;
    const away = [x - eye.x, y - eye.y, z - eye.z], distance = Math.hypot(...away);
    const e = camera.matrixWorld.elements, ahead = -(away[0] * e[8] + away[1] * e[9] + away[2] * e[10]);
    const half = (camera.fov * Math.PI) / 360, widest = Math.atan(Math.tan(half) * Math.hypot(camera.aspect, 1));
    const off = Math.acos(Math.max(-1, Math.min(ahead / distance, 1))) - Math.asin(Math.min(radius / distance, 1));
    const pixels = (size * frame.clientHeight) / 2 / Math.tan(half) / Math.max(distance - radius, radius / 4, 1e-9);
    return distance < radius || off < widest ? pixels : ASIDE * pixels;
  }

  async add(number) {
    const { rows } = this, buffer = await (await this.read(`part${number}.bin`)).arrayBuffer();
    const floats = new Uint8Array(buffer, 16 * rows, rows);
    await this.view.add(buffer.slice(0, 16 * rows), number, floats);
    if (!this.about.words) return;
    await this.think("part", { number, buffer });
    this.ready.add(number);
    await this.warm();
  }

  async drop(number) {
    this.ready.delete(number);
    this.view.remove(number);
    if (this.about.words) await this.think("drop", { number });
  }

  /** Find the relevancy of the chunks' own Gaussians to what is shown. */
  async warm() {
    for (const prompt of this.view.shown ?? []) {
      const values = this.known.get(prompt.relevancy) ?? new Map(), numbers = [...this.ready].filter((number) => !values.has(number));
      this.known.set(prompt.relevancy, values);
      if (!numbers.length) continue;
      for (const number of numbers) values.set(number, undefined); // on its way
      const found = await this.think("fine", { ...this.question(prompt), numbers });
      for (const number of numbers) values.delete(number); // some may have been dropped in the meantime
      for (const { number, relevancy } of found) {
        values.set(number, relevancy);
        this.view.repaint(number);
      }
    }
  }
}
