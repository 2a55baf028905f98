// The list of a word's things: how many were found, one after the other, their boxes, and questions about them.
import { element, say, shown, small } from "./cards.js";
import { answerTo, assumed, count, parse, unsure, wordsOf } from "./grammar.js";
import { Vector3 } from "./library.js";
import { heightAsText, inShares, lengthAsText } from "./measure.js";
import { advice } from "./vocabulary.js";

const NAMESPACE = "http://www.w3.org/2000/svg", CORNERS = [0, 1, 2, 3, 4, 5, 6, 7];
const FILLED = 0.35, NARROW = 15, WIDE = 60; // share of the window that a thing fills after a flight; degrees of the lens
const MOST_NUMBERS = 8; // of things that are named one by one
const nameOf = ({ text, negatives }) => [text, ...negatives].join(" not "); // in links: other negatives make another prompt
const GAP = 4, LETTER = 8, LINE = 18; // pixels between labels, per letter, and of a line

export class List extends EventTarget {
  /** about: the page's description; think: gives the worker a job; view, prompts: what is shown. Fires `change` when
   * the list, or what is chosen in it, has changed. */
  constructor(about, think, view, prompts) {
    super();
    Object.assign(this, { about, think, view, prompts, chosen: null, wanted: null, visible: new Set() });
  }

  /** Find a prompt's things, once for each of its answers; resolves to { things, candidates }. */
  async find(prompt) {
    const { turn, relevancy } = prompt;
    if (prompt.counting?.turn !== turn) prompt.counting = { turn, found: this.think("things", { text: prompt.text, negatives: prompt.negatives, relevancy, taught: Boolean(prompt.taught || prompt.examples) }) };
    const found = await prompt.counting.found;
    if (prompt.turn !== turn || prompt.found === found) return found;
    prompt.found = found;
    this.tidy(prompt);
    if (this.wanted?.word === nameOf(prompt)) this.takeAgain(prompt);
    this.dispatchEvent(new Event("change"));
    return found;
  }

  /** Build the part of a prompt's card that lists its things; null before they are found. */
  part(prompt) {
    if (!prompt.found) return null;
    const { things, better } = prompt.found;
    if (!things.length) return element("p", {}, `No single things found${better ? `: what was found fits ${better} better` : ""}.`);
    const summary = element("summary", {}, count(prompt.found, this.about.detail ? " found in the coarse scene" : " found"));
    const made = element("details", { className: "things", open: Boolean(prompt.listed) }, summary);
    summary.addEventListener("click", (event) => {
      event.preventDefault();
      prompt.listed = !prompt.listed;
      if (!prompt.listed && this.chosen?.prompt === prompt) this.leave();
      this.dispatchEvent(new Event("change"));
    });
    if (!prompt.listed) return made;
    const own = this.chosen?.prompt === prompt, listed = element("ol", { ariaLabel: `Things: ${shown(prompt.text)}` });
    things.forEach((thing, k) => {
      const ask = { ariaLabel: `${shown(prompt.text)} ${k + 1}`, ariaPressed: String(own && this.chosen.thing === thing), tabIndex: (own ? this.chosen.thing === thing : k === 0) ? 0 : -1 }; // one stop of the tabulator
      listed.append(element("li", { className: prompt.asked?.has(thing.id) ? "asked" : "" }, small(`${k + 1}`, () => this.choose(prompt, thing), ask)));
    });
    const [wide, deep, high] = own ? this.chosen.thing.size.map((side) => lengthAsText(side, this.about)) : [];
    made.append(element("p", { className: "size" }, own ? `${high} high, ${wide} × ${deep} wide and deep, its middle ${heightAsText(this.chosen.thing.center, this.about)}${inShares(this.about)}.` : ""), element("div", {}, small("‹", () => this.step(-1, prompt), { ariaLabel: "Previous thing" }), small("›", () => this.step(1, prompt), { ariaLabel: "Next thing" }),
      small("Hide the rest", () => this.hideRest(!this.view.only), { ariaPressed: String(own && Boolean(this.view.only)), disabled: !own })), listed); // prettier-ignore
    return made;
  }

  // ── choosing ──

  /** Choose a thing, and fly to it. */
  choose(prompt, thing) {
    const photo = this.about.views[thing.seen[0]];
    if (photo) {
      const { position } = this.view.mover.standing(photo), target = new Vector3(...thing.center), size = Math.max(...thing.size);
      const fov = (360 / Math.PI) * Math.atan(size / FILLED / 2 / Math.max(position.distanceTo(target), 1e-6));
      this.view.mover.fly({ position, target, fov: Math.max(NARROW, Math.min(fov, WIDE)) });
    }
    this.take(prompt, thing, this.view.only);
  }

