// A tour: views that one keeps with their words and a caption, in the page's link, and played in order.
import { $, element, small } from "./cards.js";

const MOST_STOPS = 30, MOST_CAPTION = 300;
const PAUSE = 4000, LETTER = 60; // milliseconds at a stop, and for each letter of its caption

export class Tour {
  /** here: returns what is shown, as an address without a tour; go: flies to an address, and resolves once its words are
   * answered; changed: called when the stops have changed. */
  constructor(here, go, changed) {
    Object.assign(this, { here, go, changed, stops: [], playing: null }); // stops: { caption, hash }
    $("keep").addEventListener("click", () => this.keep());
    $("play").addEventListener("click", () => (this.playing ? this.stop() : this.play()));
    const leave = ({ target }) => $("play").contains(target) || this.stop();
    for (const kind of ["pointerdown", "keydown", "wheel"]) addEventListener(kind, leave, { capture: true, passive: true });
    this.draw();
  }

  /** The stops as texts of an address, and back. */
  get fields() {
    return this.stops.map(({ caption, hash }) => `${caption ? `${new URLSearchParams({ caption })}&` : ""}${hash.slice(1)}`);
  }

  set fields(texts) {
    if (String(texts) === String(this.fields)) return;
    this.stops = texts.slice(0, MOST_STOPS).map((text) => {
      const fields = new URLSearchParams(text), caption = (fields.get("caption") ?? "").slice(0, MOST_CAPTION);
      for (const name of ["caption", "stop"]) fields.delete(name);
      return { caption, hash: `#${fields}` };
    });
    $("tour").open ||= this.stops.length > 0;
    this.draw();
  }

  /** Keep what is shown as the last stop. */
  keep() {
    if (this.stops.length < MOST_STOPS) this.stops.push({ caption: "", hash: this.here() });
    this.draw();
    $("stops").lastElementChild.querySelector("input").focus();
    this.changed();
  }

  draw() {
    $("stops").replaceChildren(...this.stops.map((stop, k) => this.row(stop, k)));
    $("play").disabled = !this.stops.length;
    $("keep").disabled = this.stops.length >= MOST_STOPS;
  }

  row(stop, k) {
    const caption = element("input", { value: stop.caption, maxLength: MOST_CAPTION, placeholder: "Caption", ariaLabel: `Caption of stop ${k + 1}` });
    caption.addEventListener("change", () => ((stop.caption = caption.value.trim()), this.changed()));
    const change = (...splice) => (this.stops.splice(...splice), this.draw(), this.changed());
    const earlier = () => change(k - 1, 2, stop, this.stops[k - 1]), remove = () => change(k, 1);
    return element("li", {}, small(`${k + 1}`, () => this.go(stop.hash), { ariaLabel: `Go to stop ${k + 1}` }), caption,
      small("↑", earlier, { ariaLabel: `Move stop ${k + 1} up`, disabled: k === 0 }), small("×", remove, { ariaLabel: `Remove stop ${k + 1}` })); // prettier-ignore
  }

  /** Fly from stop to stop, until the user does anything else. pause: milliseconds at each, besides its caption's. */
  async play(pause = PAUSE) {
    const turn = (this.playing = {});
    $("play").textContent = "Stop the tour";
    for (const { caption, hash } of [...this.stops]) {
      $("caption").textContent = caption;
      $("caption").hidden = !caption;
      await this.go(hash);
      if (turn !== this.playing) return;
      await new Promise((done) => setTimeout(done, pause + LETTER * caption.length));
      if (turn !== this.playing) return;
    }
    this.stop();
  }

  stop() {
    if (!this.playing) return;
    this.playing = null;
    $("play").textContent = "Play the tour";
    $("caption").hidden = true;
  }
}
