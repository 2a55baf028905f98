// Pieces of a word's heat in each view, as in Python's things/pieces.py.
// The heat that is cut into pieces is composited front to back, as training renders it: what spreads each Gaussian's
// share of a view over its ellipse smears heat over edges, and one thing falls into several.
import language from "./language.js";
import { BLUR, spreadAt } from "./pick.js";
import { seenAt } from "./space.js";

const { LEVELS, LEAST, PART, DEPTH, FILLED } = language.things;
const SIDE = 256; // pixels of a view's longer side
const FIELDS = 10, MOST_KEPT = 3e5; // of an ellipse; ellipses that a worker keeps, 80 bytes each
const X = 1, Y = 2, Z = 3, OPACITY = 4, REACH = 5, TALL = 6, HIGH = 7, SLOPE = 8, NARROW = 9; // places of an ellipse's fields
const HIDDEN = 1e-3; // of a pixel's light: what lies behind is not seen
const HOT = 0.1; // share of a pixel that one hot Gaussian covers where the map may be hot
const FINE = 512; // steps of the falloff's table for each squared standard deviation
const FALLOFF = Float64Array.from({ length: 12 * FINE }, (_, k) => Math.exp(-k / FINE / 2)); // reaches beyond 2 log 255

/** Find the pieces of a word's heat in views, which are numbered: [[number, view]]. scene: { centers, axes, opacities,
 * antialiased }, in the views' frame. */
export const piecesIn = (views, scene, heat) => views.flatMap(([number, view]) => piecesOf(drawn(view, scene, heat), number));

/** Project views between other jobs, until no more are kept: the first word then doesn't wait for it. */
export async function prepare(views, scene) {
  for (const [, view] of views) {
    await new Promise((go) => setTimeout(go));
    projected(view, scene);
    if (!projections.has(view)) return;
  }
}

/** Draw a view's heat, the mean depth of what is hot, and that of what is seen, at the pixels that something hot reaches. */
export function drawn(view, scene, heat) {
  const { small, points, ellipses } = projected(view, scene), { width, height } = small;
  const [map, depth, surface, clear] = [0, 1, 2, 3].map(() => new Float32Array(width * height));
  let [top, end] = [Infinity, 0]; // of the pixels that something hot reaches
  for (let k = 0; k < ellipses.length; k += FIELDS) {
    const opacity = ellipses[k + OPACITY];
    if (heat[ellipses[k]] > LEVELS[0] && opacity > HOT)
      eachRow(ellipses, k, 2 * Math.log(opacity / HOT), small, (first, last) => (clear.fill(1, first, last), (top = Math.min(top, first)), (end = Math.max(end, last))));
  }
  composite(ellipses, heat, small, top / width, end / width, { map, depth, surface, clear });
  for (let at = 0; at < width * height; at++) {
    if (map[at] > 0) depth[at] /= map[at];
    if (clear[at] < 1) surface[at] /= 1 - clear[at];
  }
  return { map, depth, surface, width, height, rows: view.rows, points, focal: small.fx };
}

/** Composite ellipses front to back at the pixels that are clear, between two rows. One function with loops alone: calls for each
 * ellipse, row or pixel take a fifth more time. */
function composite(flat, heat, { width, height }, top, end, { map, depth, surface, clear }) {
  const next = new Int32Array(clear.length + 1).fill(clear.length); // leads to the next pixel that still matters
  for (let at = 0; at < clear.length; at++) next[at] = at + (clear[at] === 0);
  for (let k = 0; k < flat.length; k += FIELDS) {
    const y = flat[k + Y], high = flat[k + HIGH];
    if (y + high + 1 < top || y - high - 1 > end) continue;
    const hot = heat[flat[k]], x = flat[k + X], z = flat[k + Z], opacity = flat[k + OPACITY], reach = flat[k + REACH], tall = flat[k + TALL], slope = flat[k + SLOPE], narrow = flat[k + NARROW];
    const bottom = Math.min(Math.floor(y + high - 0.5), height - 1);
    for (let row = Math.max(Math.ceil(y - high - 0.5), 0); row <= bottom; row++) {
      const down = row + 0.5 - y, far = (down * down) / tall, wide = Math.sqrt(Math.max(reach - far, 0) / narrow), middle = x + slope * down - 0.5;
      const begin = row * width, last = begin + Math.min(Math.floor(middle + wide), width - 1);
      for (let at = begin + Math.max(Math.ceil(middle - wide), 0); at <= last; at++) {
        const before = clear[at];
        if (before < HIDDEN) {
          let to = at;
          while (next[to] !== to) to = next[to] = next[next[to]];
          at = to - 1;
          continue;
        }
        const aside = at - begin - middle, share = before * Math.min(opacity * FALLOFF[((narrow * aside * aside + far) * FINE + 0.5) | 0], 0.999), light = share * hot;
        map[at] += light;
        depth[at] += light * z;
        surface[at] += share * z;
        clear[at] = before - share;
        if (before - share < HIDDEN) next[at] = at + 1;
      }
    }
  }
}

const projections = new WeakMap(); // of views
let kept = 0; // ellipses in them

/** Project a view's Gaussians: their ellipses, nearest first, and their places. No word changes them, so they are
 * kept, as far as memory allows. */
