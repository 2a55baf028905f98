// Words that this scene knows, in its own numbers, and phrases that a live server encodes.
import { floats } from "./decode.js";
import language from "./language.js"; // written beside this file from query/language.json
import { request } from "./think.js";

const MOST_TEXT = 2000; // most characters of a phrase

export const tidy = (text) => text.normalize("NFC").replace(/["\0]/g, " ").split(/\s+/).filter(Boolean).join(" ");

// ── what people type, as in Python's query/language.py; both read query/language.json ──

export const HELD = "\ue000"; // surrounds the number of a part that is held
const longest = (phrases) => [...phrases].sort((a, b) => b.length - a.length).join("|");
const any = (kind) => longest(language[kind]);
const literal = (text) => text.replace(/[.*+?^${}()|[\]\\]/g, "\\$&");
const L = "[\\p{L}\\p{N}_]";
const wholeOf = (phrases) => new RegExp(`(?<!${L})(?:${longest(phrases)})(?!${L})`, "giu");
const whole = (kind) => wholeOf(language[kind]);
const leading = (kind) => new RegExp(`^(?:${any(kind)})\\s+(?=\\S)`, "iu");
const WHERE = new RegExp(
  `\\s+(?:${any("before_places")})\\s+(?:the\\s+)?(?:${any("places")})(?!${L}).*$` +
  `|^(?:${any("places")}|${any("sizes")})\\s+(?!of(?!${L}))(?=\\S)|\\s+(?:${any("after")})$`, "giu"); // prettier-ignore

/** Put a placeholder, which is one word, in place of every part that quotes hold, and of names, and leave out *please*: { text, restored: puts
 * the parts back, without quotes }. */
export function held(typed, names = []) {
  const parts = [], whole = wholeOf([...language.one, ...names.map(tidy).filter(Boolean)].map(literal)).source;
  const plain = typed.normalize("NFC").replace(/‘([^‘’]*)’|[“”„«»]/g, (_, quoted) => (quoted === undefined ? '"' : `"${quoted}"`));
  const text = plain.replaceAll(HELD, " ").replace(/[\0\s]+/g, " ").trim().replace(new RegExp(`"[^"]*"|${whole}`, "giu"), (part) => HELD + (parts.push(part) - 1) + HELD);
  const polite = new RegExp(`(?:^|,? )(?:${any("polite")})(?![\\p{L}\\p{N}_-]),?`, "giu");
  return { text: text.replace(polite, "").trim(), restored: (some) => tidy(some.replace(new RegExp(`${HELD}(\\d+)${HELD}`, "g"), (_, i) => parts[i])) };
}

/** Parse prompts, each with negatives: `windows and doors; dome not roof`. Quotes and names are never split. */
export function parsePrompts(typed, names = []) {
  const { text, restored } = held(typed, names);
  const listed = (some) => some.split(",").flatMap((piece) => piece.split(whole("and"))).filter((part) => part.trim());
  const found = text.split(";")
    .flatMap((part) => {
      const [wanted, ...others] = part.split(whole("not")), prompts = listed(wanted), negatives = others.flatMap(listed);
      const alone = prompts.length ? prompts : [negatives.length ? "" : part]; // a separator alone
      return alone.map((text) => ({ text: restored(text), negatives: negatives.map(restored).filter(Boolean) }));
    })
    .filter(({ text, negatives }) => text || negatives.length);
  const alone = found.find(({ text }) => !text);
  if (alone) throw new Error(`'${alone.negatives[0]}' has only negatives: put what to find first`);
  return found;
}

/** Find out what a prompt searches for, and which parts of it the answer does not use, as [kind, part]. */
export function meaning(text) {
  if (/^(The )?[A-Z][\p{L}\p{N}_]* [A-Z][\p{L}\p{N}_]*/u.test(text) && english(text) === text) return { target: text, unused: [] };
  const unused = [], ends = `[\\s${language.ends}]`;
  let target = text.replace(new RegExp(`^${ends}+|(?<!${ends})${ends}+$`, "g"), "") || text;
  const cut = (pattern) => (target = target.replace(pattern, ""));
  const [asks, counted] = new RegExp(`^(?:(?:${any("lead")})\\s+)?((?:${any("count")})\\s+)?(?=\\S)`, "iu").exec(target) ?? [""];
  if (counted) unused.push(["count", counted.trim()]);
  if (asks) {
    target = target.slice(asks.length);
    cut(/(?:\s+there)?\s+(?:are|is)(?:\s+there)?$/);
  }
  const without = leading("no").exec(target);
  if (without) unused.push(["no", without[0].trim()]), cut(leading("no"));
  cut(leading("articles"));
  const places = target.match(WHERE);
  if (places) {
    unused.push(["place", places.map((part) => part.trim()).join(" ")]);
    target = target.replace(WHERE, "").trim();
    cut(leading("articles"));
  }
  target = english(target.trim() || text);
  const color = new RegExp(`(?<!${L})(?:${any("colors")})(?=\\s+\\S)`, "iu").exec(target);
  if (color) unused.push(["color", color[0]]);
  return { target, unused };
}

function english(text) {
  const words = tidy(text.toLowerCase()).split(" "), table = language.german;
  return words.every((word) => Object.hasOwn(table, word)) ? words.map((word) => table[word]).join(" ") : text;
}

/** Describe the parts of a prompt that its answer does not use. */
export function advice(text) {
  const { target, unused } = meaning(text);
  return unused.map(([kind, part]) => language.unused[kind].replace("{target}", target).replace("{part}", part));
}

export class Vocabulary {
  constructor(described, buffer, width, live) {
    Object.assign(this, { ...described, width, live });
    this.numbers = floats(new Uint16Array(buffer));
    this.index = new Map(this.words.map((word, i) => [tidy(word).toLowerCase(), i]).reverse());
    this.shared = this.negatives.map((_, i) => this.row(i));
    this.all = this.negatives.map((_, i) => i);
    this.encoded = new Map();
  }

  row(i) {
    return this.numbers.subarray(i * this.width, (i + 1) * this.width);
  }

  /** Look up a word: itself, what is searched for, its shared negatives, and what examples taught. */
  word(i) {
    const own = this.row(this.negatives.length + i), [near, against] = this.special[i] ?? [];
    return { name: this.words[i], own, near: near?.map((row) => this.row(row)) ?? [own], against: against ?? this.all, taught: this.taught[i] };
  }

  /** Look up any phrase in the same way; null if this page doesn't know it. */
  async phrase(text) {
    const plain = [...tidy(text)].slice(0, MOST_TEXT).join(""), known = this.place(plain);
    if (!this.live) return known === undefined ? null : this.word(known);
    if (!this.encoded.has(plain)) {
      const answer = await request(`api/encode?text=${encodeURIComponent(plain)}`);
      if (!answer.ok) throw new Error(await answer.text());
      this.encoded.set(plain, { name: plain, ...(await answer.json()) });
    }
    return this.encoded.get(plain);
  }

  /** Find a word's place: as typed, or else what it searches for, without its color, or in singular or plural. */
  place(text) {
    const { target, unused } = meaning(text), color = unused.find(([kind]) => kind === "color");
    const plain = color ? tidy(target.replace(color[1], "")) : target;
    const forms = [text, target, plain, `${plain}s`, ...singulars(plain)];
    return forms.map((form) => this.index.get(form.toLowerCase())).find((place) => place !== undefined);
  }

  /** Find the place of the common word that a phrase searches for in the plural, as Python's `singular`; -1 for others. */
  singular(text) {
    const target = meaning(text).target.toLowerCase();
    return this.words.slice(0, this.common).findIndex((word) => pluralOf(word) === target);
  }

  /** List the places of the common words that a prompt has, in singular or plural: *dark windows* has *window*. */
  commonIn(text) {
    const { target } = meaning(text), forms = target.toLowerCase().split(" ").flatMap(singulars);
    return [...Array(this.common).keys()].filter((i) => this.words[i].split(" ").every((word) => forms.includes(word)));
  }

  /** Return whether a prompt means the same as a common word. */
  isSame(anchor, name) {
    return this.anchors[anchor].includes((this.words[this.place(name)] ?? name).toLowerCase());
  }

  /** Ask the live server anew about a phrase. */
  forget(text) {
    this.encoded.delete([...tidy(text)].slice(0, MOST_TEXT).join(""));
  }

  /** Find the words spelled most like a phrase, or contained in it. */
  closest(text, most = 5) {
    const plain = meaning(tidy(text)).target.toLowerCase(), pairs = pairsOf(plain), parts = plain.split(" ");
    const likeness = (word) => {
      if (parts.includes(word) || parts.includes(`${word}s`)) return 2;
      const others = pairsOf(word), common = [...others].filter((pair) => pairs.has(pair)).length;
      return (2 * common) / (pairs.size + others.size);
    };
    const scored = this.words.map((word) => [word, likeness(word.toLowerCase())]).filter(([, score]) => score > 0.4);
    return scored.sort((a, b) => b[1] - a[1]).slice(0, most).map(([word]) => word);
  }

  /** All words, taught ones first, to offer while the user types. */
  get listed() {
    return [...new Set([...Object.keys(this.taught).map((i) => this.words[i]), ...this.words])];
  }
}

/** List a word or term without punctuation, and those that it may be the plural of, as Python's `singulars`. */
function singulars(words) {
  const word = words.replace(/^[.,;:!?'"()]+|[.,;:!?'"()]+$/g, "");
  return [word, ...language.plurals.filter(([plural]) => word.endsWith(plural)).map(([plural, one]) => word.slice(0, -plural.length) + one)];
}

function pluralOf(word) {
  if (/(s|x|ch|sh)$/.test(word)) return `${word}es`;
  return /[^aeiou]y$/.test(word) ? `${word.slice(0, -1)}ies` : `${word}s`;
}

const pairsOf = (text) => new Set([...` ${text}`].map((_, i) => ` ${text} `.slice(i, i + 2)));
