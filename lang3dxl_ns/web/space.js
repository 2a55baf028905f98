// The free space of a scene: where the eye may be, since photos look through it or were taken there.

const CELLS = 20, MOST_VIEWS = 64; // cells along a view's longer side; views used
const CLEAR = 0.95, FARTHEST = 1.5, NEAR = 0.12, HIDDEN = 0.2; // share of a depth that is free; of the median depth: farthest, and around a photo; share of a cell's pixels that lie before its surface

/** Find what tells where the eye may be: { places of photos, reach around them, surfaces that views show }. views,
 * centers: as of find.js, in one frame. */
export function freeSpace(views, centers) {
  if (!views.length) return null;
  const surfaces = views.filter((_, k) => k % Math.ceil(views.length / MOST_VIEWS) === 0).map((view) => surfaceOf(view, centers));
  const median = Float32Array.from(surfaces, (surface) => surface.median).sort()[surfaces.length >> 1];
  return { places: views.map(({ pose }) => pose.slice(0, 3).map((row) => row[3])), reach: NEAR * median, surfaces };
}

/** Return whether the eye may be at a point: near where a photo was taken, or before what some view shows. */
export function isFree({ places, reach, surfaces }, [x, y, z]) {
  return places.some(([a, b, c]) => Math.hypot(x - a, y - b, z - c) < reach) || surfaces.some((surface) => looksThrough(surface, [x, y, z]));
}

/** Project a point: pixel x, y, and depth. */
export function seenAt({ pose, fx, fy, cx, cy }, [x, y, z]) {
  const a = x - pose[0][3], b = y - pose[1][3], c = z - pose[2][3];
  const [right, up, back] = [0, 1, 2].map((k) => a * pose[0][k] + b * pose[1][k] + c * pose[2][k]);
  return [cx - (fx * right) / back, cy + (fy * up) / back, -back];
}

/** Measure the depth of what a view shows, by cells: where a fifth of a cell's pixels is nearer. */
function surfaceOf(view, centers) {
  const { rows, codes, sizes, width, height, pose, fx, fy, cx, cy } = view, size = Math.max(width, height) / CELLS;
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
  return { pose, fx, fy, cx, cy, width, height, size, across, depths, median };
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
