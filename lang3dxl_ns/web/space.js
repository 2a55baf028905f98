// The free space of a scene: where the eye may be, since photos look through it or were taken there.

const CELLS = 20, SIDE = 44, MOST_VIEWS = 64; // cells along a view's longer side, of the space's longest axis; views used
const CLEAR = 0.95, FARTHEST = 1.5, NEAR = 0.12, HIDDEN = 0.2; // share of a depth that is free; of the median depth: farthest, and around a photo; share of a cell's pixels that lie before its surface

/** Find the free space as { low, step, sides, bits }: cells of `step` units from `low` on, 1 where a photo was taken
 * nearby or some view sees farther. views, centers: as of find.js, in one frame. */
export function freeSpace(views, centers) {
  if (!views.length) return null;
  const some = views.filter((_, k) => k % Math.ceil(views.length / MOST_VIEWS) === 0).map((view) => surfaceOf(view, centers));
  const places = views.map(({ pose }) => [0, 1, 2].map((axis) => pose[axis][3]));
  const median = sorted(some.map(({ median }) => median))[some.length >> 1], around = NEAR * median;
  const ends = [0, 1, 2].map((axis) => {
    const values = [...places.map((place) => place[axis]), ...some.flatMap(({ middle }) => [middle[axis] - 0.5 * median, middle[axis] + 0.5 * median])];
    return [Math.min(...values) - around, Math.max(...values) + around];
  });
  const step = Math.max(...ends.map(([low, high]) => high - low)) / SIDE, low = ends.map(([first]) => first);
  const sides = ends.map(([first, last]) => Math.max(Math.ceil((last - first) / step), 1)), bits = new Uint8Array(sides[0] * sides[1] * sides[2]);
  const reach = Math.max(around, step) + step / 2, near = ([x, y, z]) => places.some(([a, b, c]) => (x - a) ** 2 + (y - b) ** 2 + (z - c) ** 2 < reach ** 2);
  for (let i = 0; i < bits.length; i++) {
    const cell = [i % sides[0], Math.floor(i / sides[0]) % sides[1], Math.floor(i / sides[0] / sides[1])];
    const point = cell.map((value, axis) => low[axis] + (value + 0.5) * step);
    bits[i] = near(point) || some.some((view) => looksThrough(view, point));
  }
  return { low, step, sides, bits };
}

const sorted = (values) => Float32Array.from(values).sort();

/** Project a point: pixel x, y, and depth. */
export function seenAt({ pose, fx, fy, cx, cy }, [x, y, z]) {
  const a = x - pose[0][3], b = y - pose[1][3], c = z - pose[2][3];
  const [right, up, back] = [0, 1, 2].map((k) => a * pose[0][k] + b * pose[1][k] + c * pose[2][k]);
  return [cx - (fx * right) / back, cy + (fy * up) / back, -back];
}

/** Measure the depth of what a view shows, by cells: where a fifth of a cell's pixels is nearer. */
function surfaceOf(view, centers) {
  const { rows, codes, sizes, width, height, pose } = view, size = Math.max(width, height) / CELLS;
  const across = Math.ceil(width / size), found = Array.from({ length: across * Math.ceil(height / size) }, () => []);
  const all = [];
  rows.forEach((row, k) => {
    const [x, y, depth] = seenAt(view, [centers[3 * row], centers[3 * row + 1], centers[3 * row + 2]]);
    if (!(depth > 0 && x >= 0 && x < width && y >= 0 && y < height)) return;
    found[Math.floor(x / size) + across * Math.floor(y / size)].push([depth, sizes[codes[k]]]);
    all.push([depth, sizes[codes[k]]]);
  });
  const median = quantile(all, 0.5) || 1;
  const depths = Float32Array.from(found, (some) => Math.min(quantile(some, HIDDEN) || median, FARTHEST * median));
  const middle = [0, 1, 2].map((axis) => pose[axis][3] - median * pose[axis][2]);
  return { ...view, size, across, depths, median, middle };
}

function quantile(pairs, share) {
  pairs.sort((a, b) => a[0] - b[0]);
  const total = pairs.reduce((sum, [, weight]) => sum + weight, 0);
  let before = 0;
  return pairs.find(([, weight]) => (before += weight) >= share * total)?.[0] ?? 0;
}

function looksThrough(view, point) {
  const [x, y, depth] = seenAt(view, point);
  if (!(depth > 0 && x >= 0 && x < view.width && y >= 0 && y < view.height)) return false;
  return depth < CLEAR * view.depths[Math.floor(x / view.size) + view.across * Math.floor(y / view.size)];
}
