// Single things out of a word's relevancy, as in Python's things/: pieces of each view, joined by shared Gaussians.
import language from "./language.js";
import { fitted } from "./like.js";
import { seenAt } from "./space.js";

const { LEVELS, FILLED, AGREED, PARTLY, SHARED, SPLINTER, VIEWS, CRUMB, OFTEN, OVER, OVERLAP, OUTLIERS, COLORED, APART, PRESENT, TOLD, SLIM, STRAIGHT, LIGHT_PART, ROUND, CROWN, LIGHT, PLACES, SHOWN } = language.things;
const RIDGE = 0.1, ROUNDS = 12; // strength of the colors' regularization, Newton steps
const DC = 0.28209479177387814; // of spherical harmonics: colors are compared as coefficients

/** Find the things of a word: { things, candidates }, each largest first, and the word that all of them fit better, if there is
 * one. pieces: of its sharpened heat, in the order of the views; views: as of find.js; scene: { centers, mass, gap, edges (of
 * boxes, a direction each) }, in one frame; taught: whether examples taught the word; better: names what weighted rows fit
 * better, or null. */
export function thingsOf(pieces, views, scene, relevancy, taught, better) {
  const weight = Float64Array.from(relevancy, (value, i) => Math.sqrt(scene.mass[i]) * value);
  const box = ({ rows }) => uprightBox(rows, scene.centers, weight, scene.edges);
  const whole = grown(join(pieces, weight, box, (v, i) => isFilledBy(views[v], i)), weight.length);
  const level = (i) => scene.edges.slice(0, 2).map((axis) => axis.reduce((sum, value, k) => sum + value * scene.centers[3 * i + k], 0));
  const parts = parted(whole, level, weight, APART * scene.gap);
  const joined = placed(parts, parts.map(box));
  const isPresent = ({ rows }) => taught || rows.some((i) => relevancy[i] >= PRESENT);
  const fitting = withoutCrumbs(joined).filter((one) => photosOf(one).size >= VIEWS && isPresent(one)).sort((a, b) => b.weight - a.weight);
  const words = fitting.map(({ rows }) => better(rows.filter((_, k) => k % (1 + Math.floor(rows.length / TOLD)) === 0).map((i) => [i, (weight[i] * relevancy[i]) ** 2])));
  const sure = new Set(fitting.filter((_, k) => !words[k]));
  const listed = (some) => some.map((one) => described(one, scene, weight, relevancy)).sort((a, b) => b.weight - a.weight);
  return { things: listed([...sure]), candidates: listed(joined.filter((one) => !sure.has(one))), better: sure.size ? null : words[0] };
}

/** Whether a word names something here: its peak exceeds the lowest level. */
export function isThere(relevancy, { best }) {
  const sorted = relevancy.slice().sort(), top = Math.max(Math.ceil(best * sorted.length), 1);
  const peak = sorted.slice(-top).reduce((sum, value) => sum + value, 0) / top;
  return peak > LEVELS[0];
}

/** Tell which things of a word, by their rows, a view shows: see things/outlines.py. hitsAt: lists what pixels show, as
 * pick.js; rowOf: finds the row of what it lists. */
export function areShown(things, camera, centers, hitsAt, rowOf) {
  const owner = new Map(), places = [], counts = things.map(() => ({ own: 0, all: 0 }));
  things.forEach((rows, t) => {
    for (const i of rows) owner.set(i, t);
    for (let k = 0; k < rows.length; k += 1 + Math.floor((rows.length - 1) / PLACES)) {
      const [x, y, z] = seenAt(camera, centers.subarray(3 * rows[k], 3 * rows[k] + 3));
      if (z > 0 && x >= 0 && x < camera.width && y >= 0 && y < camera.height) places.push({ t, pixel: [Math.floor(x) + 0.5, Math.floor(y) + 0.5] });
    }
  });
  hitsAt(camera, places.map(({ pixel }) => pixel)).forEach((hits, k) => {
    const { t } = places[k], lit = hits.map(([id, weight]) => [owner.get(rowOf(id)), weight]), light = (some) => some.reduce((sum, [, weight]) => sum + weight, 0);
    const any = light(lit.filter(([of]) => of !== undefined)), own = light(lit.filter(([of]) => of === t));
    if (any > LIGHT && own > any / 2) counts[t].own++;
    counts[t].all++;
  }); // prettier-ignore
  return counts.map(({ own, all }) => own > 0 && own >= SHOWN * all);
}

const photosOf = ({ votes }) => new Set(votes.map(({ view }) => view));

