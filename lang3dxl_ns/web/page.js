// The page: the search box and its prompts, answers to clicks, words that are taught, and the keys.
import { $, element, explain, percent, promptCard, say, shown, small } from "./cards.js";
import { Detail } from "./detail.js";
import { isQuestion } from "./grammar.js";
import { Kept, readFields, Steps, written, MOST_PROMPTS } from "./history.js";
import { unpacked } from "./library.js";
import { List } from "./list.js";
import { distanceAsText, drawScale, heightAsText, inShares, setLength } from "./measure.js";
import { keyName } from "./move.js";
import { Photos } from "./photos.js";
import { areExamples, asPython, drawOutline, examplesAsText, examplesFromText, inside, rounded, UNNAMED, wordsFile } from "./teach.js";
import { fetched, request, thinker } from "./think.js";
import { Tour } from "./tour.js";
import { parsePrompts, tidy } from "./vocabulary.js";
import { View } from "./view.js";

const MIDDLE = /^(what('s| is| am i looking at)( this| that| it| here| there)?|was ist das)\W*$/i; // questions about what one sees
const MOST_TRIED = 6, TIE = 0.02, HALF = "50"; // suggested words; relevancies that tell words apart; how many floaters a page hides at first
const prompts = [], taughtHere = new Set(); // names that were taught to the server's scene from here
let about, view, photos, list, tour, steps, kept, settled = false, cleared = 0; // settled: the address has been read; cleared: how often all prompts were removed
let ends = [], outlining = null, chosenLook = "", keeping = Promise.resolve(); // keeping: of the tour, one after another

const think = thinker(
  (done) => say(`Reading what the scene means: ${percent(done)}`),
  () => say("This browser can't run the page's worker: update it."),
);

// ── asking ──

/** Names of the words that this browser keeps. */
const ownNames = () => kept.words.map(({ name }) => String(name));
/** Names that were taught, which prompts and questions never split. */
const names = () => [...about.names, ...ownNames()];
/** Words to offer: own ones, those that the scene answers surely, and all others. */
const words = () => [...new Set([...ownNames(), ...about.suggested, ...about.known])];

/** Describe a prompt for the worker. */
const question = ({ text, negatives, examples, inScene }) => ({ text, negatives, examples: inScene ? null : examples });

/** Return how many Gaussians of the scene so many of chunk 0 stand for. */
const wholeCount = (number) => Math.round((number * (about.detail?.count ?? about.count)) / about.count);

/** Answer a prompt anew. */
async function answer(prompt) {
  const turn = (prompt.turn = {}); // a later answer to the same prompt wins
  if (prompt.examples && !prompt.examples.length) return Object.assign(prompt, { known: true, relevancy: null, threshold: null });
  const found = await think("ask", { ...question(prompt), threshold: prompt.chosen });
  if (turn !== prompt.turn || !found.known) return found;
  return Object.assign(prompt, found, { matching: wholeCount(found.matching), views: null, finding: null });
}

/** Find the views that show prompts best, and their things, once their heat is drawn. */
function findPlaces() {
  for (const prompt of prompts.filter((one) => one.relevancy && !one.dragged)) {
    const { relevancy, threshold, turn, finding } = prompt;
    attempt(() => list.find(prompt));
    if (finding) continue;
    prompt.finding = think("find", { relevancy, threshold }).then((views) => {
      if (turn !== prompt.turn) return;
      prompt.views = views;
      prompt.card.querySelector(".fly").disabled = !views.some((one) => one.shown);
    });
  }
}

/** Drop the answers that are still awaited; returns the turn of those that come next. */
const drop = () => ++cleared;

/** Remove all prompts. */
function clear() {
  drop();
  prompts.length = 0;
  settle();
}

/** Ask prompts as if typed, separated by `;`. Resolves to the answer to the last one. turn: what `drop` returned last. */
async function ask(typed, turn = cleared) {
  await reading;
  quiet();
  if (about.words && MIDDLE.test(typed)) {
    const { x, y } = middle();
    describe(await whatIs(x, y), [x, y]);
    say("This is in the middle of the view. Click on anything else to learn what it is.");
    return { known: true };
  }
  if (about.words && isQuestion(String(typed), names(), about.known)) return answerQuestion(String(typed));
  let found = null;
  for (const { text, negatives } of about.words ? parsePrompts(String(typed), names()) : []) {
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
    if (!card.color) add(card);
    draw(settled ? card : null);
    if (found.meant && found.trust.level !== "sure") offerMeant(found.meant, card);
  }
  if (about.words && !found && turn === cleared && tidy(String(typed))) say("The prompt is empty: type what to look for, such as rose window.");
  const { known = false, doubtful = true, threshold = null, peak = 0, matching = 0 } = found ?? {};
  return { known, doubtful, threshold, peak, matching };
}

/** Answer a question about things, such as "how many windows" or "highest tower". */
async function answerQuestion(typed) {
  const told = await list.question(typed, names(), async (word) => (await ask(quoted(word))).known);
  if (told) say(told);
  return { known: told !== null, told };
}

function add(prompt) {
  prompts.push(Object.assign(prompt, { color: unusedColor() }));
}

/** Offer the word that a misspelled one most likely means; a click puts it in its place. */
function offerMeant(meant, prompt) {
  const mend = () => (prompts.includes(prompt) && remove(prompt), ask(asTyped({ text: meant, negatives: prompt.negatives })));
  $("near").append(element("span", {}, "Did you mean ", small(meant, () => attempt(mend)), "?"));
}

/** Offer the words closest to an unknown one; a click puts a word in its place. */
function offerClosest({ unknown, closest }, { text, negatives }) {
  const mended = (word) => ({ text: text === unknown ? word : text, negatives: negatives.map((one) => (one === unknown ? word : one)) });
  const buttons = closest.map((word) => askFor(word, asTyped(mended(word))));
  $("near").append(element("span", {}, `This page doesn't know “${shown(unknown)}”: it answers ${about.known.length.toLocaleString("en")} words by itself. `,
    buttons.length ? "Closest: " : "", ...buttons)); // prettier-ignore
}

/** Create a button that asks for a word. */
const askFor = (word, typed = quoted(word), label = word) => small(label, () => attempt(() => ask(typed)));
const unusedColor = () => about.colors.find((color) => prompts.every((prompt) => prompt.color !== color)) ?? about.colors[prompts.length % about.colors.length];

/** Take away messages about what was done before. */
function quiet() {
  $("near").replaceChildren();
  say(explain(about), true);
}

/** Run work that may fail, and show the reason if it does. */
async function attempt(work) {
  try {
    return await work();
  } catch (error) {
    say(error.message);
  }
}

// ── showing ──

/** Show all prompts, and scroll to `newest`, for small panels. A card stays in its place while one types in it. */
function draw(newest = null) {
  const acts = { fly, remove, rename, dragThreshold, setThreshold, teach, outline, save, forget }, focused = document.activeElement;
  const from = focused.closest("#prompts > li"), label = focused.ariaLabel ?? focused.textContent, shownHere = $("prompts").children;
  list.tidy();
  for (const prompt of prompts) promptCard(prompt, acts).append(list.part(prompt) ?? "");
  for (const card of [...shownHere]) if (!prompts.some((prompt) => prompt.card === card)) card.remove();
  prompts.forEach(({ card }, k) => shownHere[k] === card || $("prompts").insertBefore(card, shownHere[k] ?? null));
  if (!focused.isConnected) [...(from?.querySelectorAll("button, input, summary") ?? [])].find((one) => (one.ariaLabel ?? one.textContent) === label)?.focus();
  $("try").hidden = prompts.length > 0;
  view.recolor(prompts.filter((prompt) => prompt.relevancy));
  newest?.card.scrollIntoView({ block: "nearest" });
  drawBoxes();
  attempt(drawShown);
  keepAddress();
}

function drawBoxes() {
  drawScale(about, view);
  $("boxes").replaceChildren(...list.outlines());
}

/** Draw the boxes of what this view shows. */
const drawShown = async () => (await list.look()) && drawBoxes();

function fly(prompt) {
  const views = prompt.views.filter((one) => one.shown);
  if (!views.length) return;
  prompt.place = ((prompt.place ?? -1) + 1) % views.length;
  const best = views[prompt.place];
  photos.hide(false);
  view.mover.fly(view.mover.standing(about.views[best.index], best.target));
  say(`View ${prompt.place + 1} of ${views.length}: ${best.name}; ${percent(best.area)} of it matches.`);
}

function remove(prompt) {
  prompts.splice(prompts.indexOf(prompt), 1);
  quiet();
  draw();
}

function rename(prompt, name) {
  const before = prompt.text;
  prompt.text = tidy(name).replaceAll("~", " ") || before;
  prompt.named = true;
  keepWord(prompt, before);
  draw();
  attempt(() => teachScene(prompt, before));
}

/** Follow a threshold that is being dragged: its heat, nothing else. */
function dragThreshold(prompt, value) {
  Object.assign(prompt, { chosen: value, threshold: value, dragged: true });
  const end = prompt.card.querySelector(".ends span");
  if (end) end.textContent = value.toFixed(2);
  view.recolor(prompts.filter((one) => one.relevancy));
}

function setThreshold(prompt, value) {
  dragThreshold(prompt, value);
  Object.assign(prompt, { dragged: false, finding: null, views: null, turn: {}, matching: wholeCount(prompt.relevancy.filter((one) => one > value).length) });
  quiet(); // what was told of the view counted the matches of before
  draw();
}

// ── what is this? ──

async function whatIs(x, y, most = 5) {
  await reading;
  return about.words ? think("whatIs", { camera: view.picking, x, y, most }) : { words: [], rows: [] };
}

/** Mark an end of a distance; the second one tells it. */
async function measure(x, y) {
  const point = await think("point", { camera: view.picking, x, y });
  if (!point) return say("Nothing is there: click another place.");
  ends = ends.length === 1 ? [...ends, point] : [point];
  $("known").hidden = ends.length === 1;
  $("length").value = "";
  say(ends.length === 1 ? "Click the other end." : distanceAsText(ends, about));
}

/** Let the length between the two ends set the scale. */
function typeLength() {
  setLength(about, ends, Number($("length").value.replace(",", ".")));
  say(distanceAsText(ends, about));
  draw();
}

async function tell({ x, y, without }) {
  if (!about.words) return;
  if ($("measuring").checked) return measure(x, y);
  const teaching = prompts.find((prompt) => prompt.examples && prompt.open);
  if (teaching) return addMark(teaching, [[x, y]], without || teaching.without);
  const found = await whatIs(x, y);
  if (!list.pick(found.rows)) describe(found, [x, y]);
}

/** Tell which words fit a pixel. */
function describe({ words, rows, point }, pixel) {
  const best = words[0]?.[1] ?? 0;
  const tied = words.filter(([, score]) => score > best - TIE), several = tied.length > 2;
  const buttons = (several ? tied : words).map(([word, score]) => askFor(word, quoted(word), several ? word : `${word} ${percent(score)}`));
  quiet();
  const told = several ? "Here several words fit equally well, so none is sure:" : "Here, words that fit best:";
  $("here").replaceChildren(element("p", {}, words.length ? told : `Nothing is there${rows.length ? " that has a name" : ""}.`),
    element("div", {}, ...buttons, ...(rows.length ? [small("Like this", () => attempt(() => likeThis([pixel])))] : [])),
    ...(point ? [element("p", {}, `It is ${heightAsText(point, about)}${inShares(about)}.`)] : [])); // prettier-ignore
  $("here").hidden = false;
}

/** Turn around what is at a pixel, from now on. */
async function focusOn({ x, y }) {
  const point = about.words ? await think("point", { camera: view.picking, x, y }) : null;
  if (point) view.mover.focus(point);
}

const middle = () => ({ x: view.frame.clientWidth / 2, y: view.frame.clientHeight / 2 });

// ── teaching ──

/** Start a word to be taught: further clicks and outlines mark it. */
function startWord() {
  const number = 1 + Math.max(0, ...prompts.map((prompt) => Number(UNNAMED.exec(prompt.text)?.[1] ?? 0)));
  const prompt = { text: `like this ${number}`, negatives: [], examples: [] };
  add(prompt);
  teach(prompt, true);
  return prompt;
}

/** Highlight what looks like the place clicked last; further clicks add examples. */
const likeThis = (pixels) => addMark(startWord(), pixels, false);

/** Set whether clicks add examples to this prompt. A word without any mark is given up. */
function teach(prompt, open = !prompt.open) {
  for (const other of prompts) other.open = other === prompt && open;
  if (!open && !prompt.examples.length) prompts.splice(prompts.indexOf(prompt), 1);
  $("here").hidden = true;
  quiet();
  if (open && !prompt.examples.length) say("Click on it in the view, or outline it. Then give it a name.");
  draw(prompts.includes(prompt) ? prompt : null);
}

/** Mark pixels of the view, or an outline around them, as the word or as something else. */
async function addMark(prompt, pixels, without, outline = null) {
  const prefer = prompt.examples.flatMap(({ photo }) => (photo === undefined ? [] : [about.cameras[photo].name]));
  const there = photos.shown && (outline ?? pixels).map((pixel) => photos.within(pixel)), inPhoto = there && there.every(Boolean);
  const { rows, photo, points } = await think("mark", { camera: view.picking, pixels, prefer });
  if (!rows.length) return say("Nothing with a meaning is there: mark another place.");
  const index = about.cameras.findIndex(({ name }) => name === (inPhoto ? photos.shown.name : photo));
  const place = index < 0 ? {} : inPhoto ? { photo: index, [outline ? "outline" : "points"]: rounded(there) } : { photo: index, points: rounded(points) };
  prompt.examples.push({ rows, without: Boolean(without && prompt.examples.length), ...place });
  prompt.inScene = false;
  await answer(prompt);
  keepWord(prompt);
  quiet();
  draw(prompt);
  await teachScene(prompt);
}

/** Let the user outline the word in the view or in the photo that is shown. */
async function outline(prompt) {
  outlining = new AbortController();
  say("Draw around it, without lifting the finger or the button. Escape gives up.");
  const found = await drawOutline($("stage"), outlining.signal);
  outlining = null;
  quiet();
  if (found) await attempt(() => addMark(prompt, inside(found), prompt.without, found));
}

/** Post to the live server: resolves to whether it did what was asked, and to what it says. */
async function post(path, content) {
  try {
    const answered = await request(path, { method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify(content) });
    return { done: answered.ok, told: await answered.text() };
  } catch (error) {
    return { done: false, told: error.message };
  }
}

/** Keep the tour in the scene's file behind a live page, or else in the address. */
async function keepTour() {
  const kept = tour.stops.length ? written({ prompts: [], stops: tour.fields }) : "";
  const { done, told } = about.live ? await post("api/tour", { tour: kept, before: tour.before }) : { done: false };
  if (done) about.tour = tour.before = kept;
  else if (about.live) say(`The scene does not keep the tour: ${told}`);
  tour.saved = done;
  keepAddress();
}

/** Show the tour of an address. One without a tour shows the scene's own on a live page, whose file keeps it. */
function showTour(stops) {
  const own = readFields(about.tour).stops, saved = about.live && (!stops.length || String(stops) === String(own));
  if (!saved || !tour.saved) Object.assign(tour, { fields: saved ? own : stops, before: saved ? about.tour : "" });
  tour.saved = saved;
}

/** Teach a named word to the scene behind a live page, which answers it from then on; its card says what became of it. */
async function teachScene(prompt, before = prompt.text) {
  if (!prompt.named) return;
  const marks = asPython(prompt.examples, about.cameras), answered = about.live && marks.length ? await post("api/teach", { name: prompt.text, before, examples: marks }) : null;
  if (!about.live) prompt.told = "This browser keeps it. Save writes a file for lang3dxl words --load, which learns it from the photos.";
  else if (answered && !answered.done) prompt.told = `The scene did not learn it: ${answered.told}`;
  else if (answered) {
    taughtHere.add(prompt.text);
    await think("forget", { texts: [prompt.text, before] });
    prompt.inScene = true;
    await answer(prompt);
    prompt.told = JSON.parse(answered.told).told;
  }
  draw();
}

function save(prompt) {
  download("words.json", new Blob([wordsFile([prompt], about)], { type: "application/json" }));
  say("Teach it to the scene: lang3dxl words SCENE --load words.json");
}

async function forget(prompt) {
  kept.words = kept.words.filter(({ name }) => name !== prompt.text);
  remove(prompt);
  taughtHere.delete(prompt.text);
  if (!about.live) return;
  const { done, told } = await post("api/teach", { name: prompt.text, before: prompt.text, examples: [] });
  await think("forget", { texts: [prompt.text] });
  say(done ? JSON.parse(told).told : `The scene did not forget it: ${told}`);
}

/** Keep a named word in this browser; it replaces those with its present and former name. */
function keepWord({ text, examples, named }, before = text) {
  if (named) kept.words = [{ name: text, examples }, ...kept.words.filter(({ name }) => ![text, before].includes(name))];
}

/** Return a word that was named in this browser as a prompt; null if there is none. */
function namedWord(text) {
  const found = kept.words.find(({ name }) => name && tidy(name).toLowerCase() === text.toLowerCase());
  return found && areExamples(found.examples, about.count) ? { text: found.name, examples: found.examples, named: true } : null;
}

// ── address ──

const quoted = (text) => `"${text}"`;
const asTyped = ({ text, negatives }) => quoted(text) + (negatives.length ? ` not ${negatives.map(quoted).join(", ")}` : "");

function asField(prompt) {
  const { examples, color, chosen } = prompt;
  return { kind: examples ? "like" : "ask", text: examples ? examplesAsText(prompt.text, examples) : asTyped(prompt), at: chosen, hue: about.colors.indexOf(color) };
}

/** What is shown, as an address. stops: of the tour, unless the scene's file keeps it. */
const shownNow = (stops = tour.saved ? [] : tour.fields) =>
  written({
    stops,
    view: view.mover.address, shape: view.mover.aspect.toFixed(2), walk: view.mover.walking ? 1 : "", hide: $("hide").value === HALF ? "" : $("hide").value, look: chosenLook,
    unit: about.unit, cameras: $("cameras").ariaPressed === "true" ? 1 : "", photo: photos.shown?.name, ...list.fields,
    prompts: prompts.filter(({ examples }) => !examples || examples.length).map(asField),
  }); // prettier-ignore

/** Keep what is shown in the address. own: whether that is a step of its own; what changes during a flight belongs to
 * the flight's. */
function keepAddress(own = view.mover.flight ? false : undefined) {
  if (settled) steps.keep(shownNow(), own);
}

/** Show what an address says, after a flight if it is a stop of the tour. Prompts that are shown already stay as they are. */
async function apply(hash, turn = drop(), isStop = false) {
  const wanted = readFields(hash), found = [], open = prompts.find((prompt) => prompt.open)?.text;
  settled = false;
  outlining?.abort();
  quiet();
  photos.hide();
  if (!isStop) tour.stop(), showTour(wanted.stops);
  const there = view.mover.goTo(wanted.view, isStop, Number(wanted.shape) || 0), photo = photos.list.find((one) => one.photo && one.name === wanted.photo);
  view.mover.walk(wanted.walk === "1");
  if (!isStop) about.unit = Number(wanted.unit) > 0 && Number.isFinite(Number(wanted.unit)) ? Number(wanted.unit) : null;
  $("cameras").ariaPressed = String(wanted.cameras === "1");
  $("hide").value = wanted.hide ?? HALF;
  hideFloaters();
  attempt(() => chooseLook(wanted.look ?? ""));
  try {
    const listed = wanted.prompts.flatMap((one) => specify(one).map((specified) => [one, specified]));
    for (const [one, specified] of about.words ? listed.slice(0, MOST_PROMPTS) : []) {
      const old = prompts.find((prompt) => String(Object.values(asField(prompt)).slice(0, 3)) === String(Object.values(asField({ ...specified, color: null })).slice(0, 3)));
      const prompt = old ?? specified, answered = old ?? (await answer(prompt));
      if (turn !== cleared) return;
      if (!answered.known) offerClosest(answered, prompt);
      else if (!found.includes(prompt)) found.push(Object.assign(prompt, { color: about.colors[one.hue % about.colors.length], open: prompt.text === open }));
    }
    prompts.splice(0, prompts.length, ...found);
    list.fields = wanted;
    for (const prompt of found) if (prompt.named) keepWord(prompt);
    for (const prompt of found) if (taughtHere.has(prompt.text) && !prompt.inScene) attempt(() => teachScene(prompt));
    if (photo && isStop) photos.coming = photo;
    else if (photo) photos.show(photo);
    const lost = { view: wanted.view && !there, photo: wanted.photo && !photo, lighting: wanted.look && !chosenLook, marks: wanted.prompts.some((one) => one.kind === "like" && !specify(one).length) };
    const told = Object.keys(lost).filter((name) => lost[name]);
    if (told.length) say(`This link asks for what this page doesn't have: ${told.join(", ")}.`);
  } finally {
    if (turn === cleared) settle(hash);
  }
}

/** Read a prompt of an address: { kind, text, at } as prompts without answers. */
function specify({ kind, text, at }) {
  if (kind === "ask") return parsePrompts(text, names()).map((prompt) => ({ ...prompt, ...(at !== undefined && { chosen: at }) }));
  const read = examplesFromText(text, about);
  if (!read || !tidy(read.name)) return [];
  return [{ text: tidy(read.name), negatives: [], examples: read.examples, named: !UNNAMED.test(read.name), ...(at !== undefined && { chosen: at }) }];
}

/** End the reading of an address: what is shown is what it says now. */
function settle(hash = null) {
  settled = true;
  if (hash !== null) steps.keep(shownNow(), false);
  draw();
}

// ── controls ──

/** Offer words while the user types; the browser chooses among them. */
function offer({ type }) {
  const typed = $("word").value, before = typed.slice(0, typed.lastIndexOf(";") + 1), { dataset } = $("offered");
  if (type === "input" && dataset.before === before) return; // thousands of words, of which only the prefix changes
  dataset.before = before;
  $("offered").replaceChildren(...words().map((word) => element("option", { value: before + word })));
}

function on(id, kind, act) {
  $(id).addEventListener(kind, (event) => attempt(() => act(event)));
}

function listen() {
  let moving;
  for (const kind of ["input", "focus"]) on("word", kind, (event) => reading.then(() => offer(event)));
  on("clear", "click", clear);
  on("overview", "click", () => (photos.hide(false), quiet(), view.mover.overview()));
  on("teach", "click", () => startWord().card.querySelector("button").focus()); // no name yet: a phone's keyboard would cover the view
  on("still", "click", async () => download("scene.png", await view.picture()));
  on("link", "click", copyLink);
  on("look", "change", () => chooseLook($("look").value).then(() => keepAddress()));
  on("hide", "input", hideFloaters);
  on("hide", "change", () => keepAddress());
  on("undo", "click", () => steps.undo());
  on("redo", "click", () => steps.redo());
  on("walk", "click", () => (view.mover.walk(), keepAddress(), $("frame").focus()));
  on("cameras", "click", ({ currentTarget }) => {
    $("cameras").ariaPressed = String($("cameras").ariaPressed !== "true");
    photos.draw();
    keepAddress();
  });
  on("length", "change", typeLength);
  on("measuring", "change", () => ((ends = []), ($("known").hidden = true), $("measuring").checked ? say("Click one end of what you measure.") : quiet()));
  on("free", "change", () => (view.mover.free = $("free").checked));
  on("fold", "click", () => fold());
  on("full", "click", () => (document.fullscreenElement ? document.exitFullscreen() : document.documentElement.requestFullscreen()));
  $("full").hidden = !document.fullscreenEnabled;
  document.addEventListener("fullscreenchange", () => ($("full").ariaPressed = String(Boolean(document.fullscreenElement))));
  view.addEventListener("click", ({ detail }) => attempt(() => tell(detail)));
  view.addEventListener("double", ({ detail }) => attempt(() => focusOn(detail)));
  view.addEventListener("drawn", findPlaces);
  list.addEventListener("change", () => draw());
  view.addEventListener("moved", () => {
    drawBoxes();
    clearTimeout(moving);
    moving = setTimeout(() => (keepAddress(), attempt(drawShown)), 300);
  });
  view.mover.addEventListener("far", () => (($("here").hidden = true), keepAddress(true))); // what is told of a place is of this view
  view.mover.addEventListener("walks", () => ($("walk").ariaPressed = String(view.mover.walking)));
  view.mover.addEventListener("blocked", () => say("The photos show nothing of what is there: hold Shift, or choose “Go anywhere” under More, to go on."));
  addEventListener("keydown", (event) => press(event));
}

/** Answer a key that means the same everywhere on the page. */
function press(event) {
  const typing = event.target.matches("input:not([type=range], [type=checkbox]), select"), key = keyName(event), command = event.ctrlKey || event.metaKey;
  if (key === "Escape") {
    if (typing) event.preventDefault(); // or it would empty the search box
    return typing ? event.target.blur() : close();
  }
  if (typing || event.altKey) return;
  const again = key === "y" || event.shiftKey, onPicture = event.target === $("frame") || event.target === document.body;
  const act = command
    ? { z: () => (again ? steps.redo() : steps.undo()), y: () => steps.redo() }[key]
    : { "/": () => (fold(false), $("word").focus()), ",": () => photos.step(-1), ".": () => photos.step(1), "[": () => list.step(-1), "]": () => list.step(1), ...(onPicture && { Enter: () => tell(middle()), f: () => focusOn(middle()) }) }[key];
  if (!act) return;
  event.preventDefault();
  attempt(async () => act());
}

/** Hide the panel but for messages, or show it. */
function fold(folded = !document.body.classList.contains("folded")) {
  $("fold").ariaExpanded = String(!document.body.classList.toggle("folded", folded));
}

/** Close what is open, the latest first; nothing is lost. */
function close() {
  const open = prompts.find((prompt) => prompt.open);
  if (outlining) outlining.abort();
  else if (photos.shown || photos.coming) photos.hide();
  else if (!$("here").hidden) $("here").hidden = true;
  else if (open) teach(open, false);
  else if (list.leave()) return;
  else quiet();
}

function download(name, content) {
  const link = element("a", { download: name, href: URL.createObjectURL(content) });
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 1000);
}

async function copyLink() {
  keepAddress();
  if (!navigator.clipboard) return say("Copy the link from the browser's address bar: it opens what you see."); // without https
  await navigator.clipboard.writeText(new URL(shownNow(tour.fields), location.href).href);
  say("The link is in the clipboard: it opens what you see.");
}

/** Show the scene in a photo's lighting, which the user chose. */
async function chooseLook(photo) {
  chosenLook = photo in about.looks ? photo : "";
  await light(chosenLook);
}

/** Show the scene in a photo's lighting. */
async function light(photo) {
  $("look").value = photo;
  const colors = photo ? new Uint8Array(await (await fetched(about.looks[photo], about)).arrayBuffer()) : view.root.own;
  if ($("look").value === photo && view.root.plain !== colors) view.light(colors); // unless a later choice has been read in the meantime
}

function hideFloaters() {
  const { floats } = view.root;
  if (!floats) return;
  const limit = 255 - Math.round(2.55 * Number($("hide").value));
  view.hide(limit);
  if (about.words) think("hide", { floats, limit });
}

// ── start ──

async function open() {
  on("ask", "submit", async () => {
    const typed = $("word").value;
    $("word").value = "";
    await window.lang3dxl.ready; // one may type while the scene loads
    return tidy(typed) ? ask(typed) : null;
  });
  about = await (await fetched("scene.json")).json();
  kept = new Kept(about);
  document.title = $("title").textContent = about.title;
  $("credit").textContent = [about.credit, about.license, about.made, ...about.left_out].filter(Boolean).join("\n");
  $("lighting").hidden = !Object.keys(about.looks).length;
  $("look").append(...Object.keys(about.looks).map((name) => element("option", { value: name }, name)));
  for (const control of [...$("ask").elements, $("teach"), $("measuring")]) control.disabled = !about.words;
  const splats = await (await fetched("splats.bin", about)).arrayBuffer();
  await unpacked;
  view = new View(about, $("frame"));
  list = new List(about, think, view, prompts);
  photos = new Photos(about, view, (name) => attempt(() => light(name in about.looks ? name : chosenLook)));
  photos.changed = keepAddress;
  tour = new Tour(() => shownNow([]), (hash) => attempt(() => apply(hash, drop(), true)), () => (keeping = keeping.then(() => attempt(keepTour))));
  steps = new Steps((hash) => attempt(() => apply(hash)), () => {
    $("undo").disabled = !steps.past;
    $("redo").disabled = !steps.future;
  }); // prettier-ignore
  Object.assign(window.lang3dxl, { view, tour });
  await view.show(splats);
  listen();
  return splats;
}

async function readMeaning(splats) {
  quiet();
  if (!about.words) return;
  about.known = await think("load", { description: about, splats });
  quiet();
  $("try").replaceChildren("Try: ", ...words().slice(0, MOST_TRIED).map((word) => askFor(word)));
}

/** Read which Gaussians float, once the page answers. */
async function readFloaters() {
  view.root.floats = new Uint8Array(await (await fetched(about.floaters, about)).arrayBuffer());
  $("floating").hidden = false;
  hideFloaters();
}

/** Show the prompts in the address, or else those that the page opens with. */
async function begin() {
  const turn = cleared;
  if (about.words) setTimeout(() => think("space").then((space) => (view.mover.space = space))); // behind the prompts
  setTimeout(() => attempt(readFloaters));
  if (about.detail) new Detail(about, view, think, { read: (name) => fetched(name, about), question, failed: (error) => say(error.message) });
  const { stops, play } = readFields(location.hash);
  if (location.hash.length > 1) await apply(location.hash, turn);
  else for (const [text, ...negatives] of about.prompts) if (turn === cleared) await ask(asTyped({ text, negatives }), turn);
  if (!stops.length) showTour(readFields(about.tour).stops);
  if (location.hash.length <= 1 && turn === cleared) settle("");
  if (play) tour.play();
}

const drawing = open(), reading = drawing.then(readMeaning);
window.lang3dxl = {
  ready: reading.then(begin),
  ask: (typed) => ask(typed),
  clear,
  whatIs: async (x, y, most) => (await whatIs(x, y, most)).words,
  prompts,
};
if ("asked" in $("ask").dataset) $("ask").requestSubmit(); // before this module ran: see start.js
window.lang3dxl.ready.catch((error) => say(error.message));
