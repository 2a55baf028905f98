// The page: the search box and its prompts, answers to clicks, the address, and the keys.
import { element, explain, percent, promptCard, say, shown } from "./cards.js";
import { parsePrompts, tidy } from "./vocabulary.js";
import { View } from "./view.js";

const MOST_KEPT = 20, TYPING = 500; // most earlier prompts or named words; milliseconds until negatives take effect
const UNNAMED = /^like this (\d+)$/;
const $ = (id) => document.getElementById(id);
const prompts = [];
let about, view, latest = null, read = "", settled = false, cleared = 0; // settled: the address has been read; cleared: how often all prompts were removed

// ── the worker ──

const worker = new Worker("worker.js", { type: "module" }), waiting = new Map();
worker.onmessage = ({ data: { id, output, error, done } }) => {
  if (done !== undefined) return say(`Reading what the scene means: ${percent(done)}`);
  const [resolve, reject] = waiting.get(id);
  waiting.delete(id);
  if (error) reject(new Error(error));
  else resolve(output);
};
worker.onerror = () => say("This browser can't run the page's worker: update it.");

function think(job, input = {}) {
  return new Promise((...settle) => {
    const id = Math.random();
    waiting.set(id, settle);
    worker.postMessage({ id, job, input });
  });
}

// ── asking ──

const commonNegatives = () => $("not").value.split(/[,;]/).map(tidy).filter(Boolean);

/** Answer a prompt anew, with the common negatives. */
async function answer(prompt) {
  const { text, examples, chosen: threshold } = prompt, negatives = [...prompt.negatives, ...commonNegatives()];
  const turn = (prompt.turn = {}); // a later answer to the same prompt wins
  const found = await think("ask", { text, examples, negatives, threshold });
  if (turn !== prompt.turn || !found.known) return found;
  return Object.assign(prompt, found, { views: null, box: null, finding: null });
}

/** Answer all prompts anew, once the common negatives have changed. */
async function answerAll() {
  $("near").replaceChildren();
  for (const prompt of prompts) {
    const found = await answer(prompt);
    if (!found.known) offerClosest(found, prompt);
  }
  draw();
}

/** Find the views that show prompts best, once their heat is drawn. */
function findPlaces() {
  for (const prompt of prompts.filter((one) => one.relevancy && !one.finding)) {
    const { relevancy, threshold, turn } = prompt;
    prompt.finding = think("find", { relevancy, threshold }).then((places) => {
      if (turn !== prompt.turn) return;
      Object.assign(prompt, places);
      prompt.card.querySelector(".fly").disabled = !places.views.length;
      drawBoxes();
    });
  }
}

/** Remove all prompts, and drop the answers that are still awaited. */
function clear() {
  prompts.length = 0;
  return ++cleared;
}

/** Ask prompts as if typed, separated by `;`. Resolves to the answer to the last one. turn: what `clear` returned last. */
async function ask(typed, turn = cleared) {
  await reading;
  $("near").replaceChildren();
  let found = null;
  for (const { text, negatives } of about.words ? parsePrompts(String(typed)) : []) {
    const word = namedWord(text) ?? { text };
    const same = () => prompts.find((prompt) => prompt.text === word.text && String(prompt.negatives) === String(negatives));
    const old = same(), prompt = old ?? { negatives, ...word };
    found = await answer(prompt);
    if (turn !== cleared) break;
    if (!found.known) {
      offerClosest(found, { text, negatives });
      continue;
    }
    const card = old ?? same() ?? prompt; // the same prompt may have been answered in the meantime
    if (!card.color) prompts.push(Object.assign(card, { color: unusedColor() }));
    remember(text);
    draw(settled ? card : null);
  }
  const { known = false, doubtful = true, threshold = null, peak = 0, matching = 0 } = found ?? {};
  return { known, doubtful, threshold, peak, matching };
}

/** Offer the words closest to an unknown one; a click puts a word in its place, in the prompt and in "But not". */
function offerClosest({ unknown, closest }, { text, negatives }) {
  async function mend(word) {
    const mended = (one) => (one === unknown ? word : one), common = commonNegatives();
    $("not").value = common.map(mended).join(", ");
    if (common.includes(unknown)) await answerAll();
    return ask(asTyped({ text: mended(text), negatives: negatives.map(mended) }));
  }
  const words = closest.map((word) => element("button", { className: "small", onclick: () => attempt(() => mend(word)) }, word));
  $("near").replaceChildren(`This page doesn't know “${shown(unknown)}”: it answers ${about.known.toLocaleString("en")} words by itself. `,
    words.length ? "Closest: " : "", ...words); // prettier-ignore
}

