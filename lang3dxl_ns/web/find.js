// Location of a match: the views that show it best, as in Python's query/.

import language from "./language.js";
import { seenAt } from "./space.js";

const { PEAK, LARGE, RIM, STRONG } = language.ranking; // of query/view_ranking.py
const BINS = 1000;

/** Read views with the Gaussians that they show, and the share of the view that each fills: sizes[codes[k]]. */
export function readViews(about, buffer) {
  const { count, pixels: [least, steps] } = about.words, bits = Math.ceil(count / 8);
  let start = 0;
  return about.views.map((view) => {
    const seen = new Uint8Array(buffer, start, bits), codes = new Uint8Array(buffer, start + bits, view.bytes - bits);
    start += view.bytes;
    const rows = new Uint32Array(codes.length), area = view.width * view.height;
    for (let i = 0, k = 0; i < count; i++) if ((seen[i >> 3] >> (i & 7)) & 1) rows[k++] = i;
    return { ...view, rows, codes, sizes: Float32Array.from({ length: 256 }, (_, code) => (least * 2 ** (code / steps)) / area) };
  });
}

/** Rank views by how well they show a match; see query/view_ranking.py. target: the middle of what a view shows of it. */
export function rankViews(views, centers, relevancy, threshold) {
  const peaks = views.map((view) => peakOf(view, relevancy)), top = Math.max(...peaks);
  const low = top > threshold ? threshold : relevancy.slice().sort()[(relevancy.length - 1) >> 1];
  const level = low + STRONG * (top - low);
  const ranked = views.map((view, v) => {
    const { rows, codes, sizes } = view;
    let area = 0, strong = 0, excess = 0, centered = 0;
    const target = [0, 0, 0];
    for (let k = 0; k < rows.length; k++) {
      const value = relevancy[rows[k]], share = sizes[codes[k]];
      if (value > threshold) area += share;
      if (value <= level) continue;
      const weight = (value - low) * share, center = centers.subarray(3 * rows[k], 3 * rows[k] + 3);
      strong += share;
      excess += weight;
      centered += weight * centeredness(view, center);
      for (let axis = 0; axis < 3; axis++) target[axis] += weight * center[axis];
    }
    const closeness = Math.max(0, Math.min((peaks[v] - low) / Math.max(top - low, 1e-9), 1));
    const rank = (closeness * Math.sqrt(Math.min(strong / LARGE, 1)) * centered) / Math.max(excess, 1e-12);
    return { name: view.name, index: v, area, rank, target: target.map((sum) => sum / Math.max(excess, 1e-12)), shown: area * view.width * view.height >= 1 };
  });
  return ranked.sort((a, b) => b.shown - a.shown || b.rank - a.rank);
}

/** Compute the mean relevancy of the most relevant share PEAK of a view. */
function peakOf({ rows, codes, sizes }, relevancy) {
  const filled = new Float32Array(BINS + 1), bin = (k) => Math.floor(BINS * relevancy[rows[k]]);
  for (let k = 0; k < rows.length; k++) filled[bin(k)] += sizes[codes[k]];
  let level = BINS, reached = filled[level];
  while (level > 0 && reached < PEAK) reached += filled[--level];
  const order = [];
  for (let k = 0; k < rows.length; k++) if (bin(k) >= level) order.push(k);
  order.sort((a, b) => relevancy[rows[b]] - relevancy[rows[a]]);
  let before = 0, sum = 0;
  for (const k of order) {
    if (before >= PEAK) break;
    const share = sizes[codes[k]];
    sum += Math.min(PEAK - before, share) * relevancy[rows[k]];
    before += share;
  }
  return sum / PEAK;
}

function centeredness(view, center) {
  const [x, y] = seenAt(view, center);
  const off = Math.max(Math.abs((2 * x) / view.width - 1), Math.abs((2 * y) / view.height - 1));
  return 1 - (1 - RIM) * Math.max(0, Math.min((off - 0.5) / 0.5, 1));
}

/** Sum the pixels that every Gaussian fills, over all views. */
export function massOf(views, count) {
  const mass = new Float32Array(count);
  for (const { rows, codes, sizes, width, height } of views) rows.forEach((row, k) => (mass[row] += sizes[codes[k]] * width * height));
  return mass;
}
