// The exact law of a synchronous pixel: an armed period registers with probability q = 1 - e^-Lambda and costs 1 + K or
// 2 + K periods (docs/theory_detectors.md, (4) to (7)). The generating function of its count is carried from period to
// period; statistics/synchronous.py has the same law by sums.
import { edgesOf, photonsBefore, sum } from "./light.js";

/** q, the share of registrations whose dead time takes one period more, and the law of the first armed period. */
function renewal(native, system, pixel) {
  const whole = Math.floor(system.dead);
  const [early, total] = photonsBefore(native, system, pixel, Float64Array.of(1 - (system.dead - whole), 1));
  const seen = -Math.expm1(-total);
  const late = seen > 0 ? Math.min((Math.exp(-early) * -Math.expm1(-Math.max(total - early, 0))) / seen, 1) : 0;
  const first = new Float64Array(Math.min(whole, system.cycles) + 2);
  first[0] = 1;
  if (system.stationary) {
    const norm = 1 + seen * (whole + late);
    for (let r = 0; r < first.length; ++r) first[r] = (r === 0 ? 1 : seen) / norm;
    if (whole < system.cycles) first[first.length - 1] = (seen * late) / norm;
  }
  return { whole, seen, late, first };
}

/** E z^N (re, im) at one point of the circle. */
function characteristicAt({ whole, seen, late, first }, cycles, zRe, zIm) {
  const memory = whole + 2, armedRe = new Float64Array(memory), armedIm = new Float64Array(memory); // registrations, by period
  let aRe = 0, aIm = 0, valueRe = 1, valueIm = 0;
  for (let q = 0; q < cycles; ++q) {
    if (q < first.length) aRe += first[q];
    const near = (q - 1 - whole + 2 * memory) % memory, far = q % memory; // registered 1 + K and 2 + K periods ago
    const backRe = (q > whole ? (1 - late) * armedRe[near] : 0) + (q > whole + 1 ? late * armedRe[far] : 0);
    const backIm = (q > whole ? (1 - late) * armedIm[near] : 0) + (q > whole + 1 ? late * armedIm[far] : 0);
    aRe += zRe * backRe - zIm * backIm;
    aIm += zRe * backIm + zIm * backRe;
    const gotRe = seen * aRe, gotIm = seen * aIm;
    armedRe[far] = gotRe;
    armedIm[far] = gotIm;
    aRe -= gotRe;
    aIm -= gotIm;
    valueRe += (zRe - 1) * gotRe - zIm * gotIm;
    valueIm += (zRe - 1) * gotIm + zIm * gotRe;
  }
  return [valueRe, valueIm];
}

/** Mean and variance of the count: the same recursion to second order in log z. */
function meanAndVariance({ whole, seen, late, first }, cycles) {
  const memory = whole + 2, kept = new Float64Array(3 * memory);
  let a0 = 0, a1 = 0, a2 = 0, v1 = 0, v2 = 0;
  for (let q = 0; q < cycles; ++q) {
    if (q < first.length) a0 += first[q];
    const near = 3 * ((q - 1 - whole + 2 * memory) % memory), far = 3 * (q % memory);
    const soon = q > whole ? 1 - late : 0, later = q > whole + 1 ? late : 0;
    const b0 = soon * kept[near] + later * kept[far], b1 = soon * kept[near + 1] + later * kept[far + 1];
    a2 += soon * kept[near + 2] + later * kept[far + 2] + b1 + b0 / 2;
    a1 += b1 + b0;
    a0 += b0;
    kept[far] = seen * a0;
    kept[far + 1] = seen * a1;
    kept[far + 2] = seen * a2;
    a0 -= kept[far];
    a1 -= kept[far + 1];
    a2 -= kept[far + 2];
    v1 += kept[far];
    v2 += kept[far + 1] + kept[far] / 2;
  }
  return [v1, Math.max(2 * v2 - v1 * v1, 0)];
}

/** As exposure(): { cumulants (2), histogram (outBins) }, and the generating function of the count. */
export function synchronous(native, system, pixel, outBins) {
  const law = renewal(native, system, pixel), [mean, variance] = meanAndVariance(law, system.cycles);
  const before = photonsBefore(native, system, pixel, edgesOf(outBins));
  const armed = Float64Array.from({ length: outBins }, (_, j) =>
    Math.exp(-before[j]) * -Math.expm1(-Math.max(before[j + 1] - before[j], 0)));
  const seen = Math.max(sum(armed), Number.MIN_VALUE);
  return {
    cumulants: Float64Array.of(mean, variance), histogram: armed.map((x) => (x * mean) / seen), bins: outBins,
    characteristic: (zRe, zIm, cycles = system.cycles) => {
      const re = new Float64Array(zRe.length), im = new Float64Array(zRe.length);
      zRe.forEach((_, k) => { [re[k], im[k]] = characteristicAt(law, cycles, zRe[k], zIm[k]); });
      return { re, im };
    },
  };
}
