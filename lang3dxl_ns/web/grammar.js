// Questions about things: counts, superlatives, ordinals and relations, as in Python's things/grammar.py.
import { dot } from "./answer.js";
import language from "./language.js";
import { held, HELD } from "./vocabulary.js";

const { grammar } = language, { BESIDE, INSIDE, CLOSE, VIEWS, SURE, MISSED } = language.things;
const has = (table, word) => Object.hasOwn(table, word), listed = (phrases) => (Array.isArray(phrases) ? phrases : Object.keys(phrases));
const any = (...kinds) => kinds.flatMap(listed).sort((a, b) => b.length - a.length).join("|");
const plain = (text) => text.trim().replace(new RegExp(`^(?:(?:${any(language.articles)})(?:\\s+|$))+`), "");

/** Parse a question: { word, count, superlative, nth, along, relation, others: what it refers to, among: what they must
 * belong to too, without: what it leaves out }. Quotes hold
 * a phrase, and so do names, which were taught. Throws an error, which names the part, for what the grammar doesn't know. */
export function parse(text, names = []) {
  const { rest, count, restored } = opened(text, names);
  if (rest.length > grammar.longest) throw new Error(`this question has ${rest.length.toLocaleString("en")} letters: ask for one thing, in ${grammar.longest} at most`);
  try {
    return { ...request(rest, restored), count };
  } catch (error) {
    throw new Error(restored(error.message).replaceAll(" :", ":"));
  }
}

/** Cut off how a question begins and ends. */
function opened(text, names) {
  const { text: typed, restored } = held(text, names);
  const ends = `[${language.ends}]`, relation = any(grammar.relations), tail = any(grammar.tail);
  let rest = typed.toLowerCase().replace(new RegExp(`^${ends}+|(?<!${ends})${ends}+$`, "g"), "").split(/\s+/).filter(Boolean).join(" ");
  rest = rest.replace(new RegExp(wholeWords(any(grammar.same)), "gu"), (word) => grammar.same[word]);
  const cut = (pattern) => rest !== (rest = rest.replace(pattern, ""));
  rest = rest.replace(new RegExp(`(?<=st|nd|rd|th)-(?=(?:${any(grammar.superlatives)}) )`, "g"), " "); // second-highest
  cut(new RegExp(`^(?:${any(language.lead)})\\s+`));
  rest = plain(rest);
  const count = cut(new RegExp(`^(?:${any(language.count)})\\s+`));
  cut(new RegExp(`^(?:which|what) (?=.+ (?:are|is|${tail}) (?:${relation}) )|,? (?:${tail})$| (?:(?:that |which )?(?:are|is)|${tail})(?= (?:not )?(?:${relation}) )`, "g"));
  return { rest, count, restored };
}

function request(rest, restored) {
  const asked = { word: "", count: false, superlative: null, nth: null, along: null, relation: null, others: [], among: null, without: null };
  const relations = any(grammar.relations);
  let leftOut = null, also = null, found = new RegExp(`^(.+?),? and ((?:not )?(?:${relations}) .+)$`).exec(rest);
  if (found) [rest, also] = [found[1], found[2]];
  found = /^(.+?),? (?:but |and )?not ((?!.* not ).+)$/.exec(rest);
  if (found) [rest, leftOut] = [found[1], found[2]];
  found = new RegExp(`^(.+?) (${relations}) (.+)$`).exec(rest);
  if (found && !has(grammar.from, plain(found[3]))) {
    [rest, asked.relation, asked.others] = [found[1], grammar.relations[found[2]], found[3].split(/\s+and\s+/).map((part) => request(part, restored))];
    if (asked.others.length > (asked.relation === "between" ? 2 : 1)) throw new Error(`${found[2]} ${found[3]}: name one thing, or two with between … and …`);
  }
  const whole = rest;
  found = new RegExp(`^(.+?) (?:from|on) (?:the )?(${any(grammar.from)})$`).exec(rest);
  if (found) [rest, asked.along] = [found[1], found[2]];
  rest = plain(rest);
  const [, place, ordered] = new RegExp(`^(${any(grammar.ordinals)}|[1-9]\\d*(?:st|nd|rd|th)) (.+)$`).exec(rest) ?? [];
  if (ordered) [asked.nth, rest] = [grammar.ordinals[place] ?? parseInt(place), ordered];
  const [, superlative, noun] = new RegExp(`^(${any(grammar.superlatives)}) (?!of(?![\\p{L}\\p{N}_]))(.+)$`, "u").exec(rest) ?? [];
  if (noun) [asked.superlative, rest] = [superlative, noun];
  checkName(restored(rest) && rest); // quotes may hold nothing
  if (asked.nth && !asked.along && !noun) throw new Error(`${place} ${rest}: say from which side, such as the ${place} ${rest} from the left`);
  if (asked.along && (noun || !asked.nth)) throw new Error(`${whole}: say which one, such as the second from the ${asked.along}`);
  if (leftOut && new RegExp(`^(?:${relations}) `).test(leftOut)) leftOut = `${rest} ${leftOut}`; // windows not on the tower: without windows on the tower
  return { ...asked, word: restored(rest), among: also && request(`${rest} ${also}`, restored), without: leftOut && request(leftOut, restored) };
}

