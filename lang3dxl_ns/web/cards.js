// Pieces of the panel: messages, and a card per prompt with its color, heat, threshold and trust.
import { advice } from "./vocabulary.js";

export const percent = (share) => (share > 0 && share < 0.01 ? "under 1 %" : `${Math.round(100 * share)} %`);
export const shown = (text, most = 60) => (text.length > most ? `${text.slice(0, most - 1)}…` : text);

/** Create an element with these properties and children; texts are never parsed as HTML. */
export function element(tag, properties = {}, ...children) {
  const made = Object.assign(document.createElement(tag), properties);
  made.append(...children);
  return made;
}

export function say(message) {
  document.getElementById("status").textContent = message;
}

export const explain = ({ count, detail, known, live, foreground }) =>
  `${(detail?.count ?? count).toLocaleString("en")} Gaussians. ` + (live ? "Ask for anything." : `Ask for any of ${known.toLocaleString("en")} words.`) +
  (foreground.length ? ` Matches lie on ${foreground.map(([text]) => shown(text)).join(" or ")}.` : "");

/** Return how many Gaussians of the scene so many of chunk 0 stand for. about: the page's description. */
export const wholeCount = (number, { count, detail }) => (detail ? Math.round((number * detail.count) / count) : number);

/** Tell how many Gaussians match: nearly, where the scene has detail, which isn't counted. */
export const matched = (number, { detail }) =>
  detail ? `About ${number.toLocaleString("en", { maximumSignificantDigits: 2 })} Gaussians match.` : `${number.toLocaleString("en")} Gaussians match.`;

function doubtIn({ text, examples, open, taught, trust }) {
  const count = examples && `${examples.length} example${examples.length > 1 ? "s" : ""}`;
  if (examples) return open ? `${count}: click for more, with Alt or “Not this” for what it is not.` : `${count}.`;
  const remedy = trust.far ? "Outline it, or train with a larger CLIP (lang3dxl view or teach; docs: encoders)." : "Outline it, or click one and take Like this.";
  return [...advice(text).map(sentence), `${sentence(trust.level)} ${sentence(trust.reason)}`, ...(trust.level === "sure" || taught ? [] : [remedy])].join(" ");
}

const sentence = (text) => `${text[0].toUpperCase()}${text.slice(1)}.`;

/** Build a prompt's card. acts: { fly, remove, rename, dragThreshold, setThreshold, teach, outline, save, forget },
 * each called with the prompt; about: the page's description. */
export function promptCard(prompt, { fly, remove, rename, dragThreshold, setThreshold, teach, outline, save, forget }, about) {
  const { text, negatives, color, threshold, peak, matching, views, examples, open } = prompt;
  const card = element("li");
  card.style.setProperty("--color", `rgb(${color})`);
  const name = shown(text) + (negatives.length ? ` not ${negatives.map((one) => shown(one)).join(", ")}` : "");
  const go = element("button", { className: "small fly", disabled: !views?.some((one) => one.shown), onclick: () => fly(prompt) }, "Fly to");
  const away = element("button", { className: "small", ariaLabel: `Remove ${shown(text)}`, onclick: () => remove(prompt) }, "×");
  const heading = examples ? element("input", { defaultValue: text, ariaLabel: "Name", maxLength: 60 }) : element("strong", {}, name);
  const named = () => heading.kept || heading.value === heading.defaultValue || rename(prompt, (heading.defaultValue = heading.value));
  if (examples) for (const event of ["change", "blur"]) heading.addEventListener(event, named);
  heading.addEventListener("keydown", ({ key }) => key === "Enter" && named());
  const button = (label, act, pressed) => element("button", { className: "small", ariaPressed: pressed, onclick: () => act(prompt) }, label);
  card.append(element("header", {}, heading, ...(examples ? [button(open ? "Done" : "Add", teach, open)] : []), go, away));
  if (open) {
    const without = button("Not this", () => (without.ariaPressed = prompt.without = !prompt.without), Boolean(prompt.without));
    without.disabled = !examples.length;
    card.append(
      element("div", { className: "teach" }, without, button("Outline", outline), ...(prompt.named ? [button("Save", save), button("Forget", forget)] : [])),
      element("p", { className: "hint" }, examples.length ? prompt.told ?? "" : "Click on it in the view, or outline it. Then give it a name.")); // prettier-ignore
  }
  if (threshold == null) return card;
  const slider = element("input", { type: "range", min: 0, max: 1, step: 0.01, value: threshold, ariaLabel: `Threshold of ${shown(text)}` });
  slider.addEventListener("input", () => dragThreshold(prompt, Number(slider.value)));
  slider.addEventListener("change", () => setThreshold(prompt, Number(slider.value)));
  const ends = [threshold, peak].map((value) => element("span", {}, value.toFixed(2)));
  if (peak > threshold) card.append(element("div", { className: "ends" }, ends[0], element("div", { className: "heat" }), ends[1]));
  card.append(
    element("p", {}, `${doubtIn(prompt)} `, element("span", { className: "count" }, matched(matching, about))),
    element("label", {}, "Threshold", slider)); // prettier-ignore
  return card;
}
