// The Gaussians that a pixel shows, front to back, with their weights in the picture.
import { floats } from "./decode.js";
import { seenAt } from "./space.js";

export const BLUR = 0.3; // square pixels added to every splat's variance, as in training
const MARGIN = 1.3; // half sizes of the picture beyond which a splat keeps its shape at this limit: see gaussians.py

/** Unpack centers [3n] (relative to the scene's origin), axes [9n] scaled by standard deviations, opacities [n]. */
export function unpackSplats(buffer) {
  const bytes = new Uint8Array(buffer), halves = new Uint16Array(buffer), count = bytes.length / 16;
  const centers = new Float32Array(3 * count), axes = new Float32Array(9 * count), opacities = new Float32Array(count);
  for (let i = 0; i < count; i++) {
    const at = 16 * i;
    centers.set(floats(halves.subarray(8 * i + 2, 8 * i + 5)), 3 * i);
    opacities[i] = bytes[at + 3] / 255;
    const [u, v] = [bytes[at + 10] / 127.5 - 1, bytes[at + 11] / 127.5 - 1], w = 1 - Math.abs(u) - Math.abs(v);
    const fold = Math.max(-w, 0), x = u + (u >= 0 ? -fold : fold), y = v + (v >= 0 ? -fold : fold);
    const turn = rotation([x, y, w], (bytes[at + 15] / 255) * Math.PI);
    for (let k = 0; k < 9; k++) axes[9 * i + k] = turn[k] * Math.exp(((bytes[at + 12 + Math.floor(k / 3)] - 1) * 21) / 254 - 12);
  }
  return { centers, axes, opacities };
}

/** Compute the rotation by an angle about an axis (Rodrigues), column by column. */
function rotation(axis, angle) {
  const length = Math.hypot(...axis), [x, y, z] = axis.map((value) => value / length);
  const c = Math.cos(angle), s = Math.sin(angle), t = 1 - c;
  return [c + t * x * x, t * x * y + s * z, t * x * z - s * y, t * x * y - s * z, c + t * y * y, t * y * z + s * x,
    t * x * z + s * y, t * y * z - s * x, c + t * z * z]; // prettier-ignore
}

/** Return for each pixel [x, y] the Gaussians that it shows: [row, weight, center]. geometries: of the scene's parts, whose
 * rows count from `first` on; camera: a view as of find.js, in their frame. */
export function gaussiansAt(geometries, camera, pixels, antialiased) {
  const hits = pixels.map(() => []);
  for (const geometry of geometries) addHits(hits, geometry, camera, pixels, antialiased);
  return hits.map((found) => {
    let clear = 1;
    return found.sort((a, b) => a[0] - b[0]).map(([, row, alpha, center]) => {
      const weight = clear * alpha;
      clear -= weight;
      return [row, weight, center];
    });
  });
}

/** Add what pixels show of one part: [depth, row, opacity, center]. */
function addHits(hits, { centers, axes, opacities, first = 0 }, camera, pixels, antialiased) {
  for (let i = 0; i < opacities.length; i++) {
    const center = centers.subarray(3 * i, 3 * i + 3), place = seenAt(camera, center), [x, y, depth] = place;
    if (depth <= 0.01 || opacities[i] < 1 / 255) continue;
    let reach = 0, spread = null;
    for (let k = 0; k < 9; k++) reach = Math.max(reach, Math.abs(axes[9 * i + k]));
    const far = 2 + (8 * camera.fx * reach) / depth;
    for (let p = 0; p < pixels.length; p++) {
      const du = pixels[p][0] - x, dv = pixels[p][1] - y;
      if (Math.abs(du) > far || Math.abs(dv) > far) continue;
      spread ??= spreadAt(camera, axes, i, place);
      const [a, uv, b] = spread, uu = a + BLUR, vv = b + BLUR, area = uu * vv - uv * uv;
      const sharp = antialiased ? Math.sqrt(Math.max((a * b - uv * uv) / area, 0)) : 1;
      const alpha = opacities[i] * sharp * Math.exp((2 * uv * du * dv - vv * du * du - uu * dv * dv) / area / 2);
      if (alpha > 1 / 255) hits[p].push([depth, first + i, Math.min(alpha, 0.999), [...center]]);
    }
  }
}

/** Compute the covariance of a Gaussian's ellipse around its place in a view, square pixels: uu, uv, vv. */
export function spreadAt({ pose, fx, fy, cx, cy, width, height }, axes, i, [x, y, depth]) {
  const within = (slope, most) => Math.max(-most, Math.min(slope, most));
  const right = within((x - cx) / fx, (MARGIN * width) / 2 / fx), up = within((cy - y) / fy, (MARGIN * height) / 2 / fy);
  let uu = 0, uv = 0, vv = 0;
  for (let k = 9 * i; k < 9 * i + 9; k += 3) {
    const turned = (column) => axes[k] * pose[0][column] + axes[k + 1] * pose[1][column] + axes[k + 2] * pose[2][column], back = turned(2);
    const u = (fx * (turned(0) + right * back)) / depth, v = (-fy * (turned(1) + up * back)) / depth;
    (uu += u * u), (uv += u * v), (vv += v * v);
  }
  return [uu, uv, vv];
}

/** Compute the place of what a pixel shows: the center of the Gaussian with which half of its weight is reached. */
export function middleOf(hits) {
  const total = hits.reduce((sum, [, weight]) => sum + weight, 0);
  if (total < 0.1) return null;
  let before = 0;
  return hits.find(([, weight]) => (before += weight) >= total / 2)[2];
}

/** Choose the view in which most of the points ({ point, row }) are visible, the preferred ones first, then by how
 * large they are there: { index, pixels: where the visible points lie, in shares of the view }; null without any. */
export function bestPhoto(views, points, preferred) {
  let best = null;
  views.forEach((view, index) => {
    let size = 0;
    const pixels = [];
    for (const { point, row } of points) {
      const k = view.rows.indexOf(row), [x, y, depth] = seenAt(view, point);
      if (k < 0 || !(depth > 0 && x > 0 && x < view.width && y > 0 && y < view.height)) continue;
      pixels.push([x / view.width, y / view.height]);
      size += view.sizes[view.codes[k]];
    }
    const rank = [pixels.length, preferred.includes(index) ? 1 : 0, size];
    if (pixels.length && (!best || before(best.rank, rank))) best = { index, pixels, rank };
  });
  return best;
}

const before = (a, b) => a.find((value, k) => value !== b[k]) < b.find((value, k) => value !== a[k]);
