// Words that this scene knows, in its own numbers, and phrases that a live server encodes.
import { floats } from "./decode.js";

const MOST_TEXT = 2000; // most characters of a phrase

export const tidy = (text) => text.replace(/["\0]/g, " ").split(/\s+/).filter(Boolean).join(" ");

/** Parse prompts separated by `;`, each with optional negatives: `"windows" not "doors"; dome`. */
export function parsePrompts(typed) {
  const parts = typed.replace(/‘([^‘’]*)’|[“”„«»]/g, (_, quoted) => (quoted === undefined ? '"' : `"${quoted}"`)).match(/(?:"[^"]*"|[^;])+/g) ?? [];
  const negative = /\s*\bnot\s+("[^"]*"(?:\s*,\s*"[^"]*")*)/gi;
  return parts
    .map((part) => ({
      text: tidy(part.replace(negative, " ")),
      negatives: [...part.matchAll(negative)].flatMap((m) => m[1].split('"').filter((_, i) => i % 2)).map(tidy).filter(Boolean),
    }))
    .filter((prompt) => prompt.text);
}

export class Vocabulary {
  constructor(described, buffer, width, live) {
    Object.assign(this, { ...described, width, live });
    this.numbers = floats(new Uint16Array(buffer));
    this.index = new Map(this.words.map((word, i) => [word.toLowerCase(), i]).reverse());
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
    return { own, near: near?.map((row) => this.row(row)) ?? [own], against: against ?? this.all, taught: this.taught[i] };
  }

  /** Look up any phrase in the same way; null if this page doesn't know it. */
  async phrase(text) {
    const plain = [...tidy(text)].slice(0, MOST_TEXT).join(""), known = this.index.get(plain.toLowerCase());
    if (!this.live) return known === undefined ? null : this.word(known);
    if (!this.encoded.has(plain)) {
      const answer = await fetch(`api/encode?text=${encodeURIComponent(plain)}`);
      if (!answer.ok) throw new Error(await answer.text());
      this.encoded.set(plain, await answer.json());
    }
    return this.encoded.get(plain);
  }

  /** Ask the live server anew about a phrase. */
  forget(text) {
    this.encoded.delete([...tidy(text)].slice(0, MOST_TEXT).join(""));
  }

  /** Find the words spelled most like a phrase, or contained in it. */
  closest(text, most = 5) {
    const plain = tidy(text).toLowerCase(), pairs = pairsOf(plain), parts = plain.split(" ");
    const likeness = (word) => {
      if (parts.includes(word) || parts.includes(`${word}s`)) return 2;
      const others = pairsOf(word), common = [...others].filter((pair) => pairs.has(pair)).length;
      return (2 * common) / (pairs.size + others.size);
    };
    const scored = this.words.map((word) => [word, likeness(word.toLowerCase())]).filter(([, score]) => score > 0.4);
    return scored.sort((a, b) => b[1] - a[1]).slice(0, most).map(([word]) => word);
  }

  /** Find words to offer while the user types. */
  offered(typed, most = 12) {
    const start = tidy(typed).toLowerCase(), first = [], later = [];
    for (const word of this.words) {
      const at = word.toLowerCase().indexOf(start);
      if (at === 0) first.push(word);
      else if (at > 0 && later.length < most) later.push(word);
      if (first.length >= most) break;
    }
    return [...first, ...later].slice(0, most);
  }
}

const pairsOf = (text) => new Set([...` ${text}`].map((_, i) => ` ${text} `.slice(i, i + 2)));