const unusedColor = () => about.colors.find((color) => prompts.every((prompt) => prompt.color !== color)) ?? about.colors[prompts.length % about.colors.length];

/** Run work that may fail, and show the reason if it does. */
async function attempt(work) {
  try {
    return await work();
  } catch (error) {
    say(error.message);
  }
}

// ── showing ──

/** Show all prompts, and scroll to `newest`, for small panels. */
function draw(newest = null) {
  const acts = { fly, remove, rename, setThreshold, teach, undo, forget };
  for (const prompt of prompts) prompt.card = promptCard(prompt, acts);
  $("prompts").replaceChildren(...prompts.map(({ card }) => card));
  view.recolor(prompts.filter((prompt) => prompt.relevancy));
  newest?.card.scrollIntoView({ block: "nearest" });
  drawBoxes();
  writeAddress();
}

function drawBoxes() {
  const boxes = $("boxed").checked ? prompts.filter((prompt) => prompt.box) : [];
  $("boxes").replaceChildren(...boxes.flatMap(outline));
}

const CORNERS = [0, 1, 2, 3, 4, 5, 6, 7], NAMESPACE = "http://www.w3.org/2000/svg";

function outline({ box: { low, high }, color, text }) {
  const corners = CORNERS.map((k) => view.pixel(low.map((value, axis) => ((k >> axis) & 1 ? high[axis] : value))));
  if (!corners.every(Boolean)) return [];
  const edges = CORNERS.flatMap((k) => [1, 2, 4].filter((step) => !(k & step)).map((step) => `M${corners[k]}L${corners[k + step]}`));
  const [path, label] = ["path", "text"].map((tag) => document.createElementNS(NAMESPACE, tag));
  path.setAttribute("d", edges.join(""));
  const top = corners.reduce((best, corner) => (corner[1] < best[1] ? corner : best));
  [["x", top[0]], ["y", top[1] - 6]].forEach(([name, value]) => label.setAttribute(name, value));
  label.textContent = shown(text);
  for (const part of [path, label]) part.style.setProperty("--color", `rgb(${color})`);
  return [path, label];
}

function fly(prompt) {
  const shows = prompt.views.filter((one) => one.shown), views = shows.length ? shows : prompt.views.slice(0, 1);
  if (!views.length) return;
  prompt.place = ((prompt.place ?? -1) + 1) % views.length;
  const best = views[prompt.place], middle = prompt.box?.low.map((value, axis) => (value + prompt.box.high[axis]) / 2);
  view.flyTo(about.views[best.index], middle);
  say(`View ${prompt.place + 1} of ${views.length}: ${best.name}; ${percent(best.area)} of it matches.`);
}

function remove(prompt) {
  prompts.splice(prompts.indexOf(prompt), 1);
  draw();
}

function rename(prompt, name) {
  const before = prompt.text;
  prompt.text = tidy(name).replaceAll("~", " ") || before;
  prompt.named = true;
  keepWord(prompt, before);
  draw();
}

async function setThreshold(prompt, value) {
  prompt.chosen = value;
  await attempt(() => answer(prompt));
  draw();
}

// ── what is this? ──

async function whatIs(x, y, most = 5) {
  await reading;
  if (!about.words) return [];
  latest = await think("whatIs", { camera: view.picking, x, y, most });
  return latest.words;
}

async function tell({ x, y, without }) {
  if (!about.words) return;
  const words = await whatIs(x, y), teaching = prompts.find((prompt) => prompt.examples && prompt.open), { rows } = latest;
  if (teaching && rows.length) return addExample(teaching, without || teaching.without);
  const buttons = words.map(([word, score]) =>
    element("button", { className: "small", onclick: () => attempt(() => ask(word)) }, `${word} ${percent(score)}`));
  const like = element("button", { className: "small", onclick: likeThis }, "Like this");
  $("here").replaceChildren(element("p", {}, words.length ? "Here, words that fit best:" : `Nothing is there${rows.length ? " that has a name" : ""}.`),
    element("div", {}, ...buttons, ...(rows.length ? [like] : []))); // prettier-ignore
  $("here").hidden = false;
}

