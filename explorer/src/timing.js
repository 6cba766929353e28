// Gaussian jitter of the records: the mean histogram of registrations, convolved round the period, as
// statistics/timing.py has it.
import { photonsIn, sharpness, sum } from "./light.js";

const PARTS_PER_SIGMA = 24, MOST_PARTS = 2 ** 16;

/** Parts of the period in which registrations are wanted, and the probabilities that a record is d parts later. */
export class Jitter {
  constructor(native, system, pixel) {
    // Registrations of n photons fall within an n-th of the width of the light: as fast as its first photon comes.
    const photons = Math.max(sum(photonsIn(native, system, pixel, 1)), 1);
    const finest = 1 / (2 * Math.sqrt(Math.PI) * Math.max(sharpness(system.sigma), 1) * photons);
    const width = Math.hypot(finest, system.jitter), bins = system.bins;
    const split = Math.ceil(PARTS_PER_SIGMA / (Math.max(width, 1e-9) * bins));
    this.split = 2 * Math.max(1, Math.floor(Math.min(split, Math.floor(MOST_PARTS / bins)) / 2));
    // halved once, as Python does until records stand still, which they mostly do at once
    if (2 * bins * this.split <= MOST_PARTS) this.split *= 2;
    this.parts = bins * this.split;
    const part = 1 / this.parts, reach = 8.5 * system.jitter;
    const first = Math.floor(-reach / part) - 1, last = Math.ceil(reach / part) + 1;
    const t = Float64Array.from({ length: last - first + 3 }, (_, k) => ((first - 1 + k) * part) / system.jitter);
    const area = native.normalBelow(t).map((below, k) =>
      system.jitter * (t[k] * below + Math.exp(-0.5 * t[k] * t[k]) / Math.sqrt(2 * Math.PI)));
    this.kernel = new Float64Array(this.parts);
    let total = 0;
    for (let d = first; d <= last; ++d) {
      const k = d - first, mass = Math.max(area[k + 2] - 2 * area[k + 1] + area[k], 0) / part;
      this.kernel[(((d % this.parts) + this.parts) % this.parts)] += mass;
      total += mass;
    }
    this.taps = [];
    this.kernel.forEach((mass, d) => { if (mass > 0) this.taps.push([d, mass / total]); });
  }

  /** Records (bins) of registrations (parts). */
  forward(registrations) {
    const out = new Float64Array(this.parts / this.split);
    for (let j = 0; j < this.parts; ++j)
      for (const [d, mass] of this.taps) {
        const at = j + d;
        out[Math.floor((at < this.parts ? at : at - this.parts) / this.split)] += mass * registrations[j];
      }
    return out;
  }

  /** P(the record of a registration in each part is in this bin). */
  backward(bin) {
    const out = new Float64Array(this.parts);
    for (let k = 0; k < this.split; ++k)
      for (const [d, mass] of this.taps) out[(bin * this.split + k - d + this.parts) % this.parts] += mass;
    return out;
  }
}
