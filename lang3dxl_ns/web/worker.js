// Worker that runs beside the drawing: it decodes the scene once, then answers words and clicks.
import { Answers } from "./answer.js";
import { decodedRows, shippedRows } from "./decode.js";
import { boxAround, massOf, rankViews, readViews } from "./find.js";
import { likeness } from "./like.js";
import { gaussiansAt, unpackSplats } from "./pick.js";
import { Vocabulary } from "./vocabulary.js";

const EXAMPLE = 5; // number of Gaussians that represent a clicked place
let about, answers, vocabulary, geometry, views, mass;

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

/** Compute which Gaussians may match: 1 where any of these prompts does; null without prompts. */
async function foregroundOf(prompts) {
  if (!prompts.length) return null;
  const mask = new Uint8Array(about.words.count);
  for (const phrases of prompts) {
    const { relevancy, threshold } = judged((await understood(phrases)).found);
    relevancy.forEach((value, i) => (mask[i] ||= value > threshold));
  }
  return mask;
}

async function file(name) {
  const answer = await fetch(name);
  if (!answer.ok) throw new Error(`${name} is missing (${answer.status})`);
  return answer.arrayBuffer();
}

const jobs = {
  async load({ description, splats }) {
    about = description;
    const { words } = about, start = performance.now();
    const [listed, numbers] = [await (await fetch("vocabulary.json")).json(), await file("vocabulary.bin")];
    vocabulary = new Vocabulary(listed, numbers, words.width, about.live);
    const tell = (done) => new Promise((go) => (postMessage({ done }), setTimeout(go)));
    const rows = words.field
      ? await decodedRows(words, await file("codes.bin"), await file("field.bin"), tell)
      : shippedRows(words, await file("rows.bin"));
    answers = new Answers(rows, vocabulary, words);
    geometry = unpackSplats(splats);
    views = readViews(about, await file("views.bin")).map((view) => ({
      ...view,
      pose: view.pose.map((row, axis) => (axis < 3 ? [...row.slice(0, 3), row[3] - about.center[axis]] : row)),
    }));
    mass = massOf(views, words.count);
    answers.foreground = await foregroundOf(about.foreground);
    return { seconds: (performance.now() - start) / 1000, known: vocabulary.words.length };
  },

  /** Answer a phrase or examples with { known, relevancy, threshold, doubt, … }. */
  async ask({ text, negatives, examples, threshold }) {
    threshold ??= about.words.threshold;
    if (examples) return { known: true, ...answers.verdict(likeness(answers.rows, examples), { strict: true, doubt: 0, threshold }) };
    const { found, unknown } = await understood([text, ...negatives]);
    if (unknown !== undefined) return { known: false, unknown, closest: vocabulary.closest(unknown) };
    return { known: true, taught: Boolean(found[0].taught), ...judged(found, threshold) };
  },

  find({ relevancy, threshold }) {
    const moved = (corner) => corner.map((value, axis) => value + about.center[axis]);
    const box = boxAround(geometry.centers, relevancy, mass, threshold, about.words.gap);
    return {
      views: rankViews(views, geometry.centers, relevancy, threshold),
      box: box && { low: moved(box.low), high: moved(box.high) },
    };
  },

  /** Find the words that match a pixel best, and its Gaussians; none where too few of them have a meaning. */
  whatIs({ camera, x, y, most }) {
    const hits = gaussiansAt(geometry, camera, x, y, about.antialiased).filter(([i]) => answers.rows.scales[i]);
    const blend = new Float64Array(about.words.width);
    let covered = 0;
    for (const [i, weight] of hits) {
      answers.rows.row(i).forEach((value, j) => (blend[j] += weight * value));
      covered += weight;
    }
    if (covered < about.words.covered) return { words: [], rows: [] };
    return { words: answers.naming(blend, most), rows: hits.sort((a, b) => b[1] - a[1]).slice(0, EXAMPLE).map(([i]) => i) };
  },

  offered: ({ typed }) => vocabulary.offered(typed),
};

onmessage = async ({ data: { id, job, input } }) => {
  try {
    postMessage({ id, output: await jobs[job](input) });
  } catch (error) {
    postMessage({ id, error: String(error.message ?? error) });
  }
};
