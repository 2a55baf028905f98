// Gaussians that are drawn together: the whole scene, or a chunk of a large one in more detail; their colors and heat.
import { PackedSplats, SplatMesh } from "./library.js";
import { ancestry, FAN } from "./tree.js";

const HEAT = 0.7, DIM = 8; // opacity; added to colors of which a ratio is taken

export class Part {
  /** Pack splats, 16 bytes each, for drawing. number: of the chunk; floats: how much each Gaussian floats, 0…255. */
  static async of(buffer, center, number = 0, floats = null) {
    const words = new Uint32Array(buffer), count = words.length / 4, packed = new PackedSplats({ maxSplats: count });
    await packed.initialized;
    packed.ensureSplats(count).set(words);
    packed.numSplats = count;
    const mesh = new SplatMesh({ packedSplats: packed });
    mesh.position.fromArray(center);
    await mesh.initialized;
    return new Part(packed, mesh, number, floats);
  }

  constructor(packed, mesh, number, floats) {
    Object.assign(this, { packed, mesh, number, floats, count: packed.numSplats, root: ancestry(number, packed.numSplats) });
    this.covered = Array.from({ length: FAN }, () => false); // quarters that children show
    this.bytes = new Uint8Array(packed.packedArray.buffer, packed.packedArray.byteOffset);
    this.own = this.plain = Uint8Array.from({ length: 4 * this.count }, (_, i) => this.bytes[16 * (i >> 2) + (i & 3)]);
  }

  /** Take a lighting over from chunk 0: before and after are its colors, four bytes each. */
  light(before, after) {
    if (before === after) return (this.plain = this.own);
    return (this.plain = this.own.map((value, i) => {
      const at = 4 * this.root(i >> 2) + (i & 3);
      return i % 4 === 3 ? value : Math.min(255, (value * (after[at] + DIM)) / (before[at] + DIM));
    }));
  }

  /** Show heat: layers of { relevancy, threshold, peak, color }, the strongest where several match. heat: returns the
   * relevancy of this part's Gaussians where it is known; the others have that of chunk 0. limit: hides what floats more; only: rows of chunk 0 that are shown, or null. */
  paint(layers, heat, limit, only = null) {
    const values = layers.map((layer) => (this.number ? heat(layer, this.number) : layer.relevancy));
    const quarter = this.count / FAN;
    for (let i = 0; i < this.count; i++) {
      let best = 0, chosen = null;
      layers.forEach((layer, k) => {
        const value = values[k] ? values[k][i] : layer.relevancy[this.root(i)];
        if (value > layer.threshold && value > best) [best, chosen] = [value, layer];
      });
      const warmth = chosen && (best - chosen.threshold) / Math.max(chosen.peak - chosen.threshold, 1e-6);
      const share = chosen ? HEAT * (0.5 + 0.5 * Math.min(warmth, 1)) : 0;
      for (let k = 0; k < 3; k++) this.bytes[16 * i + k] = this.plain[4 * i + k] * (1 - share) + (chosen?.color[k] ?? 0) * share;
      const hidden = this.floats?.[i] > limit || this.covered[Math.floor(i / quarter)] || (only && !only.has(this.root(i)));
      this.bytes[16 * i + 3] = hidden ? 0 : this.plain[4 * i + 3];
    }
    this.upload();
  }

  upload() {
    this.packed.needsUpdate = true;
    this.mesh.updateVersion();
  }

  dispose() {
    this.mesh.dispose();
    this.packed.dispose();
  }
}