const KINDS = ["asks", "unknown", "ordinals", "superlatives", "from", "relations"].map((kind) => grammar[kind]);
const wholeWords = (phrases) => `(?<![\\p{L}\\p{N}_-])(?:${phrases})(?![\\p{L}\\p{N}_-])`;
const UNUSED = new RegExp(`${wholeWords(`${any(...KINDS)}|\\p{Nd}[\\p{L}\\p{N}_]*`)}|[,;]|['’]s(?![\\p{L}\\p{N}_])`, "gu");

function checkName(name) {
  if (!name) throw new Error("this names no thing: ask for one, such as how many windows");
  const unused = name.replace(new RegExp(`${HELD}.*?${HELD}`, "g"), "").match(UNUSED);
  if (!unused) return;
  throw new Error(`${name}: a question can't use ${[...new Set(unused)].join(", ")} here; ask how many windows, for the highest tower, ` +
    "the third window from the left, or windows above the portal; quotes hold a phrase"); // prettier-ignore
}

const PLACES = listed(grammar.superlatives).filter((word) => !has(grammar.from, word));
const ASKS = new RegExp(`^(?:${any(grammar.ordinals)}|\\d+(?:st|nd|rd|th)) |${wholeWords(any(grammar.asks, PLACES))}|${wholeWords(any(grammar.relations))}(?! (?:the )?${wholeWords(any(language.places))})`, "u");

/** Whether what was typed asks more than where something is, perhaps with words that the grammar has no answer to. known:
 * phrases that hold such words and are none. */
export function isQuestion(text, names = [], known = []) {
  try {
    return partsOf(parse(text, names)).some(({ count, superlative, nth, relation }) => count || superlative || nth || relation);
  } catch {
    const { rest, count } = opened(text, names);
    return !known.includes(text.trim().toLowerCase()) && (count || ASKS.test(plain(rest)));
  }
}

const orderOf = ({ superlative, along }) => grammar.superlatives[superlative] ?? grammar.from[along] ?? ["", 0];
const partsOf = (request) => [request, ...[request.without, request.among, ...request.others].flatMap((part) => (part ? partsOf(part) : []))];
export const wordsOf = (request) => [...new Set(partsOf(request).map(({ word }) => word))];

/** Choose the things that a request asks for. things: those of each word; view: { right, up, ahead, shown: ids of the
 * things that one sees, which alone are numbered from left to right; none: all }. Throws an error if a thing that the relation
 * refers to is not found, or if there are fewer than the ordinal asks for. */
export function answerTo(request, things, view) {
  const { word, relation, others, nth, among, without } = request;
  let chosen = things[word], where = "";
  if (without) {
    const gone = answerTo(without, things, view);
    chosen = chosen.filter(({ id }) => !gone.some((other) => other.id === id));
  }
  if (among) {
    const both = answerTo(among, things, view);
    chosen = chosen.filter(({ id }) => both.some((other) => other.id === id));
  }
  if (relation) {
    const there = others.map((other) => answerTo(other, things, view)), missing = there.findIndex((some) => !some.length);
    if (missing >= 0) throw new Error(`no ${others[missing].word} found, to which a relation has an answer: leave it out, or teach the word`);
    if (relation === "between" && new Set(there.flat().map(({ id }) => id)).size < 2) throw new Error(`${others[0].word}: only one found, and between needs two`);
    chosen = chosen.filter((thing) => related(thing, relation, there, view));
  }
  const [kind, sign] = orderOf(request), place = nth ?? 1;
  if (!sign) return chosen;
  if (kind === "left" && view.shown && chosen.length) [chosen, where] = [chosen.filter(({ id }) => view.shown.has(id)), " in this view"];
  if (chosen.length < place && (nth || where)) throw new Error(`${word}: ${chosen.length ? `only ${chosen.length}` : "none"} found${where}, so there is no number ${place}`);
  return [...chosen].sort((a, b) => sign * (measure(a, kind, view) - measure(b, kind, view))).slice(place - 1, place);
}

/** Tell which relations refer to any of several things, such as *the portal* where five are found. */
export function assumed(request, things, view, shown = (word) => word) {
  return partsOf(request).flatMap(({ relation, others }) => others.flatMap((other) => {
    const { length } = answerTo(other, things, view);
    return length > (relation === "between" && others.length === 1 ? 2 : 1) ? [`${shown(other.word)}: ${length} found, any of them counts`] : [];
  })).join("; "); // prettier-ignore
}