function described({ rows, weight, votes }, { centers, mass, edges }, weights, relevancy) {
  const shown = new Map(), strength = (i) => mass[i] * (shown.get(i) ?? 0) * relevancy[i] ** 2;
  for (const piece of votes) for (const i of piece.rows) shown.set(i, (shown.get(i) ?? 0) + 1);
  const id = rows.reduce((best, i) => (strength(i) > strength(best) ? i : best));
  const seen = [...new Set([...votes].sort((a, b) => a.cut - b.cut || b.area - a.area).map(({ view }) => view))];
  return { id, weight, views: seen.length, rows: Uint32Array.from(rows).sort(), seen, ...uprightBox(rows, centers, weights, edges) };
}

// ── heat ──

/** Multiply relevancies by how much a color is that of the matches, and not of what is around them. */
export function sharpened({ centers, bytes, mass, gap }, relevancy) {
  const match = [], around = [];
  for (let i = 0; i < relevancy.length; i++) if (relevancy[i] > 0.9 && mass[i] > 0) match.push(i);
  if (match.length < COLORED) return relevancy;
  const near = neighborhood(centers, match, gap);
  for (let i = 0; i < relevancy.length; i++) if (relevancy[i] < 0.5 && mass[i] > 0 && near(i)) around.push(i);
  if (around.length < COLORED) return relevancy;
  const color = (i) => [...[0, 1, 2].map((k) => (bytes[16 * i + k] / 255 - 0.5) / DC), 1];
  const total = (rows) => rows.reduce((sum, i) => sum + Math.sqrt(mass[i]), 0), all = match.length + around.length;
  const samples = [match, around].flatMap((rows, other) => {
    const share = all / 2 / total(rows);
    return rows.map((i) => ({ at: color(i), is: 1 - other, weight: Math.sqrt(mass[i]) * share }));
  });
  const beta = fitted(samples, 4, RIDGE, ROUNDS);
  return relevancy.map((value, i) => value / (1 + Math.exp(-color(i).reduce((sum, x, k) => sum + x * beta[k], 0))));
}

/** Return a function that tells whether a Gaussian lies within a distance of one of these rows. */
function neighborhood(centers, rows, distance) {
  const cells = new Map(), cell = (i, axis) => Math.floor(centers[3 * i + axis] / distance), key = (x, y, z) => (x * 2097143 + y) * 2097143 + z; // numbers, since texts are slow
  for (const i of rows) {
    const at = key(cell(i, 0), cell(i, 1), cell(i, 2));
    if (cells.has(at)) cells.get(at).push(i);
    else cells.set(at, [i]);
  }
  const close = (i) => (j) => (centers[3 * i] - centers[3 * j]) ** 2 + (centers[3 * i + 1] - centers[3 * j + 1]) ** 2 + (centers[3 * i + 2] - centers[3 * j + 2]) ** 2 <= distance ** 2;
  return (i) => {
    const [x, y, z] = [cell(i, 0), cell(i, 1), cell(i, 2)], here = close(i);
    for (let a = -1; a <= 1; a++)
      for (let b = -1; b <= 1; b++)
        for (let c = -1; c <= 1; c++) if (cells.get(key(x + a, y + b, z + c))?.some(here)) return true;
    return false;
  };
}

// ── things ──

/** Return a function that tells whether a piece of another view shows the same as a piece: see things/join.py. shows: tells
 * whether a view shows a Gaussian. */
function agreement(pieces, weight, shows) {
  const holders = new Map(), sum = (rows) => rows.reduce((all, i) => all + weight[i], 0);
  for (const piece of pieces) for (const i of piece.rows) (holders.get(i) ?? holders.set(i, []).get(i)).push(piece);
  return ({ rows, view }) => {
    const common = new Map(), total = sum(rows);
    for (const i of rows) for (const other of holders.get(i)) if (other.view !== view) common.set(other, (common.get(other) ?? 0) + weight[i]);
    return [...common].some(([other, both]) => {
      const seen = sum(rows.filter((i) => shows(other.view, i)));
      return seen >= PARTLY * total && both >= AGREED * (seen + sum(other.rows.filter((i) => shows(view, i))) - both);
    });
  };
}

/** Whether a Gaussian fills enough of a view to belong to its pieces. */
function isFilledBy({ rows, codes, sizes, width, height }, i) {
  let [first, end] = [0, rows.length];
  while (first < end) {
    const middle = (first + end) >> 1;
    if (rows[middle] < i) first = middle + 1;
    else end = middle;
  }
  return rows[first] === i && sizes[codes[first]] * width * height >= FILLED;
}

