// One pixel's light on a grid of the period, and the grid itself: as mars_lidar/statistics/cells.py and gated_light.py
// compose them. A system is in laser periods (model.js: inPeriods), a pixel has photons per period and a delay in [0, 1).

export const GATED = 3;
const MIN_BINS = 128, MOST_FIRST_BINS = 2 ** 14;
export const PARTS = 4; // of a bin, by which the native recursion is told the light

export const edgesOf = (n) => Float64Array.from({ length: n + 1 }, (_, k) => k / n);
export const differences = (a) => Float64Array.from({ length: a.length - 1 }, (_, k) => a[k + 1] - a[k]);
export const sum = (a) => a.reduce((total, x) => total + x, 0);

function openParts(system) {
  const end = system.gateStart + system.gateWidth;
  return end <= 1 ? [[system.gateStart, end]] : [[0, end - 1], [system.gateStart, 1]];
}

/** Energy of the train of pulses of a return between the start of the period and `edges`. */
function energyOf(native, system, delay, edges) {
  const at = new Float64Array(edges.length + 1);
  at[0] = -delay;
  edges.forEach((edge, k) => { at[k + 1] = edge - delay; });
  const energy = native.energyBefore(system.sigma, at);
  return edges.map((_, k) => energy[k + 1] - energy[0]);
}

function ungated(native, system, pixel, edges) {
  const energy = energyOf(native, system, pixel.delay, edges);
  const second = pixel.second ? energyOf(native, system, pixel.secondDelay, edges) : null;
  return edges.map((edge, k) =>
    Math.max(pixel.signal * energy[k] + (second ? pixel.second * second[k] : 0) + pixel.background * edge, 0));
}

/** Photons between the start of the period and `edges` in [0, 1], inside of the gate. */
export function photonsBefore(native, system, pixel, edges) {
  if (system.mode !== GATED) return ungated(native, system, pixel, edges);
  const total = new Float64Array(edges.length);
  for (const [low, high] of openParts(system)) {
    const bounded = Float64Array.from([low, ...edges.map((edge) => Math.min(Math.max(edge, low), high))]);
    const inside = ungated(native, system, pixel, bounded);
    for (let k = 0; k < total.length; ++k) total[k] += inside[k + 1] - inside[0];
  }
  return total;
}

/** Photons in each of n equal parts of the period. */
export const photonsIn = (native, system, pixel, n) =>
  differences(photonsBefore(native, system, pixel, edgesOf(n))).map((x) => Math.max(x, 0));

/** Integral of the squared shape of the pulse over the period, neighbours included. */
export function sharpness(sigma) {
  let total = 1;
  for (let k = 1; k < 12; ++k) total += 2 * Math.exp(-(k * k) / (4 * sigma * sigma));
  return total / (2 * Math.sqrt(Math.PI) * sigma);
}

/** Bins of the first grid: an even multiple of `out`, at most half a sigma of the pulse wide. */
export function firstBins(system, out) {
  let sharp = sharpness(system.sigma);
  if (system.mode === GATED) sharp = Math.max(sharp, 1 / Math.max(system.gateWidth, 1 / MOST_FIRST_BINS));
  const wanted = Math.min(Math.max(MIN_BINS, 4 * Math.sqrt(Math.PI) * sharp), MOST_FIRST_BINS);
  return 2 * out * Math.ceil(wanted / (2 * out));
}

/** Whole periods of the dead time, whole bins of the rest, and the fraction of a bin that is left. */
export function deadTimeOn(system, bins) {
  let whole = Math.floor(system.dead);
  const position = (system.dead - whole) * bins;
  let shift = Math.floor(position), fraction = position - shift;
  if (fraction < 1e-9) fraction = 0;
  else if (fraction > 1 - 1e-9) [shift, fraction] = [shift + 1, 0];
  return shift === bins ? { whole: whole + 1, shift: 0, fraction } : { whole, shift, fraction };
}

export const gridOf = (system, bins, outBins, steps) => ({
  cycles: system.cycles, maxPeriods: Math.max(1, Math.floor(steps / bins)), bins, outBins, ...deadTimeOn(system, bins),
  stationary: system.stationary, tolerance: 1e-12, warmPeriods: 400,
});