  /** Choose the thing that an address names, or say that it isn't among those found. */
  takeAgain(prompt) {
    const { id: wanted, alone } = this.wanted, again = prompt.found.things.find(({ id, rows }) => id === wanted || rows.includes(wanted));
    if (again) return this.take(prompt, again, alone);
    this.wanted = null;
    say(`The thing that this link names is not among those found: ${shown(prompt.text)}.`);
  }

  take(prompt, thing, alone) {
    Object.assign(this, { chosen: { prompt, thing }, wanted: null });
    prompt.listed = true;
    this.hideRest(alone);
  }

  /** Choose nothing any more; returns whether something was chosen. */
  leave() {
    const before = this.chosen;
    Object.assign(this, { chosen: null, wanted: null });
    this.hideRest(false);
    return Boolean(before);
  }

  /** Choose nothing any more, before the next drawing, if the prompt is gone or has this new answer. */
  tidy(answered = null) {
    const { prompt } = this.chosen ?? {};
    if (prompt && (prompt === answered || !this.prompts.includes(prompt))) this.chosen = this.view.only = null;
  }

  /** Show the chosen thing alone, or everything. */
  hideRest(alone) {
    this.view.only = alone && this.chosen ? new Set(this.chosen.thing.rows) : null;
    this.view.recolor(this.view.shown);
    this.dispatchEvent(new Event("change"));
  }

  /** Choose the next thing of a list, or of those that were asked for. */
  step(by, prompt = this.chosen?.prompt ?? this.prompts.find(({ found }) => found?.things.length)) {
    const { things = [] } = prompt?.found ?? {}, asked = things.filter(({ id }) => !prompt.asked || prompt.asked.has(id));
    const here = asked.indexOf(this.chosen?.thing), next = here < 0 ? (by > 0 ? 0 : asked.length - 1) : (here + by + asked.length) % asked.length;
    if (asked.length) this.choose(prompt, asked[next]);
  }

  /** Choose the thing that shows these Gaussians, among the lists that are open; returns whether there is one. */
  pick(rows) {
    for (const prompt of this.open) {
      const thing = prompt.found.things.find((one) => rows.some((row) => one.rows.includes(row)));
      if (thing) return this.choose(prompt, thing), true;
    }
    return false;
  }

  /** The chosen thing, or the one that will be once its word is answered, as fields of an address, and back. */
  get fields() {
    const { prompt, thing } = this.chosen ?? {}, { id, word, alone } = thing ? { id: thing.id, word: nameOf(prompt), alone: this.view.only } : this.wanted ?? {};
    return word ? { thing: `${id} ${word}`, alone: alone ? 1 : "" } : {};
  }

  set fields({ thing, alone }) {
    const [, id, word] = /^(\d+) (.+)$/.exec(thing ?? "") ?? [];
    this.leave();
    if (!word) return;
    this.wanted = { id: Number(id), word, alone: alone === "1" };
    for (const prompt of this.prompts) delete prompt.found; // looked up anew among those that are known
  }

  // ── questions ──

  /** Answer a question, such as "highest tower". names: words that were taught; ask: answers a prompt, and resolves to
   * whether its words are known. Resolves to the answer in words; null if some word is unknown. */
  async question(typed, names, ask) {
    const request = parse(typed, names), words = wordsOf(request), found = {};
    for (const word of words) if (!(await ask(word))) return null;
    const asked = words.map((word) => this.prompts.find(({ text, negatives }) => text.toLowerCase() === word.toLowerCase() && !negatives.length));
    if (!asked.every(Boolean)) return null;
    for (const [k, word] of words.entries()) found[word] = await this.find(asked[k]);
    const things = Object.fromEntries(words.map((word) => [word, found[word].things])), own = things[request.word];
    const view = await this.sight(Object.values(found)), chosen = answerTo(request, things, view), [first] = asked, every = chosen.length === own.length;
    const counted = request.count && !(request.relation || request.superlative || request.nth || request.among || request.without);
    Object.assign(first, { listed: true, asked: every ? null : new Set(chosen.map(({ id }) => id)) });
    const sure = asked.every(({ trust }) => trust.level === "sure" && !trust.far) ? "" : " Not sure: see the cards.";
    const doubt = counted ? null : unsure(request, found, view, shown), several = assumed(request, things, view, shown);
    const note = [several && ` ${several}.`, doubt ? ` Unsure, since ${doubt}.` : "", sure, ...asked.filter(({ taught, examples }) => !taught && !examples).flatMap(({ text }) => advice(text)).map((told) => ` But ${told}.`)].join("");
    if (request.count) {
      this.dispatchEvent(new Event("change"));
      return `${shown(request.word)}: ${counted ? count(first.found) : chosen.length}.${note}`; // which suits one and many
    }
    if (chosen.length) this.choose(first, chosen[0]);
    else this.dispatchEvent(new Event("change"));
    const numbers = chosen.map((thing) => own.indexOf(thing) + 1).join(", "), name = shown(request.word);
    if (!chosen.length) return `Found no such ${name}.${note}`;
    return (chosen.length > MOST_NUMBERS ? `${chosen.length} of ${own.length} ${name}.` : `${name} number${chosen.length > 1 ? "s" : ""} ${numbers}.`) + note;
  }

