// What the page shows as an address, its steps in the browser's history (Undo, Redo, Back and Forward), and lists that
// the browser keeps for a scene.

const MOST_KEPT = 20, MOST_TEXT = 2000;
export const MOST_PROMPTS = 20;

/** Write what is shown as fields of an address, in order: { view, walk, … }, stops of a tour, and prompts, each of them with
 * the fields `at` (a threshold that was chosen) and `hue` (its color, where that is not the next one). */
export function written({ prompts, stops = [], ...others }) {
  const fields = new URLSearchParams();
  for (const [name, value] of Object.entries(others)) if (value) fields.set(name, value);
  for (const stop of stops) fields.append("stop", stop);
  prompts.forEach(({ kind, text, at, hue }, k) => {
    fields.append(kind, text);
    if (at !== undefined) fields.append("at", +at.toFixed(3));
    if (hue !== k) fields.append("hue", hue);
  });
  return `#${fields}`;
}

/** Read an address: the opposite of `written`. What is damaged or unknown is left out. */
export function readFields(hash) {
  const shown = { prompts: [], stops: [] };
  let latest = null;
  for (const [name, value] of new URLSearchParams(hash.slice(1))) {
    const number = value === "" ? NaN : Number(value);
    if (name === "ask" || name === "like") shown.prompts.push((latest = { kind: name, text: name === "ask" ? value.slice(0, MOST_TEXT) : value, hue: shown.prompts.length }));
    else if (name === "at" && latest && number >= 0 && number <= 1) latest.at = number;
    else if (name === "hue" && latest && Number.isInteger(number) && number >= 0) latest.hue = number;
    else if (name === "stop") shown.stops.push(value);
    else if (name !== "at" && name !== "hue" && name !== "prompts" && name !== "stops") shown[name] = value;
  }
  shown.prompts.splice(MOST_PROMPTS);
  return shown;
}

/** Steps of this page in the browser's history. Each holds an address; the view in it follows the eye. */
export class Steps {
  /** apply: called with an address that Back, Forward, Undo, Redo or the user has chosen. */
  constructor(apply, changed) {
    this.changed = changed;
    this.now = history.state?.step ?? 0;
    this.last = this.now;
    this.hash = location.hash;
    addEventListener("popstate", ({ state }) => {
      if (location.hash === this.hash) return;
      this.hash = location.hash;
      if (state?.step === undefined) this.last = this.now += 1; // an address that was typed
      this.now = state?.step ?? this.now;
      history.replaceState({ step: this.now }, "");
      this.last = Math.max(this.last, this.now);
      changed();
      apply(this.hash);
    });
  }

  /** Keep an address: as a step of its own if more than the view differs from before, or as told. */
  keep(hash, own = without(hash) !== without(this.hash)) {
    if (own) this.last = this.now += 1;
    else if (hash === this.hash && history.state) return;
    const moved = this.now > (history.state?.step ?? 0);
    history[moved && history.state ? "pushState" : "replaceState"]({ step: this.now }, "", hash);
    this.hash = hash;
    this.changed();
  }

  get past() {
    return this.now > 0;
  }

  get future() {
    return this.now < this.last;
  }

  undo() {
    if (this.past) history.back();
  }

  redo() {
    if (this.future) history.forward();
  }
}

function without(hash) {
  const fields = new URLSearchParams(hash.slice(1));
  for (const name of ["view", "shape"]) fields.delete(name);
  return String(fields);
}

/** Words that this browser keeps for the scene, latest first. */
export class Kept {
  constructor({ title, count, center }) {
    this.name = `lang3dxl words ${title} ${count} ${center}`;
  }

  get words() {
    try {
      return [JSON.parse(localStorage.getItem(this.name))].flat().filter(Boolean);
    } catch {
      return []; // the browser keeps nothing
    }
  }

  set words(list) {
    try {
      localStorage.setItem(this.name, JSON.stringify(list.slice(0, MOST_KEPT)));
    } catch {} // the browser keeps nothing
  }
}
