// Worker that runs beside the drawing: it decodes the scene once, then answers words and clicks.
import { Answers } from "./answer.js";
import { decodedRows, shippedRows } from "./decode.js";
import { massOf, rankViews, readViews } from "./find.js";
import { likeness } from "./like.js";
import { bestPhoto, gaussiansAt, middleOf, unpackSplats } from "./pick.js";
import { piecesIn, prepare } from "./pieces.js";
import { freeSpace } from "./space.js";
import { fetched, thinker } from "./think.js";
import { areShown, isThere, sharpened, thingsOf } from "./things.js";
import { ancestry, FAN } from "./tree.js";
import { Vocabulary } from "./vocabulary.js";

const EXAMPLE = 5; // number of Gaussians that represent a clicked place
const INSIDE = 60; // Gaussians that represent an outlined place
const HELPERS = 3; // most workers that find pieces beside this one
let about, answers, vocabulary, geometry, views, mass, field;
let shares; // of the views: { numbered, scene, think (if a helper holds it) }
let held; // such a share, if this worker is a helper
const parts = new Map(); // of the scene, by number: { geometry, opacities, floats, answers, root }; chunk 0 is the whole scene
let limit = 255;

/** Look up phrases; return their numbers, and the first phrase that is unknown. */
async function understood(phrases) {
  const found = await Promise.all(phrases.map((phrase) => vocabulary.phrase(phrase)));
  return { found, unknown: phrases.find((_, i) => !found[i]) };
}

/** Compute the verdict about a prompt whose phrases are known. */
function judged([text, ...negatives], threshold) {
  const relevancy = answers.relevancy(text, negatives.map(({ own }) => own));
  return answers.verdict(relevancy, { strict: Boolean(negatives.length || text.taught), doubt: text.taught?.doubt, threshold, name: text.name });
}

/** Read rows of codes, or rows that were decoded beforehand. */
const rowsOf = (buffer, count, tell) => (field ? decodedRows({ ...about.words, count }, buffer, field, tell) : shippedRows({ ...about.words, count }, buffer));

/** Share the views with a helper for each core but one. */
function shareViews() {
  const { centers, axes, opacities } = geometry, cores = globalThis.Worker ? (navigator.hardwareConcurrency ?? 1) : 1;
  const count = Math.min(1 + HELPERS, cores), scene = { centers, axes, opacities, antialiased: about.antialiased };
  shares = Array.from({ length: count }, (_, k) => ({ scene, numbered: [...views.entries()].filter(([number]) => number % count === k) }));
  prepare(shares[0].numbered, scene);
  for (const own of shares.slice(1)) {
    let helper;
    const lost = new Promise((_, failed) => (helper = thinker(() => {}, failed)));
    own.think = async (job, input) => Promise.race([lost, helper(job, input)]);
    own.think("share", { scene, numbered: own.numbered }).catch(() => (own.think = null));
  }
}

/** Find the pieces of heat in all views, in their order: the helpers in their shares, this worker in the rest. */
async function piecesOfAll(heat) {
  const here = ({ numbered, scene }) => piecesIn(numbered, scene, heat);
  const beside = shares.map((own) => own.think?.("pieces", { heat }).catch(() => here(own)));
  const found = await Promise.all(shares.map((own, k) => beside[k] ?? here(own)));
  return found.flat().sort((one, other) => one.view - other.view);
}

// ── parts ──

function hold(number, { centers, axes, opacities }, answers, floats) {
  const count = opacities.length, first = number * count, root = ancestry(number, count);
  parts.set(number, { geometry: { centers, axes, opacities, first }, opacities, answers, floats, root });
  reveal(number);
}

/** Compute which Gaussians of a part are drawn: no floaters, and none that children show in more detail. */
function reveal(number) {
  const part = parts.get(number);
  if (!part) return;
  const covered = [0, 1, 2, 3].map((k) => parts.has(FAN * number + 1 + k)), quarter = part.opacities.length / FAN;
  part.geometry.opacities = part.opacities.map((opacity, i) => (part.floats?.[i] > limit || covered[Math.floor(i / quarter)] ? 0 : opacity));
}

