// The page's thinking, beside its drawing: decodes the scene once, then answers words and clicks.
import { Answers } from "./answer.js";
import { decodedRows, shippedRows } from "./decode.js";
import { boxAround, massOf, rankViews, readViews } from "./find.js";
import { likeness } from "./like.js";
import { gaussiansAt, unpackSplats } from "./pick.js";
import { Vocabulary } from "./vocabulary.js";

const EXAMPLE = 5; // Gaussians that stand for a clicked place
let about, answers, vocabulary, geometry, views, mass;

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
    return { seconds: (performance.now() - start) / 1000, known: vocabulary.words.length };
  },

  /** An answer about a phrase, or about examples: { known, relevancy, threshold, doubt, … }. */
  async ask({ text, negatives, examples, threshold }) {
    if (examples) {
      const relevancy = likeness(answers.rows, examples);
      return { known: true, relevancy, ...answers.verdict(relevancy, true, threshold), doubtful: false };
    }
    const wanted = [text, ...negatives], found = await Promise.all(wanted.map((phrase) => vocabulary.phrase(phrase)));
    const unknown = wanted.filter((_, i) => !found[i]);
    if (unknown.length) return { known: false, unknown: unknown[0], closest: vocabulary.closest(unknown[0]) };
    const relevancy = answers.relevancy(found[0], found.slice(1).map((phrase) => phrase.own));
    return { known: true, relevancy, ...answers.verdict(relevancy, negatives.length > 0, threshold) };
  },

  find({ relevancy, threshold }) {
    const moved = (corner) => corner.map((value, axis) => value + about.center[axis]);
    const box = boxAround(geometry.centers, relevancy, mass, threshold, about.words.gap);
    return {
      views: rankViews(views, geometry.centers, relevancy, threshold),
      box: box && { low: moved(box.low), high: moved(box.high) },
    };
  },

  /** The words that fit a pixel best, and the Gaussians that it shows. */
  whatIs({ camera, x, y, most }) {
    const hits = gaussiansAt(geometry, camera, x, y, about.antialiased);
    const blend = new Float64Array(about.words.width);
    let covered = 0;
    for (const [i, weight] of hits) {
      if (answers.rows.scales[i]) answers.rows.row(i).forEach((value, j) => (blend[j] += weight * value));
      covered += weight;
    }
    if (covered < 0.05 || !blend.some(Boolean)) return { words: [], rows: [] };
    const seen = hits.filter(([i]) => answers.rows.scales[i]).sort((a, b) => b[1] - a[1]);
    return { words: answers.naming(blend, most), rows: seen.slice(0, EXAMPLE).map(([i]) => i) };
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
