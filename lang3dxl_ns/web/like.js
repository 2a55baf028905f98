// "Like this": search by example, against the rest of the scene.

const RIDGE = 0.01, STEPS = 8, OTHERS = 2000; // penalty, Newton steps, Gaussians that represent the scene

/** Compute every Gaussian's probability of being like the examples: [{ rows, without }], Gaussians that were marked.
 * rows: of the scene; judged: of the Gaussians in question, those of the scene or of a part of it. A counterexample only ever lowers it: the least of all fits without the latest counterexamples counts. */
export function likeness(rows, examples, judged = rows) {
  const wanted = examples.filter((one) => !one.without), unwanted = examples.filter((one) => one.without);
  return unwanted.reduce((least, _, k) => {
    const fit = probability(remembered(rows, [...wanted, ...unwanted.slice(0, k + 1)]), judged);
    return least.map((value, i) => Math.min(value, fit[i]));
  }, probability(remembered(rows, wanted), judged));
}

const probability = ({ direction, start }, rows) => rows.times(direction).map((x, i) => (rows.scales[i] ? 1 / (1 + Math.exp(-x - start)) : 0));

const fits = new Map();

/** Fit examples, once for each list of them. */
function remembered(rows, examples) {
  const key = JSON.stringify(examples.map(({ rows, without }) => [rows, without]));
  if (!fits.has(key)) fits.set(key, likely(rows, examples));
  return fits.get(key);
}

/** Fit a weighted logistic regression on the decoder's rows, standardized over the scene. Together the examples weigh
 * as much as what they compete with: the scene, and Gaussians marked `without`. */
function likely(rows, examples) {
  const { width, count } = rows, known = [];
  for (let i = 0, step = Math.max(Math.floor(count / OTHERS), 1); i < count; i += step) if (rows.scales[i]) known.push(i);
  const wanted = examples.filter((one) => !one.without), unwanted = examples.filter((one) => one.without);
  const sides = [wanted, unwanted].map((ones) => ones.flatMap((one) => one.rows).filter((i) => rows.scales[i]));
  const share = unwanted.length ? 0.5 : 1;
  const samples = [
    ...sides[0].map((i) => ({ row: rows.row(i), is: 1, weight: 1 / sides[0].length })),
    ...sides[1].map((i) => ({ row: rows.row(i), is: 0, weight: (1 - share) / sides[1].length })),
    ...known.map((i) => ({ row: rows.row(i), is: 0, weight: share / known.length })),
  ];
  const others = samples.slice(-known.length).map(({ row }) => row);
  const mean = new Float64Array(width), spread = new Float64Array(width);
  for (const row of others) row.forEach((x, j) => (mean[j] += x / others.length));
  for (const row of others) row.forEach((x, j) => (spread[j] += (x - mean[j]) ** 2 / others.length));
  const least = 1e-3 * Math.sqrt(Math.max(...spread)); // smaller spreads are rounding errors
  const scale = spread.map((variance) => 1 / Math.max(Math.sqrt(variance), least, 1e-9));
  for (const sample of samples) sample.at = [...Array.from(sample.row, (x, j) => (x - mean[j]) * scale[j]), 1];
  const weights = fitted(samples, width + 1), direction = scale.map((s, j) => s * weights[j]);
  const start = weights[width] - mean.reduce((sum, x, j) => sum + x * direction[j], 0);
  return { direction, start };
}

/** Fit a logistic regression by Newton's method. samples: { at: `size` numbers, the last one 1; is: 0 or 1; weight }; the
 * last weight, the constant, is hardly penalized. */
export function fitted(samples, size, ridge = RIDGE, steps = STEPS) {
  const weights = new Float64Array(size);
  for (let step = 0; step < steps; step++) {
    const slope = new Float64Array(size), bend = Array.from({ length: size }, () => new Float64Array(size));
    for (const { at, is, weight } of samples) {
      const p = 1 / (1 + Math.exp(-at.reduce((sum, x, j) => sum + x * weights[j], 0)));
      const curve = weight * Math.max(p * (1 - p), 1e-6);
      for (let j = 0; j < size; j++) {
        slope[j] += weight * (is - p) * at[j];
        for (let k = 0, factor = curve * at[j]; k <= j; k++) bend[j][k] += factor * at[k];
      }
    }
    for (let j = 0; j < size; j++) {
      const penalty = j < size - 1 ? ridge : 1e-6;
      slope[j] -= penalty * weights[j];
      bend[j][j] += penalty;
    }
    solved(bend, slope).forEach((change, j) => (weights[j] += change));
  }
  return weights;
}

/** Solve a symmetric positive system, given its lower half, by elimination. */
function solved(lower, right) {
  const rows = lower.map((row, j) => [...lower.map((other, k) => (k <= j ? row[k] : other[j])), right[j]]);
  rows.forEach((pivot, j) => {
    for (const row of rows) {
      const factor = row === pivot ? 0 : row[j] / Math.max(pivot[j], 1e-12);
      if (factor) for (let k = j; k < row.length; k++) row[k] -= factor * pivot[k];
    }
  });
  return rows.map((row, j) => row.at(-1) / Math.max(row[j], 1e-12));
}