/** Join the pieces of all views, from the finest resolution to the coarsest: see things/join.py. */
export function join(pieces, weight, box, shows) {
  const owner = new Int32Array(weight.length).fill(-1), things = [], together = new Map(), agrees = agreement(pieces, weight, shows);
  for (const piece of [...pieces].sort((a, b) => a.cut - b.cut || b.resolution - a.resolution)) {
    const shared = new Map();
    let total = 0, taken = 0;
    for (const i of piece.rows) {
      total += weight[i];
      if (owner[i] < 0) continue;
      taken += weight[i];
      shared.set(owner[i], (shared.get(owner[i]) ?? 0) + weight[i]);
    }
    if (!(total > 0)) continue;
    let covered = [...shared].filter(([t, value]) => value > SHARED * things[t].weight).map(([t]) => t);
    const [best, most] = [...shared].reduce((one, other) => (other[1] > one[1] || (other[1] === one[1] && other[0] < one[0]) ? other : one), [-1, 0]);
    const share = best < 0 ? 0 : most / things[best].weight;
    if (covered.length > 1) {
      for (const a of covered) for (const b of covered) if (a < b) together.set(`${a} ${b}`, (together.get(`${a} ${b}`) ?? new Set()).add(piece.view));
    } else if (best >= 0 && (most > SHARED * total || share > SHARED)) {
      if (share >= SPLINTER && !(piece.cut && share <= SHARED)) things[(covered = [best])[0]].votes.push(piece);
    } else if (!piece.cut && taken <= SHARED * total && agrees(piece)) {
      const rows = piece.rows.filter((i) => owner[i] < 0);
      for (const i of rows) owner[i] = things.length;
      covered = [things.length];
      things.push({ rows, weight: rows.reduce((sum, i) => sum + weight[i], 0), votes: [piece], shows: new Set() });
    }
    for (const t of covered) things[t].shows.add(piece.view);
  }
  return united(things, together, box).filter(({ rows }) => rows.length > 1);
}

/** Unite each thing with the heavier one that most photos cover together with it, unless a photo shows each alone, or
 * shows both in two pieces and neither stands over the other. */
function united(things, together, box) {
  const photos = things.map(photosOf), best = new Map(), both = (a, b) => [...a].filter((photo) => b.has(photo));
  const counted = [...together].map(([pair, shown]) => ({ pair: pair.split(" ").map(Number), shown })).sort((a, b) => a.pair[0] - b.pair[0] || a.pair[1] - b.pair[1]);
  for (const { pair, shown } of counted) {
    const [heavy, light] = pair.sort((a, b) => things[b].weight - things[a].weight || a - b);
    if (!both(photos[heavy], photos[light]).length && shown.size > (best.get(light)?.shown.size ?? 0)) best.set(light, { heavy, shown });
  }
  const pairs = [...best].map(([light, { heavy, shown }]) => [light, heavy, both(things[heavy].shows, things[light].shows).every((photo) => shown.has(photo))]);
  const boxes = new Map();
  for (const group of grouped(things, pairs.filter(([, , neverApart]) => neverApart))) {
    const whole = box(group);
    for (const part of group.parts) boxes.set(part, whole);
  }
  return grouped(things, pairs.filter(([a, b]) => isOver(boxes.get(things[a]), boxes.get(things[b]))));
}

const isOver = (a, b) => [0, 1].every((k) => Math.abs(a.axes[k].reduce((sum, value, i) => sum + value * (a.center[i] - b.center[i]), 0)) <= OVER * (a.size[k] + b.size[k]));

/** Give each of count Gaussians to the thing of which most pieces show it, at least two; its founder counts twice. */
export function grown(things, count) {
  const owner = new Int32Array(count).fill(-1), most = new Int32Array(count).fill(1), own = things.map(() => []);
  things.forEach(({ rows, votes }, t) => {
    const times = new Map();
    for (const shown of [rows, ...votes.map((piece) => piece.rows)]) for (const i of shown) times.set(i, (times.get(i) ?? 0) + 1);
    for (const [i, count] of times) if (count > most[i]) (owner[i] = t), (most[i] = count);
  });
  owner.forEach((t, i) => t >= 0 && own[t].push(i));
  return things.map((thing, t) => ({ ...thing, rows: own[t] })).filter(({ rows }) => rows.length > 1);
}

/** Split off each part of a thing that an empty strip separates from all else, and that is no wider: see things/join.py.
 * level: returns a Gaussian's place along two level axes; space: the strip's least width. */
export function parted(things, level, weight, space) {
  return things.flatMap((thing) => {
    const { rows } = thing, places = rows.map(level), strips = rows.map(() => ""), groups = new Map();
    for (const axis of [0, 1]) {
      let strip = 0;
      [...rows.keys()].sort((a, b) => places[a][axis] - places[b][axis]).forEach((k, n, order) => {
        if (n && places[k][axis] - places[order[n - 1]][axis] > space) strip++;
        strips[k] += `${strip} `;
      });
    }
    strips.forEach((strip, k) => (groups.get(strip) ?? groups.set(strip, []).get(strip)).push(k));
    const isWide = (some) => [0, 1].some((axis) => some.reduce((most, k) => Math.max(most, places[k][axis]), -Infinity) - some.reduce((least, k) => Math.min(least, places[k][axis]), Infinity) > space);
    const wide = [...groups.values()].filter(isWide), parts = [...[...groups.values()].filter((some) => !isWide(some)), ...(wide.length ? [wide.flat()] : [])];
    if (parts.length === 1) return [thing];
    return parts.flatMap((part) => {
      const own = new Set(part.map((k) => rows[k])), sum = (some) => some.reduce((all, i) => all + (own.has(i) ? weight[i] : 0), 0), total = sum(rows);
      const votes = thing.votes.filter((piece) => sum(piece.rows) > SHARED * total);
      return own.size > 1 && votes.length ? [{ ...thing, rows: [...own], weight: total, votes }] : [];
    });
  });
}

