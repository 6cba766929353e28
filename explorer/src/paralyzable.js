// Registrations of a paralyzable pixel on the grid of the native recursion, as statistics/paralyzable_rate.py has them
// (docs/theory_detectors.md, (1) and (17)).
import { PARTS, differences, edgesOf, photonsBefore } from "./light.js";

const ORDERS = 4;
const NODES = [-0.8611363115940526, -0.33998104358485626, 0.33998104358485626, 0.8611363115940526];
const WEIGHTS = [0.34785484513745385, 0.6521451548625461, 0.6521451548625461, 0.34785484513745385];

/** Integrals of r(t) x^m over each bin, by kinds: steady, and for an armed start the first period and the K-th. */
export function registrationRates(native, system, pixel, bins) {
  const edges = edgesOf(PARTS * bins), whole = Math.floor(system.dead), rest = system.dead - whole;
  const before = photonsBefore(native, system, pixel, edges), total = before[before.length - 1];
  const wrapped = edges.map((edge) => (edge - rest < 0 ? 1 : 0));
  const past = photonsBefore(native, system, pixel, edges.map((edge, k) => edge - rest + wrapped[k]));
  const within = before.map((photons, k) => photons - past[k] + total * (wrapped[k] + whole));
  const kinds = [within];
  if (!system.stationary) kinds.push(before, within.map((x, k) => (wrapped[k] ? total * whole + before[k] : x)));
  const rates = new Float64Array(kinds.length * bins * ORDERS);
  kinds.forEach((each, kind) => rates.set(moments(before, each, bins), kind * bins * ORDERS));
  return rates;
}

function moments(before, within, bins) {
  const half = (a) => a.filter((_, k) => k % 2 === 0);
  const fine = onParts(before, within, PARTS, bins), coarse = onParts(half(before), half(within), PARTS / 2, bins);
  return fine.map((x, k) => x + (x - coarse[k]) / 3);
}

function onParts(before, within, parts, bins) {
  const photons = differences(before), rise = differences(within), out = new Float64Array(bins * ORDERS);
  for (let j = 0; j < bins; ++j)
    for (let part = 0; part < parts; ++part) {
      const at = j * parts + part;
      for (let k = 0; k < NODES.length; ++k) {
        const node = 0.5 * (NODES[k] + 1), place = (2 * (part + node)) / parts - 1;
        let rate = 0.5 * WEIGHTS[k] * photons[at] * Math.exp(-(within[at] + node * rise[at]));
        for (let order = 0; order < ORDERS; ++order, rate *= place) out[j * ORDERS + order] += rate;
      }
    }
  return out;
}
