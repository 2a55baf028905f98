// Answers: relevancy from cosines, the threshold above which a place matches, and doubt, as in Python's query/.

import language from "./language.js";

const { PRESENT } = language.things;
const TIE = 0.999; // values that are equal in Python may differ by this factor in 16 bits

const sigmoid = (x) => 1 / (1 + Math.exp(-x));

export class Answers {
  constructor(rows, vocabulary, words) {
    Object.assign(this, { rows, vocabulary, words });
    this.competing = []; // cosines with shared negatives as 16-bit integers, computed when first needed
    this.foreground = null; // 1 for Gaussians that may match
  }

  competitor(i) {
    this.competing[i] ??= Int16Array.from(this.rows.times(this.vocabulary.shared[i]), (x) => 32767 * Math.max(-1, Math.min(x, 1)));
    return this.competing[i];
  }

  /** Compute every Gaussian's relevancy, 0…1: sigmoid(τ margin), 0 where nothing is known. A text's margin is the
   * best of near − the best of the others; a taught word adds a share of it to its own margin. */
  relevancy({ near, against, taught }, negatives = []) {
    const best = largest(near.map((vector) => this.rows.times(vector)));
    const own = negatives.map((vector) => this.rows.times(vector)), shared = against.map((i) => this.competitor(i));
    const { temperature } = this.words, { scales } = this.rows, learned = taught && this.rows.times(taught.vector);
    for (let i = 0; i < best.length; i++) {
      let other = -32768;
      for (const cosines of shared) if (cosines[i] > other) other = cosines[i];
      other /= 32767;
      for (const cosines of own) if (cosines[i] > other) other = cosines[i];
      const margin = taught ? learned[i] + taught.bias + taught.text * (best[i] - other) : best[i] - other;
      best[i] = scales[i] ? sigmoid(temperature * margin) : 0;
    }
    return best;
  }

  /** Set relevancies outside the foreground to 0. */
  confined(relevancy) {
    const { foreground } = this;
    return foreground ? relevancy.map((value, i) => value * foreground[i]) : relevancy;
  }

  /** Return peak, doubt, threshold, and the number of Gaussians of the foreground that match.
   * strict: whether the prompt has negatives of its own, or was taught; doubt: of a word that was taught;
   * name: the prompt, for comparing it with common words. */
  verdict(relevancy, { strict = false, doubt = null, threshold = null, name = null }) {
    const { unrelated, rules } = this.words, sorted = relevancy.slice().sort(), count = sorted.length;
    let fit = 0;
    const top = Math.max(Math.ceil(rules.best * count), 1);
    for (let i = count - top; i < count; i++) fit += sorted[i] / top;
    const asWell = unrelated.filter((other) => other >= fit * TIE).length;
    const taught = doubt !== null, mostDoubt = doubt === null ? rules.doubtful : rules.doubtful_taught;
    doubt ??= fit < rules.least_peak ? 1 : (1 + asWell) / (1 + unrelated.length);
    const low = sorted[(count - 1) >> 1]; // the lower median, as in torch
    const isDoubtful = doubt > mostDoubt;
    const own = isDoubtful || strict ? rules.even : Math.min(low + rules.share * (fit - low), rules.even);
    const level = threshold ?? own, confined = this.confined(relevancy);
    let matching = 0, peak = 0;
    for (const value of confined) (peak = Math.max(peak, value)), (matching += value > level);
    const alike = taught || name === null ? [] : this.alike(name, relevancy, own);
    const trust = this.trust({ doubt, isDoubtful, fit, taught, alike });
    return { relevancy: confined, peak, doubt, doubtful: isDoubtful, threshold: level, own, matching, trust };
  }

