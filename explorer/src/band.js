// Exact variances of the bins of a free-running pixel's histogram, by the native recursion of the joint law
// (docs/joint_law.md, section 6) through a short exposure: once its start is forgotten, variances grow by the same amount
// every period.
import { Refused } from "./exposure.js";
import { PARTS, gridOf, photonsIn } from "./light.js";

const FORGOTTEN = 1e-6, MOST_STEPS = 6e7, SETTLING_STEPS = 4e6, TOGETHER = 64;

/** Variances (bins); `law` is that of exposure(), in as many bins or, with jitter, in its parts. */
export function binVariances(native, system, pixel, law, jitter) {
  if (!(pixel.signal + (pixel.second ?? 0) + pixel.background > 0)) return new Float64Array(system.bins);
  const out = jitter ? jitter.parts : system.bins, photons = photonsIn(native, system, pixel, PARTS * law.bins);
  const grid = gridOf(system, law.bins, out, SETTLING_STEPS);
  const settled = native.settlingPeriods(grid, photons, FORGOTTEN, SETTLING_STEPS);
  if (settled === -2) throw new Refused("the pixel does not forget its start for so long that the variance of its bins takes too long here");
  const enough = 2 * (settled + grid.whole + 2), short = settled === -1 || enough + 1 >= system.cycles ? system.cycles : enough;
  const runs = short === system.cycles ? 1 : 2;
  if (2 * runs * short * law.bins * system.bins > MOST_STEPS) throw new Refused("the variance of these many bins takes too long here");
  const variances = (cycles) => {
    const all = new Float64Array(system.bins);
    for (let first = 0; first < system.bins; first += TOGETHER) {
      const some = Math.min(TOGETHER, system.bins - first), weights = new Float64Array(some * out);
      for (let k = 0; k < some; ++k) jitter ? weights.set(jitter.backward(first + k), k * out) : (weights[k * out + first + k] = 1);
      const found = native.windowVariances({ ...grid, cycles }, photons, weights);
      if (!found) throw new Refused("the stationary state of this pixel is not found here");
      all.set(found, first);
    }
    return all;
  };
  const at = variances(short), next = runs === 2 ? variances(short + 1) : at;
  const total = at.map((x, b) => x + (system.cycles - short) * (next[b] - x));
  if (jitter) {
    for (let b = 0; b < system.bins; ++b)
      jitter.backward(b).forEach((w, j) => { total[b] += law.histogram[j] * w * (1 - w); });
  }
  return total.map((x) => Math.max(x, 0));
}
