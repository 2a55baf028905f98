// Location of a match: the views that show it best, and a box around its strongest part, as in Python's query/.

import language from "./language.js";

const { PEAK, LARGE, RIM, STRONG, CORE, JOINED, OUTLIERS, DENSE } = language.ranking; // of query/view_ranking.py
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

/** Rank views by how well they show a match; see query/view_ranking.py. */
export function rankViews(views, centers, relevancy, threshold) {
  const peaks = views.map((view) => peakOf(view, relevancy)), top = Math.max(...peaks);
  const low = top > threshold ? threshold : relevancy.slice().sort()[(relevancy.length - 1) >> 1];
  const level = low + STRONG * (top - low);
  const ranked = views.map((view, v) => {
    const { rows, codes, sizes } = view;
    let area = 0, strong = 0, excess = 0, centered = 0;
    for (let k = 0; k < rows.length; k++) {
      const value = relevancy[rows[k]], share = sizes[codes[k]];
      if (value > threshold) area += share;
      if (value <= level) continue;
      strong += share;
      excess += (value - low) * share;
      centered += (value - low) * share * centeredness(view, centers, rows[k]);
    }
    const closeness = Math.max(0, Math.min((peaks[v] - low) / Math.max(top - low, 1e-9), 1));
    const rank = (closeness * Math.sqrt(Math.min(strong / LARGE, 1)) * centered) / Math.max(excess, 1e-12);
    return { name: view.name, index: v, area, rank, shown: area * view.width * view.height >= 1 };
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

function centeredness({ pose, fx, fy, cx, cy, width, height }, centers, row) {
  const offset = [0, 1, 2].map((axis) => centers[3 * row + axis] - pose[axis][3]);
  const [x, y, z] = [0, 1, 2].map((k) => offset.reduce((sum, value, axis) => sum + value * pose[axis][k], 0));
  const u = (cx - (fx * x) / z) / width, v = (cy + (fy * y) / z) / height;
  const off = Math.max(Math.abs(2 * u - 1), Math.abs(2 * v - 1));
  return 1 - (1 - RIM) * Math.max(0, Math.min((off - 0.5) / 0.5, 1));
}

/** Sum the pixels that every Gaussian fills, over all views. */
export function massOf(views, count) {
  const mass = new Float32Array(count);
  for (const { rows, codes, sizes, width, height } of views) rows.forEach((row, k) => (mass[row] += sizes[codes[k]] * width * height));
  return mass;
}

/** Find the box around the strongest connected match: { low, high }; null if nothing matches. */
export function boxAround(centers, relevancy, mass, threshold, gap) {
  const matching = [];
  for (let i = 0; i < relevancy.length; i++) if (relevancy[i] > threshold && mass[i] > 0) matching.push(i);
  if (!matching.length) return null;
  matching.sort((a, b) => relevancy[b] - relevancy[a]);
  const total = matching.reduce((sum, i) => sum + mass[i], 0);
  let before = 0;
  const high = relevancy[matching.find((i) => (before += mass[i]) >= OUTLIERS * total) ?? matching.at(-1)];
  const things = (closeness) => {
    const near = matching.filter((i) => relevancy[i] >= threshold + closeness * (high - threshold));
    return groupsOf(near, centers, (i) => (relevancy[i] - threshold) * mass[i], gap);
  };
  const most = (values, measure) => values.reduce((best, value) => (measure(value) > measure(best) ? value : best));
  const core = boxOf(most(things(CORE), ({ weight }) => weight).rows, centers);
  const boxes = things(STRONG).map(({ rows }) => boxOf(rows, centers));
  const around = most(boxes, (box) => sharedVolume(box, core, gap));
  return sharedVolume(around, around, gap) <= JOINED * sharedVolume(core, core, gap) ? around : core;
}

function boxOf(rows, centers) {
  const ends = [0, 1, 2].map((axis) => {
    const sorted = Float32Array.from(rows, (i) => centers[3 * i + axis]).sort(), last = sorted.length - 1;
    return [sorted[Math.round(OUTLIERS * last)], sorted[Math.round((1 - OUTLIERS) * last)]];
  });
  return { low: ends.map(([low]) => low), high: ends.map(([, high]) => high) };
}

/** Compute the volume of two boxes' intersection, widened by a margin. */
function sharedVolume(a, b, margin) {
  const side = (axis) => Math.min(a.high[axis], b.high[axis]) - Math.max(a.low[axis], b.low[axis]) + margin;
  return [0, 1, 2].reduce((volume, axis) => volume * Math.max(side(axis), 0), 1);
}

/** Group Gaussians in touching cells of this size. Cells with hardly any weight separate groups. */
function groupsOf(rows, centers, weightOf, size) {
  const cells = new Map();
  for (const i of rows) {
    const place = [0, 1, 2].map((axis) => Math.floor(centers[3 * i + axis] / size)), key = place.join();
    if (!cells.has(key)) cells.set(key, { place, rows: [], weight: 0 });
    const cell = cells.get(key);
    cell.rows.push(i);
    cell.weight += weightOf(i);
  }
  const total = [...cells.values()].reduce((sum, cell) => sum + cell.weight, 0);
  for (const [key, cell] of cells) if (cells.size > 1 && cell.weight < DENSE * total) cells.delete(key);
  const groups = [];
  while (cells.size) {
    const group = { weight: 0, rows: [] }, [first] = cells.values(), waiting = [first];
    cells.delete(first.place.join());
    while (waiting.length) {
      const { place, rows, weight } = waiting.pop();
      for (const i of rows) group.rows.push(i); // spread out, they may be more arguments than a call takes
      group.weight += weight;
      for (let k = 0; k < 27; k++) {
        const key = [place[0] + (k % 3) - 1, place[1] + (Math.floor(k / 3) % 3) - 1, place[2] + Math.floor(k / 9) - 1].join();
        if (cells.has(key)) waiting.push(cells.get(key));
        cells.delete(key);
      }
    }
    groups.push(group);
  }
  return groups.length ? groups : [{ weight: 0, rows }];
}
