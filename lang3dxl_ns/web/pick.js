// The Gaussians that a pixel shows, front to back, with their weights in the picture.
import { floats } from "./decode.js";
import { seenAt } from "./space.js";

const BLUR = 0.3; // square pixels added to every splat's variance, as in training
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

/** Return the Gaussians that pixel x, y shows: [row, weight, center]. geometries: of the scene's parts, whose rows count
 * from `first` on; camera: { view: world → camera by columns, looking along −z; focal, width, height in pixels }. */
export function gaussiansAt(geometries, camera, x, y, antialiased) {
  const hits = geometries.flatMap((geometry) => hitsOf(geometry, camera, x, y, antialiased));
  let clear = 1;
  return hits.sort((a, b) => a[0] - b[0]).map(([, row, alpha, center]) => {
    const weight = clear * alpha;
    clear -= weight;
    return [row, weight, center];
  });
}

/** List what a pixel shows of one part: [depth, row, opacity, center]. */
function hitsOf({ centers, axes, opacities, first = 0 }, { view, focal, width, height }, x, y, antialiased) {
  const hits = [];
  const [widest, highest] = [width, height].map((side) => (MARGIN * side) / 2 / focal);
  const within = (slope, most) => Math.max(-most, Math.min(slope, most));
  const turned = (a, b, c) => [0, 1, 2].map((k) => view[k] * a + view[4 + k] * b + view[8 + k] * c);
  for (let i = 0; i < opacities.length; i++) {
    const [a, b, c] = [centers[3 * i], centers[3 * i + 1], centers[3 * i + 2]];
    const depth = -(view[2] * a + view[6] * b + view[10] * c + view[14]);
    if (depth <= 0.01 || opacities[i] < 1 / 255) continue;
    const right = (view[0] * a + view[4] * b + view[8] * c + view[12]) / depth;
    const up = (view[1] * a + view[5] * b + view[9] * c + view[13]) / depth;
    const du = x - width / 2 - focal * right, dv = y - height / 2 + focal * up;
    let reach = 0;
    for (let k = 0; k < 9; k++) reach = Math.max(reach, Math.abs(axes[9 * i + k]));
    if (Math.max(Math.abs(du), Math.abs(dv)) > 2 + (8 * focal * reach) / depth) continue;
    let uu = 0, uv = 0, vv = 0;
    const [sideways, upwards] = [within(right, widest), within(up, highest)];
    for (let k = 9 * i; k < 9 * i + 9; k += 3) {
      const [p, q, r] = turned(axes[k], axes[k + 1], axes[k + 2]);
      const u = (focal * (p + sideways * r)) / depth, v = (-focal * (q + upwards * r)) / depth;
      (uu += u * u), (uv += u * v), (vv += v * v);
    }
    const sharp = uu * vv - uv * uv;
    uu += BLUR;
    vv += BLUR;
    const area = uu * vv - uv * uv, far = (vv * du * du - 2 * uv * du * dv + uu * dv * dv) / area;
    const alpha = opacities[i] * Math.exp(-far / 2) * (antialiased ? Math.sqrt(Math.max(sharp / area, 0)) : 1);
    if (alpha > 1 / 255) hits.push([depth, first + i, Math.min(alpha, 0.999), [a, b, c]]);
  }
  return hits;
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