/** Return a Gaussian of some part by its number: its rows, its place in them, and the row of chunk 0 that stands for it. */
function gaussian(id) {
  const count = about.words.count, number = Math.floor(id / count), { answers: { rows }, root } = parts.get(number), i = id - number * count; // prettier-ignore
  return { rows, i, root: root(i) };
}

/** List what each pixel shows: [number, weight, center] of Gaussians with a meaning. */
function meantAt(camera, pixels) {
  const isMeant = ([id]) => {
    const { rows, i } = gaussian(id);
    return rows.scales[i];
  };
  return hitsAt(camera, pixels).map((hits) => hits.filter(isMeant));
}

const hitsAt = (camera, pixels) => gaussiansAt([...parts.values()].map(({ geometry }) => geometry), camera, pixels, about.antialiased);

/** Move a point into the world's frame. */
const inWorld = (point) => point.map((value, axis) => value + about.center[axis]);
const bytes = async (name) => (await fetched(name, about)).arrayBuffer();

const jobs = {
  async load({ description, splats }) {
    about = description;
    const { words } = about;
    const [listed, numbers] = [await (await fetched("vocabulary.json", about)).json(), await bytes("vocabulary.bin")];
    vocabulary = new Vocabulary(listed, numbers, words.width, about.live);
    const tell = (done) => new Promise((go) => (postMessage({ done }), setTimeout(go)));
    field = words.field && (await bytes("field.bin"));
    const rows = await rowsOf(await bytes(words.field ? "codes.bin" : "rows.bin"), words.count, tell);
    answers = new Answers(rows, vocabulary, words);
    geometry = unpackSplats(splats);
    geometry.bytes = new Uint8Array(splats);
    hold(0, geometry, answers, null);
    views = readViews(about, await bytes("views.bin")).map((view) => ({
      ...view,
      pose: view.pose.map((row, axis) => (axis < 3 ? [...row.slice(0, 3), row[3] - about.center[axis]] : row)),
    }));
    mass = massOf(views, words.count);
    answers.foreground = about.foreground.length ? new Uint8Array(await bytes("foreground.bin")) : null;
    shareViews();
    return vocabulary.listed;
  },

  /** Answer a phrase or examples with { known, relevancy, threshold, doubt, … }. */
  async ask({ text, negatives, examples, threshold }) {
    threshold ??= about.words.threshold;
    if (examples) return { known: true, ...answers.verdict(likeness(answers.rows, examples), { strict: true, doubt: 0, threshold }) };
    const { found, unknown } = await understood([text, ...negatives]);
    if (unknown !== undefined) return { known: false, unknown, closest: vocabulary.closest(unknown) };
    return { known: true, taught: Boolean(found[0].taught), meant: found[0].meant, ...judged(found, threshold) };
  },

  /** Read a chunk of more detail: splats, floaters, and codes or rows. */
  async part({ number, buffer }) {
    const { count } = about.words, rows = await rowsOf(buffer.slice(17 * count), count);
    hold(number, unpackSplats(buffer.slice(0, 16 * count)), new Answers(rows, vocabulary, about.words), new Uint8Array(buffer, 16 * count, count));
    reveal(Math.floor((number - 1) / FAN));
    return {};
  },

  drop({ number }) {
    parts.delete(number);
    reveal(Math.floor((number - 1) / FAN));
    return {};
  },

  /** Compute the relevancy of some chunks' Gaussians to a phrase or examples that the scene has been asked for. */
  async fine({ text, negatives, examples, numbers }) {
    const { found } = examples ? {} : await understood([text, ...negatives]), { foreground } = answers;
    return numbers.filter((number) => parts.has(number)).map((number) => {
      const { answers: own, root } = parts.get(number);
      const relevancy = examples ? likeness(answers.rows, examples, own.rows) : own.relevancy(found[0], found.slice(1).map((one) => one.own));
      return { number, relevancy: foreground ? relevancy.map((value, i) => value * foreground[root(i)]) : relevancy };
    });
  },

  find({ relevancy, threshold }) {
    const ranked = rankViews(views, geometry.centers, relevancy, threshold);
    return ranked.map((view) => ({ ...view, target: inWorld(view.target) }));
  },

  /** Find the single things of an answer: see thingsOf. */
  async things({ text, negatives, relevancy, taught }) {
    const [prompt, ...others] = taught ? [null] : (await understood([text, ...negatives])).found, single = taught ? -1 : vocabulary.singular(text);
    if (single >= 0) {
      const word = { ...vocabulary.word(single), taught: undefined }; // a thing is one, as in Python's things/find.py
      relevancy = answers.confined(answers.relevancy(word, others.map(({ own }) => own)));
    }
    if (!isThere(relevancy, about.words.rules)) return { things: [], candidates: [] };
    const better = (weighted) => prompt && answers.better(weighted, prompt);
    const scene = { ...geometry, mass, gap: about.words.gap, edges: about.edges };
    const found = thingsOf(await piecesOfAll(sharpened(scene, relevancy)), views, scene, relevancy, taught, better);
    const placed = (thing) => ({ ...thing, center: inWorld(thing.center) });
    return { ...found, things: found.things.map(placed), candidates: found.candidates.map(placed) };
  },

  /** Hold a share of the views, as a helper. */
  share(given) {
    held = given;
    prepare(held.numbered, held.scene);
    return {};
  },

  pieces: ({ heat }) => piecesIn(held.numbered, held.scene, heat),

  /** Tell for each list of things, by their rows, which ones a view shows. */
  shown: ({ camera, lists }) => lists.map((things) => areShown(things, camera, geometry.centers, hitsAt, (id) => gaussian(id).root)),

  /** Find the words that match a pixel best, and its Gaussians; none where too few of them have a meaning. */
  whatIs({ camera, x, y, most }) {
    const [hits] = meantAt(camera, [[x, y]]);
    const blend = new Float64Array(about.words.width);
    let covered = 0;
    for (const [id, weight] of hits) {
      const { rows, i } = gaussian(id);
      rows.row(i).forEach((value, j) => (blend[j] += weight * value));
      covered += weight;
    }
    if (covered < about.words.covered) return { words: [], rows: [] };
    return { point: inWorld(middleOf(hits)), words: answers.naming(blend, most), rows: [...new Set(hits.sort((a, b) => b[1] - a[1]).slice(0, EXAMPLE).map(([id]) => gaussian(id).root))] };
  },

  /** Hide the Gaussians that float more than a limit, 0…255, from clicks. */
  hide({ floats, limit: least }) {
    limit = least;
    parts.get(0).floats = floats;
    for (const number of parts.keys()) reveal(number);
    return {};
  },

  /** Find the free space, in the frame of the packed splats; null where no view tells. */
  space: () => freeSpace(views, geometry.centers),

  /** Find the point of the world at a pixel; null where nothing is. */
  point({ camera, x, y }) {
    const middle = middleOf(hitsAt(camera, [[x, y]])[0]);
    return middle && inWorld(middle);
  },

  /** Mark pixels: the Gaussians that represent them, and each pixel's place in one photo that shows them all well, or
   * most of them. prefer: numbers of photos that should be taken if they show them. */
  mark({ camera, pixels, prefer, most = EXAMPLE }) {
    const weights = new Map(), points = [];
    for (const hits of meantAt(camera, pixels)) {
      const middle = middleOf(hits);
      const strong = hits.sort((a, b) => b[1] - a[1]).slice(0, EXAMPLE).map(([id, weight]) => [gaussian(id).root, weight]);
      for (const [i, weight] of strong) weights.set(i, (weights.get(i) ?? 0) + weight);
      if (strong.length) points.push({ point: middle, row: strong[0][0] });
    }
    const rows = [...weights].sort((a, b) => b[1] - a[1]).slice(0, pixels.length > 1 ? INSIDE : most).map(([i]) => i);
    const found = bestPhoto(views, points, prefer.map((name) => views.findIndex((view) => view.name === name)));
    return { rows, photo: found && views[found.index].name, points: found?.pixels ?? [] };
  },

  /** Look phrases up anew, once the scene has learned or forgotten them. */
  forget({ texts }) {
    for (const text of texts) vocabulary.forget(text);
    return {};
  },
};

onmessage = async ({ data: { id, job, input } }) => {
  try {
    postMessage({ id, output: await jobs[job](input) });
  } catch (error) {
    postMessage({ id, error: String(error.message ?? error) });
  }
};
