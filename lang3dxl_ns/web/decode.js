// Rows ((h, 1) / |d|) of all Gaussians, decoded from their codes by the scene's small field. A row times the
// numbers of a text is the cosine of the Gaussian's CLIP feature with the text.

const HALVES = Float32Array.from({ length: 65536 }, (_, bits) => {
  const sign = bits & 0x8000 ? -1 : 1, exponent = (bits >> 10) & 31, fraction = bits & 1023;
  if (exponent === 31) return fraction ? NaN : sign * Infinity;
  return sign * (exponent ? 2 ** (exponent - 15) * (1 + fraction / 1024) : 2 ** -14 * (fraction / 1024));
});

/** Convert half floats to floats. */
export const floats = (halves) => Float32Array.from(halves, (bits) => HALVES[bits]);

/** A matrix of as many rows as there are Gaussians: 16 bits per value, and a scale per row. */
export class Rows {
  constructor(count, width) {
    this.count = count;
    this.width = width;
    this.values = new Int16Array(count * width);
    this.scales = new Float32Array(count); // 0 for Gaussians without a known meaning
  }

  set(i, row, factor) {
    let largest = 0;
    for (let j = 0; j < this.width; j++) largest = Math.max(largest, Math.abs(row[j]));
    if (!(largest * factor > 0)) return;
    for (let j = 0, at = i * this.width; j < this.width; j++) this.values[at + j] = Math.round((32767 * row[j]) / largest);
    this.scales[i] = (largest * factor) / 32767;
  }

  /** Multiply every row by a vector. */
  times(vector) {
    const { values, scales, width } = this, products = new Float32Array(this.count);
    for (let i = 0, at = 0; i < this.count; i++) {
      let sum = 0;
      for (let j = 0; j < width; j++) sum += values[at++] * vector[j];
      products[i] = sum * scales[i];
    }
    return products;
  }

  row(i) {
    return Float32Array.from(this.values.subarray(i * this.width, (i + 1) * this.width), (v) => v * this.scales[i]);
  }
}

/** Read rows that were decoded beforehand, for decoders that are too wide for a page. */
export function shippedRows(words, buffer) {
  const { count, width } = words, rows = new Rows(count, width), halves = new Uint16Array(buffer);
  for (let i = 0; i < count; i++) rows.set(i, floats(halves.subarray(i * width, (i + 1) * width)), 1);
  return rows;
}

/** Decode codes (16-bit coordinates, then half-precision 1 / |d|). Wait for `progress` now and then, to report it. */
export async function decodedRows(words, codesBuffer, fieldBuffer, progress = () => {}) {
  const { count, width, field } = words, d = field.dimensions;
  const codes = new Uint16Array(codesBuffer, 0, count * d);
  const inverse = floats(new Uint16Array(codesBuffer, 2 * count * d, count));
  const decode = hiddenLayer(field, fieldBuffer);
  const rows = new Rows(count, width), row = new Float32Array(width), place = new Float64Array(d);
  row[width - 1] = 1;
  for (let i = 0; i < count; i++) {
    if (inverse[i]) {
      for (let axis = 0; axis < d; axis++) place[axis] = Math.max(codes[i * d + axis] - 1, 0) / 65534;
      row.set(decode(place));
      rows.set(i, row, inverse[i]);
    }
    if (i % 20000 === 19999) await progress(i / count);
  }
  return rows;
}

/** Build the field as a function from a place in [0, 1]^d to its last hidden layer. */
function hiddenLayer(field, buffer) {
  const { dimensions: d, frequencies } = field;
  let read = 0;
  const layers = field.layers.map(([inputs, outputs], k) => {
    const weight = new Float32Array(buffer, 4 * read, inputs * outputs);
    const bias = new Float32Array(buffer, 4 * (read + inputs * outputs), outputs);
    read += (inputs + 1) * outputs;
    return { weight, bias, rectify: field.rectify[k], output: new Float32Array(outputs) };
  });
  const table = floats(new Uint16Array(buffer, 4 * read, field.entries * field.features));
  const encoding = new Float32Array(field.layers[0][0]);
  const waves = frequencies ? d * (1 + 2 * frequencies) : 0;
  return (place) => {
    if (frequencies) fourier(place, frequencies, encoding);
    interpolate(place, field, table, encoding, waves);
    return layers.reduce(connected, encoding);
  };
}

function fourier(place, frequencies, encoding) {
  const d = place.length, waves = d * frequencies;
  for (let axis = 0; axis < d; axis++) {
    encoding[axis] = place[axis];
    for (let k = 0; k < frequencies; k++) {
      const angle = 2 * Math.PI * 2 ** k * place[axis], at = d + axis * frequencies + k;
      encoding[at] = Math.sin(angle);
      encoding[at + waves] = Math.cos(angle);
    }
  }
}

const KEYS = new Int32Array(12), WEIGHTS = new Float64Array(12); // lower and upper vertex per axis

/** Interpolate the hash grid's entries multilinearly, level by level (Müller et al. 2022). */
function interpolate(place, field, table, encoding, start) {
  const { dimensions: d, features, cells, offsets, dense, mask, primes } = field, corners = 1 << d;
  encoding.fill(0, start);
  for (let level = 0; level < cells.length; level++) {
    const side = cells[level] + 2, isDense = level < dense;
    for (let axis = 0, stride = 1; axis < d; axis++, stride *= side) {
      const position = place[axis] * cells[level] + 0.5, lower = Math.floor(position), t = position - lower;
      for (let upper = 0; upper < 2; upper++) {
        const vertex = lower + upper;
        KEYS[2 * axis + upper] = isDense ? (vertex % side) * stride : Math.imul(vertex, primes[axis]) & mask;
        WEIGHTS[2 * axis + upper] = upper ? t : 1 - t;
      }
    }
    for (let corner = 0; corner < corners; corner++) {
      let key = 0, weight = 1;
      for (let axis = 0; axis < d; axis++) {
        const side = 2 * axis + ((corner >> axis) & 1);
        key = isDense ? key + KEYS[side] : key ^ KEYS[side];
        weight *= WEIGHTS[side];
      }
      const entry = (offsets[level] + key) * features, at = start + level * features;
      for (let j = 0; j < features; j++) encoding[at + j] += weight * table[entry + j];
    }
  }
}

function connected(input, { weight, bias, rectify, output }) {
  const outputs = output.length;
  output.set(bias);
  for (let i = 0, at = 0; i < input.length; i++) {
    const value = input[i];
    if (value === 0) at += outputs;
    else for (let j = 0; j < outputs; j++) output[j] += value * weight[at++];
  }
  if (rectify) for (let j = 0; j < outputs; j++) if (output[j] < 0) output[j] = 0;
  return output;
}