  /** Directions of the viewer, right, up and ahead, and the ids of the things that the view shows. */
  async sight(found) {
    const { upright } = this.about, up = new Vector3(...this.about.up), ahead = this.view.camera.getWorldDirection(new Vector3());
    ahead.addScaledVector(up, -ahead.dot(up)).normalize(); // which leaves right the picture's, since this camera never rolls
    const shown = new Set((await this.inView(found.map(({ things, candidates }) => [...things, ...candidates]))).map(({ id }) => id));
    return { right: ahead.clone().cross(up).toArray(), up: up.toArray(), ahead: ahead.toArray(), shown, upright };
  }

  // ── boxes and labels ──

  /** The prompts whose lists are open. */
  get open() {
    return this.prompts.filter(({ listed, found }) => listed && found);
  }

  /** Find which things the view shows. Resolves to whether it is still the same view. */
  async look() {
    const turn = (this.turn = {}), shown = await this.inView(this.open.map(({ found }) => found.things));
    if (turn === this.turn) this.visible = new Set(shown);
    return turn === this.turn;
  }

  /** Those of several lists of things that the view shows. */
  async inView(lists) {
    const shown = lists.length ? await this.think("shown", { camera: this.view.picking, lists: lists.map((things) => things.map(({ rows }) => rows)) }) : [];
    return lists.flatMap((things, k) => things.filter((_, t) => shown[k][t]));
  }

  /** Draw the boxes of the lists that are open, with numbers that don't overlap: of what the view shows, and of the chosen
   * thing, which comes first and is alone where the rest is hidden. */
  outlines() {
    const drawn = [], taken = [];
    for (const prompt of this.open) {
      prompt.found.things.forEach((thing, k) => {
        const own = thing === this.chosen?.thing, asked = !prompt.asked || prompt.asked.has(thing.id);
        if (own || (this.visible.has(thing) && !this.view.only)) drawn.push({ prompt, thing, label: `${k + 1}`, own, asked });
      });
    }
    return drawn.sort((a, b) => b.own - a.own || b.asked - a.asked).flatMap((one) => this.outline(one, taken));
  }

  /** Draw a thing's box, and its label where that covers none of those in `taken`. */
  outline({ prompt, thing, label, own, asked }, taken) {
    const corners = cornersOf(thing).map((corner) => this.view.pixel(corner));
    if (!corners.every(Boolean)) return [];
    const kind = `thing ${own ? "chosen" : asked ? "" : "aside"}`, edges = CORNERS.flatMap((k) => [1, 2, 4].filter((step) => !(k & step)).map((step) => `M${corners[k]}L${corners[k + step]}`));
    const path = drawn("path", prompt.color, { class: kind, d: edges.join("") });
    const [x, y] = corners.reduce((best, corner) => (corner[1] < best[1] ? corner : best)), word = own ? `${shown(prompt.text)} ${label}` : label;
    const half = (LETTER * word.length) / 2, place = [x - half, y - 6 - LINE, x + half, y - 6];
    const apart = (other) => place[0] > other[2] + GAP || other[0] > place[2] + GAP || place[1] > other[3] + GAP || other[1] > place[3] + GAP;
    if (!taken.every(apart)) return [path];
    taken.push(place);
    const text = drawn("text", prompt.color, { class: kind, x, y: y - 6 });
    text.textContent = word;
    text.addEventListener("click", () => this.choose(prompt, thing));
    return [path, text];
  }
}

const cornersOf = ({ center, axes, size }) =>
  CORNERS.map((c) => center.map((value, k) => axes.reduce((sum, axis, a) => sum + axis[k] * size[a] * (((c >> a) & 1) - 0.5), value)));

function drawn(tag, color, attributes) {
  const made = document.createElementNS(NAMESPACE, tag);
  for (const [name, value] of Object.entries(attributes)) made.setAttribute(name, value);
  made.style.setProperty("--color", `rgb(${color})`);
  return made;
}