/** Those of the things that three or more photos show, and over .6 as many as show the typical one. */
export function sureOf(things) {
  const seen = things.map(({ views }) => views).sort((a, b) => a - b), half = seen.length >> 1;
  const typical = seen.length ? (seen[half] + seen[seen.length - 1 - half]) / 2 : 0;
  return things.filter(({ views }) => views > Math.max(VIEWS, SURE * typical));
}

/** How many there are, such as "34, perhaps 31 to 37". after: a text behind the number. */
export function count({ things, candidates }, after = "") {
  const least = sureOf(things).length, most = Math.max(things.length + candidates.length, Math.floor(MISSED * things.length));
  return things.length + after + (least === most ? "" : `, perhaps ${least} to ${most}`);
}

/** Tell what may make an answer wrong, or null. found: { things, candidates } of each word; shown: writes a word. */
export function unsure(request, found, view, shown = (word) => word) {
  const of = (changed) => Object.fromEntries(Object.entries(found).map(([word, one]) => [word, changed[word] ?? one.things]));
  const told = (changed) => {
    try {
      const chosen = answerTo(request, of(changed), view);
      return request.count ? chosen.length : chosen.map(({ id }) => id).sort((a, b) => a - b).join();
    } catch {
      return null;
    }
  };
  const plain = told({}), length = plain === null ? 0 : answerTo(request, of({}), view).length;
  const mayLack = Math.floor(MISSED * length) > length; // a list may lack what a count may
  const wide = wordsOf(request).filter((word) => {
    const { things, candidates } = found[word];
    return (mayLack && word === request.word) || new Set([things, sureOf(things), [...things, ...candidates]].map((some) => told({ [word]: some }))).size > 1;
  });
  const reasons = wide.map((word) => `${shown(word)}: ${count(found[word])}`);
  const needsUp = (part) => ["above", "below"].includes(part.relation) || ["top", "tall"].includes(orderOf(part)[0]);
  if (view.upright === false && partsOf(request).some(needsUp)) reasons.push("the photos don't tell which way is up");
  if (reasons.length) return reasons.join(", ");
  for (const part of plain === null ? [] : partsOf(request)) {
    const [kind, sign] = orderOf(part);
    if (["", "left", "top"].includes(kind)) continue;
    const sizes = answerTo({ ...part, superlative: null, nth: null }, of({}), view).map((thing) => measure(thing, kind, view)).sort((a, b) => sign * (a - b));
    const at = (part.nth ?? 1) - 1, close = (other) => other >= 0 && other < sizes.length && Math.max(sizes[at], sizes[other]) < CLOSE * Math.min(sizes[at], sizes[other]);
    if (close(at - 1) || close(at + 1)) return `another ${shown(part.word)} measures nearly the same`;
  }
  return null;
}

const minus = (a, b) => a.map((value, axis) => value - b[axis]);

function measure({ center, size }, kind, view) {
  if (kind === "left") return dot(center, view.right);
  if (kind === "top") return dot(center, view.up) + size[2] / 2;
  const [, a, b] = [...size].sort((x, y) => x - y);
  return { tall: size[2], wide: Math.max(size[0], size[1]) }[kind] ?? Math.sqrt(a * b);
}

function related(thing, relation, others, view) {
  if (relation !== "between") return others[0].some((other) => other.id !== thing.id && holds(thing, relation, other, view));
  const apart = (a, b) => a.id !== b.id && thing.id !== a.id && thing.id !== b.id;
  return others[0].some((a) => others.at(-1).some((b) => apart(a, b) && between(thing, a, b)));
}

function holds(thing, relation, other, view) {
  const apart = minus(thing.center, other.center), wide = Math.max(other.size[0], other.size[1]), most = (values) => Math.max(...values);
  const along = { left: -dot(apart, view.right), right: dot(apart, view.right), front: -dot(apart, view.ahead), behind: dot(apart, view.ahead) };
  if (relation in along) return along[relation] > wide / 2;
  if (relation === "above" || relation === "below") return dot(apart, view.up) * (relation === "above" ? 1 : -1) > other.size[2] / 2;
  if (relation === "beside") return Math.hypot(...apart) < (BESIDE * (most(thing.size) + most(other.size))) / 2;
  return other.axes.every((axis, k) => Math.abs(dot(axis, apart)) <= INSIDE * Math.max(other.size[k], most(other.size) / 10));
}

function between(thing, a, b) {
  const line = minus(b.center, a.center), from = minus(thing.center, a.center), share = dot(from, line) / Math.max(dot(line, line), 1e-12);
  const aside = Math.hypot(...from.map((value, axis) => value - share * line[axis]));
  return 0 < share && share < 1 && aside < Math.max(...a.size, ...b.size);
}
