// Registrations of a paralyzable pixel on the grid of the native recursion, as statistics/moments.py has them
// (docs/theory_detectors.md, (1) and (17)).
import { PARTS, differences, edgesOf, photonsBefore } from "./light.js";

const ORDERS = 4;
const SERIES_BELOW = 0.25, SERIES_TERMS = 10; // of the exponent: the recursion loses 4 digits there, the series none

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

// The rate of registrations is exponential in a part, and largest at one of its ends, from which on x is measured.
function onParts(before, within, parts, bins) {
  const photons = differences(before), rise = differences(within), out = new Float64Array(bins * ORDERS);
  for (let j = 0; j < bins; ++j)
    for (let part = 0; part < parts; ++part) {
      const at = j * parts + part, width = (rise[at] < 0 ? -2 : 2) / parts;
      const start = (2 * part) / parts - 1 + Math.max(0, -width);
      const peak = photons[at] * Math.exp(-Math.min(within[at], within[at + 1]));
      const [zero, one, two, three] = decayingPowers(Math.abs(rise[at])).map((x) => peak * x);
      out[j * ORDERS] += zero;
      out[j * ORDERS + 1] += start * zero + width * one;
      out[j * ORDERS + 2] += start * (start * zero + 2 * width * one) + width ** 2 * two;
      out[j * ORDERS + 3] +=
        start * (start * (start * zero + 3 * width * one) + 3 * width ** 2 * two) + width ** 3 * three;
    }
  return out;
}

/** Integrals of x^m exp(-fall x) over [0, 1], m = 0 .. 3, for fall >= 0. */
function decayingPowers(fall) {
  const out = new Float64Array(ORDERS), last = Math.exp(-fall);
  for (let m = 0; m < ORDERS; ++m)
    if (fall < SERIES_BELOW)
      for (let j = 0, term = 1; j < SERIES_TERMS; term *= -fall / ++j) out[m] += term / (m + 1 + j);
    else out[m] = m === 0 ? -Math.expm1(-fall) / fall : (m * out[m - 1] - last) / fall;
  return out;
}