  /** Judge an answer by one word and its reason, as Python's query/trust.py does. */
  trust({ doubt, isDoubtful, fit, taught, alike }) {
    const { rules, foreign } = this.words, far = foreign !== null && foreign >= rules.far;
    const best = `the best places fit at ${fit.toFixed(2)}`, told = (level, reason) => ({ level, reason, far: far && !taught, alike });
    const world = far ? `; this scene is ${foreign.toFixed(1)} times as far from what its CLIP was trained on as usual` : "";
    if (isDoubtful && taught) return told("doubtful", `${Math.round(100 * doubt)} % of what was not marked fits as well`);
    if (doubt === 1) return told("doubtful", "it matches nothing in this scene: it may be absent, or this scene's CLIP may not know the word");
    if (isDoubtful) return told("doubtful", `${Math.round(100 * doubt)} % of unrelated words fit this scene as well`);
    if (taught) return told("sure", "taught by example");
    if (fit < rules.faint) return told("doubtful", `${best}, and other words fit better there: it may not be here`);
    const least = far ? Math.min(rules.clearly + rules.stricter * (foreign - rules.far), rules.strictest) : rules.clearly;
    if (fit < least) return told("uncertain", `${best}, where right words reach 1.00${world}`);
    if (alike.length) return told("uncertain", `it selects the same as ${alike.join(" and ")}`);
    return told("sure", best + world);
  }

  /** List the common words that select the same Gaussians, but for those that mean the same. */
  alike(name, relevancy, level) {
    this.common ??= Object.keys(this.vocabulary.anchors).map((word) => {
      const values = this.relevancy(this.vocabulary.word(this.vocabulary.index.get(word)));
      return { word, values, level: this.verdict(values, {}).own };
    });
    const same = ({ values, level: other }) => {
      let both = 0, either = 0;
      for (let i = 0; i < values.length; i++) {
        const here = relevancy[i] > level, there = values[i] > other;
        both += here && there;
        either += here || there;
      }
      return both > 0 && both >= this.words.rules.alike * either;
    };
    return this.common.filter((one) => same(one) && !this.vocabulary.isSame(one.word, name)).map(({ word }) => word);
  }

  /** Find the words that match a blend of rows best, with their relevancy, best first; none at the sky. */
  naming(blend, most = 5) {
    const { vocabulary, words } = this, length = norm(blend, words.gram);
    const cosine = (vector) => dot(blend, vector) / length;
    const others = vocabulary.shared.map(cosine);
    const scored = vocabulary.words.slice(0, vocabulary.naming).map((word, i) => {
      const { own, against } = vocabulary.word(i);
      return [word, sigmoid(words.temperature * (cosine(own) - Math.max(...against.map((k) => others[k]))))];
    });
    const named = scored.sort((a, b) => b[1] - a[1]).find(([word]) => word !== "sky")[1] > words.rules.clear;
    return named || !vocabulary.nothing.includes(others.indexOf(Math.max(...others))) ? scored.slice(0, most) : [];
  }

  /** Name the common word that [row, weight] pairs fit clearly better than a prompt and the common words in that, as in
   * Python's things/find.py; null if none does. */
  better(weighted, { name, own }) {
    const { rows, vocabulary, words } = this, blend = new Float64Array(rows.width), clearly = Math.log(PRESENT / (1 - PRESENT));
    for (const [i, weight] of weighted) rows.row(i).forEach((value, k) => (blend[k] += weight * value));
    const length = norm(blend, words.gram), fit = (vector) => (words.temperature * dot(blend, vector)) / length;
    const fits = vocabulary.words.slice(0, vocabulary.common).map((_, i) => fit(vocabulary.word(i).own)), most = Math.max(...fits);
    const mine = Math.max(fit(own), ...vocabulary.commonIn(name).map((i) => fits[i]));
    return most - mine > clearly ? vocabulary.words[fits.findIndex((one) => one > most - clearly)] : null;
  }
}

export const dot = (a, b) => a.reduce((sum, x, i) => sum + x * b[i], 0);

/** Compute the length of a row's feature; gram: products of the decoder's last layer, or null. */
function norm(row, gram) {
  if (!gram) return Math.sqrt(dot(row, row));
  const width = row.length;
  return Math.sqrt(row.reduce((sum, x, i) => sum + x * dot(row, gram.slice(i * width, (i + 1) * width)), 0));
}

function largest([first, ...rest]) {
  for (const other of rest) for (let i = 0; i < first.length; i++) if (other[i] > first[i]) first[i] = other[i];
  return first;
}
