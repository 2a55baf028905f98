// Teaching words: marks in the view or in a photo, as Gaussians for this page and as examples for `lang3dxl teach`.
import { element } from "./cards.js";
import { inFile } from "./photos.js";

const GRID = 15, SAMPLES = 48, LONGEST = 6000; // a side of the grid around an outline, pixels sampled in it, characters of a link
export const UNNAMED = /^like this (\d+)$/;

/** Sample pixels evenly within an outline. */
export function inside(outline) {
  const [left, right, top, bottom] = [0, 1].flatMap((axis) => [Math.min, Math.max].map((most) => most(...outline.map((place) => place[axis]))));
  const pen = element("canvas").getContext("2d"), path = new Path2D(`M${outline.join("L")}Z`), ways = Array.from({ length: GRID }, (_, k) => (k + 0.5) / GRID);
  const grid = ways.flatMap((y) => ways.map((x) => [left + x * (right - left), top + y * (bottom - top)]));
  const found = grid.filter(([x, y]) => pen.isPointInPath(path, x, y, "evenodd")), step = Math.max(Math.ceil(found.length / SAMPLES), 1);
  return found.length ? found.filter((_, k) => k % step === 0) : [outline[0]];
}

// ── marks in a link: rows, then the photo's number with places in it, in shares of its sides ──

const FINE = 1e5; // steps of a side in which places are kept
export const rounded = (points) => points?.map((place) => place.map((share) => Math.round(FINE * share) / FINE));
const placesAsText = (points) => points.map((place) => place.map((share) => Math.round(FINE * share)).join(".")).join("!");

/** Write examples as text, for the address. */
export function examplesAsText(name, examples) {
  const one = ({ rows, without, photo, points, outline }) =>
    (without ? "-" : "") + rows.join(".") + (photo === undefined ? "" : `@${photo}${outline ? "o" : "p"}${placesAsText(outline ?? points)}`);
  const all = [name, ...examples.map(one)].join("~");
  // Photos' places are for files of words: a link that would be too long keeps what the page itself needs.
  return all.length <= LONGEST ? all : [name, ...examples.map(({ rows, without }) => one({ rows, without }))].join("~");
}

/** Read examples from text; null unless all are Gaussians of this scene, the first one of what is meant. */
export function examplesFromText(text, about) {
  const [name, ...parts] = text.split("~");
  const examples = parts.map((part) => {
    const [rows, place] = part.replace("-", "").split("@"), [, photo, kind, points] = /^(\d+)([op])([\d.!]+)$/.exec(place ?? "") ?? [];
    const read = points?.split("!").map((pair) => pair.split(".").map((value) => Number(value) / FINE));
    const marked = photo !== undefined && Number(photo) < (about.cameras?.length ?? 0) && { photo: Number(photo), [kind === "o" ? "outline" : "points"]: read };
    return { rows: rows.split(".").map(Number), without: part.startsWith("-"), ...marked };
  });
  return areExamples(examples, about.count) ? { name, examples } : null;
}

/** Return whether these are examples in this scene, and the first one shows what is meant. */
export function areExamples(examples, count) {
  const known = (row) => Number.isInteger(row) && row >= 0 && row < count;
  return Array.isArray(examples) && examples.length > 0 && !examples[0].without && examples.every(({ rows }) => rows?.length && rows.every(known));
}

// ── marks as Python's examples ──

/** Collect marks photo by photo as `Example.to_json` writes them. */
export function asPython(examples, cameras) {
  const photos = new Map();
  for (const example of examples.filter(({ photo }) => photo !== undefined)) {
    const camera = cameras[example.photo], file = (points) => points.map((point) => inFile(point, camera));
    if (!photos.has(camera)) photos.set(camera, { photo: camera.name, points: [], not_points: [], size: camera.file, outlines: [] });
    const found = photos.get(camera), pixels = (points) => file(points).map((place) => place.map((value) => Math.max(value - 0.5, 0))); // Python counts from pixels' centers
    if (example.outline && !example.without) found.outlines.push(file(example.outline));
    else found[example.without ? "not_points" : "points"].push(...pixels(example.outline ? inside(example.outline) : example.points));
  }
  return [...photos.values()].map(({ outlines, ...rest }) => ({ ...rest, ...(outlines.length && { outlines }) }));
}

/** Write words as a file for `lang3dxl words SCENE --load FILE`, which learns them from their marks. */
export function wordsFile(prompts, { cameras, source }) {
  const words = prompts.map(({ text, examples }) => ({ name: text, bias: 0, text: 0, doubt: 1, vector: [0], precision: {}, ...source, examples: asPython(examples, cameras) }));
  return JSON.stringify({ version: 1, words: words.filter(({ examples }) => examples.length) });
}

// ── drawing an outline ──

/** Let the user draw an outline over the picture; resolves to its pixels, or null if that is given up. */
export function drawOutline(frame, signal) {
  const sheet = document.getElementById("sheet"), path = sheet.firstElementChild, points = [];
  sheet.removeAttribute("hidden");
  return new Promise((resolve) => {
    const done = new AbortController(), end = (found) => {
      done.abort();
      sheet.setAttribute("hidden", "");
      path.setAttribute("d", "");
      resolve(found);
    }; // prettier-ignore
    const add = ({ clientX, clientY }) => {
      const corner = frame.getBoundingClientRect(), point = [clientX - corner.left, clientY - corner.top], last = points.at(-1);
      if (!last || Math.hypot(point[0] - last[0], point[1] - last[1]) > 3) points.push(point);
      path.setAttribute("d", `M${points.join("L")}Z`);
    };
    const on = (kind, act) => sheet.addEventListener(kind, act, { signal: done.signal });
    on("pointerdown", (event) => (sheet.setPointerCapture(event.pointerId), add(event)));
    on("pointermove", (event) => event.buttons && points.length && add(event));
    on("pointerup", () => end(points.length > 4 ? points : null));
    on("pointercancel", () => end(null));
    signal.addEventListener("abort", () => end(null), { signal: done.signal });
  });
}