/** Unite things whose boxes overlap, slim ones with what stands on or below them, any with what is far lighter there, deep ones with what
 * crowns them. */
export function placed(things, boxes) {
  const pairs = [], volume = (size) => size.reduce((all, side) => all * side, 1), wide = ([x, y]) => Math.max(x, y);
  boxes.forEach(({ center, axes, size }, a) => {
    const width = wide(size);
    boxes.forEach((other, b) => {
      const [x, y, high] = axes.map((axis) => axis.reduce((sum, value, k) => sum + value * (other.center[k] - center[k]), 0));
      const common = volume([x, y, high].map((far, k) => Math.max(0, Math.min((size[k] + other.size[k]) / 2 - Math.abs(far), size[k], other.size[k]))));
      const overlap = common > OVERLAP * (volume(size) + volume(other.size) - common), near = Math.abs(high) - (size[2] + other.size[2]) / 2 < size[2];
      const slim = size[2] >= SLIM * width && Math.hypot(x, y) < STRAIGHT * width;
      const part = Math.abs(x) < size[0] / 2 && Math.abs(y) < size[1] / 2 && things[b].weight < LIGHT_PART * things[a].weight;
      const small = wide(other.size) < CROWN[0] * width && wide([Math.abs(x), Math.abs(y)]) < CROWN[1] * width;
      if (a !== b && (overlap || (near && (slim || part || (small && Math.min(size[0], size[1]) > ROUND * width && high > 0))))) pairs.push([a, b]);
    });
  });
  return grouped(things, pairs);
}

function grouped(things, pairs) {
  const parent = things.map((_, t) => t), root = (t) => (parent[t] === t ? t : (parent[t] = root(parent[t])));
  for (const [a, b] of pairs) {
    const [low, high] = [root(a), root(b)].sort((x, y) => x - y);
    parent[high] = low;
  }
  const groups = new Map();
  things.forEach((thing, t) => groups.set(root(t), [...(groups.get(root(t)) ?? []), thing]));
  return [...groups.values()].map((parts) => ({
    parts, rows: parts.flatMap(({ rows }) => rows), votes: parts.flatMap(({ votes }) => votes),
    weight: parts.reduce((sum, { weight }) => sum + weight, 0),
  })); // prettier-ignore
}

/** Leave out the things that weigh far less than the typical one and that few views show. */
export function withoutCrumbs(things) {
  const weights = things.map(({ weight }) => weight).sort((a, b) => b - a), all = weights.reduce((sum, value) => sum + value, 0);
  let before = 0;
  const typical = weights.find((value) => (before += value) >= all / 2) ?? 0;
  return things.filter((thing) => thing.weight >= CRUMB * typical || photosOf(thing).size >= OFTEN);
}

/** Find the box around weighted Gaussians along axes, of which the last is up: { center, axes, size }. */
export function uprightBox(rows, centers, weight, axes) {
  const total = rows.reduce((sum, i) => sum + weight[i], 0), values = new Float64Array(rows.length), order = Uint32Array.from(rows.keys());
  const sides = axes.map((axis) => {
    rows.forEach((i, k) => (values[k] = centers[3 * i] * axis[0] + centers[3 * i + 1] * axis[1] + centers[3 * i + 2] * axis[2]));
    order.sort((a, b) => values[a] - values[b]);
    return [OUTLIERS, 1 - OUTLIERS].map((share) => quantile(share, rows, values, order, weight, total));
  });
  const center = [0, 1, 2].map((k) => sides.reduce((sum, [low, high], a) => sum + ((low + high) / 2) * axes[a][k], 0));
  return { axes, size: sides.map(([low, high]) => high - low), center };
}

/** Interpolate a weighted quantile, as numpy's interp does between the middles of the weights. */
function quantile(share, rows, values, order, weight, total) {
  let sum = 0, before = null;
  for (const k of order) {
    const at = (sum + weight[rows[k]] / 2) / total;
    sum += weight[rows[k]];
    if (at >= share) return before === null ? values[k] : before.value + ((values[k] - before.value) * (share - before.at)) / Math.max(at - before.at, 1e-12);
    before = { at, value: values[k] };
  }
  return before.value;
}
