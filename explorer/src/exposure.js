// Exact cumulants of the count and mean histogram of an exposure by the native recursion, on a grid that is refined until
// they rest: as statistics/moments.py composes them.
import { PARTS, firstBins, gridOf, photonsIn, sum } from "./light.js";
import { registrationRates } from "./paralyzable.js";

export const PARALYZABLE = 1;
const TINY = 2.2250738585072014e-308;
const TOLERANCE = 1e-4, MOST_STEPS = 40e6, MOST_BINS = 2 ** 15, RATES_STEPS = 120;

/** What cannot be computed here, in words for the page. */
export class Refused extends Error {}

const greatestCommon = (a, b) => (b ? greatestCommon(b, a % b) : a);

/** What the native recursions are told of the light on `bins` bins: photons, and rates of a paralyzable pixel. */
export function lightOn(native, system, pixel, bins) {
  if (system.mode === PARALYZABLE)
    return { photons: Float64Array.of(sum(photonsIn(native, system, pixel, 1))), rates: registrationRates(native, system, pixel, bins) };
  return { photons: photonsIn(native, system, pixel, PARTS * bins), rates: null };
}

function pass(native, system, pixel, bins, outBins) {
  const before = system.mode === PARALYZABLE ? RATES_STEPS : 0;
  const least = Math.min(3 * (system.dead + 1), system.cycles) + before;
  if (least * bins > MOST_STEPS) throw new Refused("the dead time is too long for an exact law here");
  const light = lightOn(native, system, pixel, bins);
  const found = native.moments(gridOf(system, bins, outBins, MOST_STEPS), light.photons, light.rates);
  if (found.settled < -1) throw new Refused("the state of the pixel does not repeat from period to period for so long that its exact law takes too long here");
  return { ...found, bins, outBins, steps: ((found.settled >= 0 ? found.settled : system.cycles) + before) * bins };
}

function movement(coarse, fine) {
  const mean = Math.abs(fine.cumulants[0]), spread = Math.sqrt(Math.max(fine.cumulants[1], 0));
  const floor = 1e-10 * mean + TINY;
  let worst = Math.abs(fine.cumulants[0] - coarse.cumulants[0]) / Math.max(Math.min(mean, spread), floor);
  for (let k = 1; k < 4; ++k) {
    const scale = Math.max(Math.abs(fine.cumulants[k]), spread ** (k + 1));
    worst = Math.max(worst, Math.abs(fine.cumulants[k] - coarse.cumulants[k]) / Math.max(scale, floor));
  }
  const group = fine.outBins / coarse.outBins;
  let shape = 0, least = 0;
  for (let b = 0; b < coarse.outBins; ++b) shape += Math.abs(sum(fine.histogram.subarray(b * group, (b + 1) * group)) - coarse.histogram[b]);
  for (const count of fine.histogram) least = Math.min(least, count);
  return least < -1e-12 * mean ? Infinity : Math.max(worst, (0.5 * shape) / Math.max(mean, TINY));
}

/** { cumulants (4), histogram (outBins), bins } of a free-running, paralyzable or gated pixel. */
export function exposure(native, system, pixel, outBins) {
  const light = photonsIn(native, system, pixel, outBins), total = sum(light);
  if (system.dead === 0 || total === 0) {
    const mean = system.cycles * total;
    return { cumulants: Float64Array.of(mean, mean, mean, mean), histogram: light.map((x) => x * system.cycles), bins: outBins };
  }
  let bins = firstBins(system, outBins);
  let coarse = pass(native, system, pixel, bins / 2, greatestCommon(bins / 2, outBins)), spent = coarse.steps, last = spent;
  for (;;) {
    if (spent + 2 * last > MOST_STEPS) throw new Refused("the exact law of this pixel takes too long here");
    const fine = pass(native, system, pixel, bins, outBins);
    if (movement(coarse, fine) <= TOLERANCE) {
      fine.cumulants[1] = Math.max(fine.cumulants[1], 0);
      return { ...fine, histogram: fine.histogram.map((x) => Math.max(x, 0)) };
    }
    [last, spent, coarse, bins] = [fine.steps, spent + fine.steps, fine, 2 * bins];
    if (bins > Math.max(MOST_BINS, 2 * outBins)) throw new Refused("no grid of the period is fine enough for the exact law here");
  }
}
