// Answers: cosines to relevancy, the threshold from which a place matches, and doubt, as in Python's query/.

const DOUBTFUL = 0.1, EVEN = 0.5, SHARE = 0.4, BEST = 0.005, LEAST_PEAK = 0.1;
const TIE = 0.999; // numbers of 16 bits: what is equal in Python may differ by less than this

export const sigmoid = (x) => 1 / (1 + Math.exp(-x));

export class Answers {
  constructor(rows, vocabulary, words) {
    Object.assign(this, { rows, vocabulary, words });
    this.competing = []; // cosines with shared negatives as 16-bit integers, made when first needed
  }

  competitor(i) {
    this.competing[i] ??= Int16Array.from(this.rows.times(this.vocabulary.shared[i]), (x) => 32767 * Math.max(-1, Math.min(x, 1)));
    return this.competing[i];
  }

  /** Relevancy of every Gaussian, 0…1: sigmoid(τ (best of near − best of the others)); 0 where nothing is known. */
  relevancy({ near, against }, negatives = []) {
    const best = largest(near.map((vector) => this.rows.times(vector)));
    const own = negatives.map((vector) => this.rows.times(vector)), shared = against.map((i) => this.competitor(i));
    const { temperature } = this.words, { scales } = this.rows;
    for (let i = 0; i < best.length; i++) {
      let other = -32768;
      for (const cosines of shared) if (cosines[i] > other) other = cosines[i];
      other /= 32767;
      for (const cosines of own) if (cosines[i] > other) other = cosines[i];
      best[i] = scales[i] ? sigmoid(temperature * (best[i] - other)) : 0;
    }
    return best;
  }

  /** What is found: peak, doubt, threshold, and the number of Gaussians that match. */
  verdict(relevancy, named, threshold = null) {
    const sorted = relevancy.slice().sort(), count = sorted.length;
    let fit = 0;
    const top = Math.max(Math.ceil(BEST * count), 1);
    for (let i = count - top; i < count; i++) fit += sorted[i] / top;
    const { unrelated } = this.words;
    const asWell = unrelated.filter((other) => other >= fit * TIE).length;
    const doubt = fit < LEAST_PEAK ? 1 : (1 + asWell) / (1 + unrelated.length);
    const low = sorted[(count - 1) >> 1]; // the median, as torch takes it
    const own = doubt > DOUBTFUL || named ? EVEN : Math.min(low + SHARE * (fit - low), EVEN);
    const level = threshold ?? this.words.threshold ?? own;
    let matching = 0;
    for (let i = count - 1; i >= 0 && sorted[i] > level; i--) matching++;
    return { peak: sorted[count - 1], doubt, doubtful: doubt > DOUBTFUL, threshold: level, matching };
  }

  /** The words that fit a blend of rows best, with their relevancy, best first. */
  naming(blend, most = 5) {
    const { vocabulary, words } = this, length = norm(blend, words.gram);
    const cosine = (vector) => dot(blend, vector) / length;
    const others = vocabulary.shared.map(cosine);
    const scored = vocabulary.words.slice(0, vocabulary.naming).map((word, i) => {
      const { own, against } = vocabulary.word(i);
      return [word, sigmoid(words.temperature * (cosine(own) - Math.max(...against.map((k) => others[k]))))];
    });
    return scored.sort((a, b) => b[1] - a[1]).slice(0, most);
  }
}

export const dot = (a, b) => a.reduce((sum, x, i) => sum + x * b[i], 0);

/** Length of the feature that a row stands for; gram: products of the decoder's last layer, or null. */
export function norm(row, gram) {
  if (!gram) return Math.sqrt(dot(row, row));
  const width = row.length;
  return Math.sqrt(row.reduce((sum, x, i) => sum + x * dot(row, gram.slice(i * width, (i + 1) * width)), 0));
}

function largest([first, ...rest]) {
  for (const other of rest) for (let i = 0; i < first.length; i++) if (other[i] > first[i]) first[i] = other[i];
  return first;
}
