// Pieces of the panel: messages, and a card per prompt with its color, heat, threshold and trust.
import { advice } from "./vocabulary.js";

export const $ = (id) => document.getElementById(id);
export const percent = (share) => (share > 0 && share < 0.01 ? "under 1 %" : `${Math.round(100 * share)} %`);
export const shown = (text, most = 60) => (text.length > most ? `${text.slice(0, most - 1)}…` : text);

/** Create an element with these properties and children; texts are never parsed as HTML. */
export function element(tag, properties = {}, ...children) {
  const made = Object.assign(document.createElement(tag), properties);
  made.append(...children);
  return made;
}

/** Create a small button. */
export const small = (label, onclick, more = {}) => element("button", { className: "small", onclick, ...more }, label);

/** Tell something; usual: what is told while nothing has happened, which a folded panel hides. */
export function say(message, usual = false) {
  if ("told" in $("status").dataset) return; // start.js has said why the page can't work
  $("status").textContent = message;
  $("status").classList.toggle("usual", usual);
}

/** Say what can be asked. known: the words that the page answers, once it has read what the scene means. */
export function explain({ count, detail, known, live, words, wordless, foreground }) {
  if (!words) return sentence(wordless);
  if (!known) return "Reading what the scene means…";
  const within = foreground.length ? ` Matches lie on ${foreground.map(([text]) => shown(text)).join(" or ")}.` : "";
  return `${(detail?.count ?? count).toLocaleString("en")} Gaussians. ${live ? "Ask for anything." : `Ask for any of ${known.length.toLocaleString("en")} words.`}${within}`;
}

function doubtIn({ text, examples, open, taught, trust, matching }) {
  const count = examples && `${examples.length} example${examples.length > 1 ? "s" : ""}`;
  if (examples) return open ? `${count}: click for more, with Alt or “Not this” for what it is not.` : `${count}.`;
  const remedy = trust.far ? "Outline it, or train with a larger CLIP (lang3dxl view or teach; docs: encoders)." : "Outline it, or click one and take Like this.";
  const nothing = matching || trust.level === "doubtful" ? [] : ["Nothing fits above the threshold."];
  return [...advice(text).map(sentence), `${sentence(trust.level)} ${sentence(trust.reason)}`, ...nothing, ...(trust.level === "sure" || taught ? [] : [remedy])].join(" ");
}

const sentence = (text) => `${text[0].toUpperCase()}${text.slice(1)}.`;

/** Put these behind an element, instead of what is there; the element itself stays, and so does what one types in it. */
function follow(first, ...others) {
  while (first.nextSibling) first.nextSibling.remove();
  first.after(...others);
}

/** Make a prompt's card, with its name: a field for what is taught by example. */
function cardOf(prompt, rename) {
  const { text, negatives, examples } = prompt, name = [text, ...negatives].map((one) => shown(one));
  const heading = examples ? element("input", { ariaLabel: "Name", maxLength: 60 }) : element("strong", {}, name[0] + (negatives.length ? ` not ${name.slice(1).join(", ")}` : ""));
  if (examples) heading.addEventListener("change", () => rename(prompt, heading.value));
  return element("li", {}, element("header", {}, heading));
}

/** Bring a prompt's card up to date, and return it. acts: { fly, remove, rename, dragThreshold, setThreshold, teach,
 * outline, save, forget }, each called with the prompt. */
export function promptCard(prompt, { fly, remove, rename, dragThreshold, setThreshold, teach, outline, save, forget }) {
  const { text, color, threshold, peak, views, examples, open } = prompt, card = (prompt.card ??= cardOf(prompt, rename));
  const [header] = card.children, [heading] = header.children, parts = [];
  card.style.setProperty("--color", `rgb(${color})`);
  if (examples && heading.defaultValue !== text) heading.value = heading.defaultValue = text;
  const button = (label, act, pressed) => small(label, () => act(prompt), { ariaPressed: pressed });
  const go = small("Fly to", () => fly(prompt), { className: "small fly", disabled: !views?.some((one) => one.shown) });
  follow(heading, ...(examples ? [button(open ? "Done" : "Add", teach, open)] : []), go, small("×", () => remove(prompt), { ariaLabel: `Remove ${shown(text)}` }));
  if (open) {
    const without = button("Not this", () => (without.ariaPressed = prompt.without = !prompt.without), Boolean(prompt.without));
    without.disabled = !examples.length;
    parts.push(
      element("div", { className: "teach" }, without, button("Outline", outline), ...(prompt.named ? [button("Save", save), button("Forget", forget)] : [])),
      element("p", { className: "hint" }, prompt.told ?? "")); // prettier-ignore
  }
  if (threshold != null) {
    const slider = element("input", { type: "range", min: 0, max: 1, step: 0.01, value: threshold, ariaLabel: `Threshold of ${shown(text)}` });
    slider.addEventListener("input", () => dragThreshold(prompt, Number(slider.value)));
    slider.addEventListener("change", () => setThreshold(prompt, Number(slider.value)));
    const ends = [threshold, peak].map((value) => element("span", {}, value.toFixed(2)));
    if (peak > threshold) parts.push(element("div", { className: "ends" }, ends[0], element("div", { className: "heat" }), ends[1]));
    parts.push(
      element("p", {}, doubtIn(prompt)),
      element("label", {}, "Threshold", slider)); // prettier-ignore
  }
  follow(header, ...parts);
  return card;
}