/** Highlight what looks like the place clicked last; further clicks add examples. */
function likeThis() {
  const number = 1 + Math.max(0, ...prompts.map((prompt) => Number(UNNAMED.exec(prompt.text)?.[1] ?? 0)));
  const prompt = { text: `like this ${number}`, negatives: [], examples: [], color: unusedColor() };
  prompts.push(prompt);
  teach(prompt, true);
  attempt(() => addExample(prompt, false));
}

/** Set whether clicks add examples to this prompt. */
function teach(prompt, open = !prompt.open) {
  for (const other of prompts) other.open = other === prompt && open;
  $("here").hidden = true;
  draw();
}

async function addExample(prompt, without) {
  prompt.examples.push({ rows: latest.rows, without: Boolean(without) });
  await answer(prompt);
  keepWord(prompt);
  draw(prompt);
}

/** Remove the latest example. */
async function undo(prompt) {
  if (prompt.examples.length === 1) return remove(prompt);
  prompt.examples.pop();
  await answer(prompt);
  keepWord(prompt);
  draw();
}

function forget(prompt) {
  store("words", stored("words").filter(({ name }) => name !== prompt.text));
  remove(prompt);
}

/** Keep a named word in this browser; it replaces those with its present and former name. */
function keepWord({ text, examples, named }, before = text) {
  const others = stored("words").filter(({ name }) => ![text, before].includes(name));
  if (named) store("words", [{ name: text, examples }, ...others]);
}

/** Return a word that was named in this browser as a prompt; null if there is none. */
function namedWord(text) {
  const found = stored("words").find(({ name }) => name?.toLowerCase() === text.toLowerCase());
  return found && areExamples(found.examples) ? { text: found.name, examples: found.examples, named: true } : null;
}

/** Return whether these are examples in this scene, and the first one shows what is meant. */
function areExamples(examples) {
  const known = (row) => Number.isInteger(row) && row >= 0 && row < about.count;
  return Array.isArray(examples) && examples.length > 0 && !examples[0].without && examples.every(({ rows }) => rows?.length && rows.every(known));
}

// ── address, history ──

const asTyped = ({ text, negatives }) => `"${text}"` + (negatives.length ? ` not ${negatives.map((one) => `"${one}"`).join(", ")}` : "");
const asExamples = (prompt) => [prompt.text, ...prompt.examples.map(({ rows, without }) => (without ? "-" : "") + rows.join("."))].join("~");

function writeAddress() {
  if (!settled) return;
  const fields = new URLSearchParams({ view: view.address });
  prompts.forEach((prompt) => fields.append(prompt.examples ? "like" : "ask", prompt.examples ? asExamples(prompt) : asTyped(prompt)));
  if ($("not").value) fields.set("not", $("not").value);
  read = `#${fields}`;
  history.replaceState(null, "", read);
}

async function readAddress(turn = clear()) {
  const fields = new URLSearchParams(location.hash.slice(1));
  if (fields.has("view")) view.address = fields.get("view");
  $("not").value = fields.get("not") ?? "";
  settled = false;
  const likes = about.words ? fields.getAll("like") : [];
  try {
    for (const typed of fields.getAll("ask").slice(0, 20)) if (turn === cleared) await ask(typed, turn);
    for (const like of likes.slice(0, 20)) if (turn === cleared) await readExamples(like);
  } finally {
    if (turn === cleared) settle();
  }
}

function settle() {
  settled = true;
  draw();
}

async function readExamples(like) {
  const [text, ...examples] = like.split("~");
  const parsed = examples.map((one) => ({ rows: one.replace("-", "").split(".").map(Number), without: one.startsWith("-") }));
  if (!areExamples(parsed)) return;
  const prompt = { text: tidy(text), negatives: [], examples: parsed, color: unusedColor(), named: !UNNAMED.test(text) };
  prompts.push(prompt);
  await answer(prompt);
}

/** Key of a list kept in this browser for the scene: earlier "prompts" or named "words", latest first. */
const memory = (kind) => `lang3dxl ${kind} ${about.title} ${about.count} ${about.center}`;

function stored(kind) {
  try {
    return [JSON.parse(localStorage.getItem(memory(kind)))].flat().filter(Boolean);
  } catch {
    return []; // the browser keeps nothing
  }
}

function store(kind, list) {
  try {
    localStorage.setItem(memory(kind), JSON.stringify(list.slice(0, MOST_KEPT)));
  } catch {} // the browser keeps nothing
}

const remember = (text) => store("prompts", [text, ...stored("prompts").filter((other) => other !== text)]);

// ── controls ──