function projected(view, scene) {
  if (projections.has(view)) return projections.get(view);
  const scale = Math.min(1, SIDE / Math.max(view.width, view.height)), { rows, codes, sizes } = view;
  const [fx, fy, cx, cy] = [view.fx, view.fy, view.cx, view.cy].map((value) => value * scale);
  const small = { ...view, fx, fy, cx, cy, width: Math.round(view.width * scale), height: Math.round(view.height * scale) };
  const points = new Float32Array(3 * rows.length), ellipses = [];
  for (let n = 0; n < rows.length; n++) {
    const i = rows[n], place = seenAt(small, scene.centers.subarray(3 * i, 3 * i + 3)), [x, y, z] = place, one = z > 0 && ellipseOf(small, scene, i, place);
    points.set([x, y, sizes[codes[n]] * view.width * view.height < FILLED ? NaN : z], 3 * n); // NaN belongs to no piece
    if (one) ellipses.push(one);
  }
  const made = { small, points, ellipses: new Float64Array(FIELDS * ellipses.length) }; // a third of the memory of objects
  ellipses.sort((a, b) => a.z - b.z).forEach((one, n) => made.ellipses.set(Object.values(one), FIELDS * n));
  if (kept + ellipses.length <= MOST_KEPT) {
    kept += ellipses.length;
    projections.set(view, made);
  }
  return made;
}

/** Find the ellipse that a Gaussian fills in a view; null if it fills none. */
function ellipseOf(view, { axes, opacities, antialiased }, i, [x, y, z]) {
  const [a, uv, b] = spreadAt(view, axes, i, [x, y, z]), uu = a + BLUR, vv = b + BLUR, area = uu * vv - uv * uv;
  const opacity = opacities[i] * (antialiased ? Math.sqrt(Math.max((a * b - uv * uv) / area, 0)) : 1), reach = 2 * Math.log(255 * opacity);
  return reach > 0 ? { i, x, y, z, opacity, reach, tall: vv, high: Math.sqrt(reach * vv), slope: uv / vv, narrow: vv / area } : null;
}

/** Go through the rows of pixels that an ellipse fills: the first pixel, and the one after the last. */
function eachRow(flat, k, reach, { width, height }, paint) {
  const x = flat[k + X], y = flat[k + Y], tall = flat[k + TALL], slope = flat[k + SLOPE], narrow = flat[k + NARROW];
  const high = Math.sqrt(reach * tall), bottom = Math.min(Math.floor(y + high - 0.5), height - 1);
  for (let row = Math.max(Math.ceil(y - high - 0.5), 0); row <= bottom; row++) {
    const down = row + 0.5 - y, far = (down * down) / tall, wide = Math.sqrt(Math.max(reach - far, 0) / narrow), middle = x + slope * down - 0.5;
    const first = Math.max(Math.ceil(middle - wide), 0), last = Math.min(Math.floor(middle + wide), width - 1);
    if (first <= last) paint(row * width + first, row * width + last + 1);
  }
}

// ── pieces ──

/** Find the pieces of a map that is drawn, with the Gaussians that each one shows. */
function piecesOf({ map, depth, surface, width, height, rows, points, focal }, view) {
  const { labels, pieces } = split(map, width, height), own = pieces.map(() => []);
  for (let k = 0; k < rows.length; k++) {
    const x = points[3 * k], y = points[3 * k + 1], z = points[3 * k + 2];
    if (!(x >= 0 && x < width && y >= 0 && y < height)) continue;
    const at = Math.floor(y) * width + Math.floor(x);
    if (labels[at] && (Math.abs(z - depth[at]) < DEPTH * z || Math.abs(z - surface[at]) < DEPTH * z)) own[labels[at] - 1].push(rows[k]);
  }
  return pieces.flatMap((pixels, k) => {
    if (!own[k].length) return [];
    const depths = Float32Array.from(pixels, (p) => surface[p]).sort(), half = depths.length >> 1;
    const middle = depths.length % 2 ? depths[half] : (depths[half - 1] + depths[half]) / 2;
    let [left, top, right, bottom] = [width, height, 0, 0];
    for (const p of pixels) {
      const [x, y] = [p % width, Math.floor(p / width)];
      (left = Math.min(left, x)), (top = Math.min(top, y)), (right = Math.max(right, x + 1)), (bottom = Math.max(bottom, y + 1));
    }
    const cut = left <= 1 || top <= 1 || right >= width - 1 || bottom >= height - 1;
    return [{ view, rows: own[k], resolution: focal / middle, area: pixels.length, cut }];
  });
}

/** Number the pieces of a map from 1, and list the pixels of each. */
export function split(map, width, height) {
  const labels = new Int32Array(map.length), pieces = [], stamps = new Int32Array(map.length);
  let stamp = 0;
  const parts = (pixels, level) => {
    const open = ++stamp, found = [];
    for (const p of pixels) if (map[p] > level) stamps[p] = open;
    for (const start of pixels) {
      if (stamps[start] !== open) continue;
      const part = [start];
      stamps[start] = 0;
      for (let k = 0; k < part.length; k++) {
        const p = part[k], x = p % width, y = Math.floor(p / width);
        const next = [x > 0 ? p - 1 : -1, x < width - 1 ? p + 1 : -1, y > 0 ? p - width : -1, y < height - 1 ? p + width : -1];
        for (const q of next) if (q >= 0 && stamps[q] === open) (stamps[q] = 0), part.push(q);
      }
      found.push(part);
    }
    return found;
  };
  const leaves = (region, level) => {
    if (level === LEVELS.length) return [region];
    const large = parts(region, LEVELS[level]).filter((part) => part.length >= Math.max(LEAST, PART * region.length));
    const found = large.flatMap((part) => leaves(part, level + 1));
    return found.length > 1 ? found : [region];
  };
  const everywhere = [];
  for (let p = 0; p < map.length; p++) if (map[p] > LEVELS[0]) everywhere.push(p);
  for (const region of parts(everywhere, LEVELS[0])) if (region.length >= LEAST) pieces.push(...leaves(region, 1));
  pieces.forEach((pixels, k) => pixels.forEach((p) => (labels[p] = k + 1)));
  return { labels, pieces };
}