async function offer() {
  const typed = $("word").value.split(";").at(-1), before = $("word").value.slice(0, $("word").value.length - typed.length);
  const own = stored("words").map(({ name }) => String(name)), start = tidy(typed).toLowerCase();
  const words = start ? [...own.filter((name) => name.toLowerCase().includes(start)), ...(await think("offered", { typed }))] : [...own, ...stored("prompts").map(String)];
  $("offered").replaceChildren(...[...new Set(words)].map((word) => element("option", { value: before + word })));
}

function listen() {
  let typing, moving;
  $("ask").addEventListener("submit", (event) => {
    event.preventDefault();
    const typed = $("word").value;
    $("word").value = "";
    if (tidy(typed)) attempt(() => ask(typed));
  });
  for (const kind of ["input", "focus"]) $("word").addEventListener(kind, () => reading.then(offer));
  $("not").addEventListener("input", () => {
    clearTimeout(typing);
    typing = setTimeout(() => attempt(answerAll), TYPING);
  });
  $("boxed").addEventListener("change", drawBoxes);
  $("overview").addEventListener("click", () => view.overview());
  $("still").addEventListener("click", () => attempt(saveStill));
  $("link").addEventListener("click", () => attempt(copyLink));
  $("look").addEventListener("change", () => attempt(light));
  view.addEventListener("click", ({ detail }) => attempt(() => tell(detail)));
  view.addEventListener("drawn", findPlaces);
  view.addEventListener("moved", () => {
    drawBoxes();
    clearTimeout(moving);
    moving = setTimeout(writeAddress, 300);
  });
  addEventListener("keydown", (event) => {
    if (event.target.matches("input, select")) return; // Escape empties a search box, or closes its list
    if (event.key === "/") {
      event.preventDefault();
      $("word").focus();
    }
    if (event.key === "Escape") {
      clear();
      $("here").hidden = true;
      settle();
    }
  });
}

async function saveStill() {
  const lines = prompts.map((prompt) => [shown(prompt.text), `rgb(${prompt.color})`]);
  const link = element("a", { download: "scene.png", href: URL.createObjectURL(await view.picture(lines)) });
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 1000);
}

async function copyLink() {
  writeAddress();
  await navigator.clipboard.writeText(location.href);
  say("The link is in the clipboard: it opens what you see.");
}

/** Show the scene in the chosen photo's lighting. */
async function light() {
  const photo = $("look").value;
  const colors = photo ? new Uint8Array(await (await fetched(about.looks[photo])).arrayBuffer()) : view.own;
  if ($("look").value === photo) view.light(colors); // unless a later choice has been read in the meantime
}

// ── start ──

async function fetched(name) {
  const file = await fetch(about?.files?.[name] ?? name); // a written page's data have names by content
  if (!file.ok) throw new Error(`${name} is missing (${file.status}): write the page again.`);
  return file;
}

async function open() {
  about = await (await fetched("scene.json")).json();
  document.title = $("title").textContent = about.title;
  $("credit").textContent = [about.credit, about.license, about.made, ...about.left_out].filter(Boolean).join("\n");
  $("lighting").hidden = !Object.keys(about.looks).length;
  $("look").append(...Object.keys(about.looks).map((name) => element("option", { value: name }, name)));
  for (const control of [...$("ask").elements, $("not")]) control.disabled = !about.words;
  const splats = await (await fetched("splats.bin")).arrayBuffer();
  view = new View(about, $("frame"));
  await view.show(splats);
  listen();
  return splats;
}

async function readMeaning(splats) {
  if (!about.words) return say("This scene has colors alone: it can't be asked.");
  say("Reading what the scene means…");
  const { seconds, known } = await think("load", { description: about, splats });
  Object.assign(about, { known, seconds });
  say(explain(about));
}

/** Show the prompts in the address, or else those that the page opens with. */
async function begin() {
  const turn = cleared;
  addEventListener("hashchange", () => location.hash !== read && attempt(() => readAddress()));
  if (location.hash.length > 1) return readAddress(turn);
  for (const [text, ...negatives] of about.prompts) if (turn === cleared) await ask(asTyped({ text, negatives }), turn);
  if (turn === cleared) settle();
}

const drawing = open(), reading = drawing.then(readMeaning);
window.lang3dxl = {
  ready: reading.then(begin),
  ask: (typed) => ask(typed),
  whatIs,
  get view() {
    return view;
  },
  get seconds() {
    return about.seconds;
  },
};
window.lang3dxl.ready.catch((error) => "told" in $("status").dataset || say(error.message)); // start.js may have said why
