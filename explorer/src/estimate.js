// Delay and light from histograms, by the largest bin and by the native maximum-likelihood estimator; what that is told of
// a system is as reconstruction/histogram_record.py has it.
import { GATED, deadTimeOn, sharpness } from "./light.js";

const SYNCHRONOUS = 2, CELLS_PER_SIGMA = 32, REACH = 8.5, CORE = 2.9677379253417944; // 0.15 % lie beyond so many sigma
const STARTS = 3, FALSE_ALARM = 0.01;
export const NO_SIGNAL = 2, EMPTY = 1;

/** Delays (pixels), periods, at the centre of the fullest bin; NaN without counts. */
export function byPeak(counts, bins) {
  const delays = new Float64Array(counts.length / bins);
  for (let p = 0; p < delays.length; ++p) {
    let top = 0;
    for (let j = 1; j < bins; ++j) if (counts[p * bins + j] > counts[p * bins + top]) top = j;
    delays[p] = counts[p * bins + top] > 0 ? (top + 0.5) / bins : NaN;
  }
  return delays;
}

/** Whether the maximum-likelihood estimator holds for a system. */
export const hasLikelihood = (system) =>
  system.mode !== 1 && 2 * REACH * system.sigma < 1 && !(system.afterpulses || system.twilight || system.electronics || system.jitter);

/** x with P(standard normal number <= x) = p, by bisection. */
function normalQuantile(native, p) {
  let low = -40, high = 40;
  for (let k = 0; k < 80; ++k) {
    const x = (low + high) / 2;
    if (native.normalBelow(Float64Array.of(x))[0] < p) low = x;
    else high = x;
  }
  return (low + high) / 2;
}

function recordOf(native, system) {
  const { sigma, bins } = system, cells = Math.ceil(2 * REACH * CELLS_PER_SIGMA), low = -REACH * sigma;
  const cell = (2 * REACH * sigma) / cells, x = Float64Array.from({ length: cells + 1 }, (_, k) => -REACH + (2 * REACH * k) / cells);
  const energy = native.normalBelow(x);
  [energy[0], energy[cells]] = [0, 1];
  const density = x.map((u) => Math.exp(-0.5 * u * u) / (Math.sqrt(2 * Math.PI) * sigma));
  const width = 1 / (2 * Math.sqrt(Math.PI) * sharpness(sigma)), dead = deadTimeOn(system, bins);
  const places = Math.max(1, Math.min(bins, 1 / width));
  return {
    told: Float64Array.of(system.cycles, bins, dead.whole, dead.shift, dead.fraction, system.stationary ? 1 : 0,
      system.mode === SYNCHRONOUS ? 1 : 0, low, cell, width, -CORE * sigma, CORE * sigma),
    curve: Float64Array.from([...energy, ...density]), open: system.mode === GATED ? openBins(system) : null,
    starts: STARTS, leastGain: normalQuantile(native, 1 - FALSE_ALARM / places) ** 2,
  };
}

function openBins(system) {
  const { bins, gateStart, gateWidth } = system, open = new Float64Array(2 * bins), end = gateStart + gateWidth;
  const parts = end <= 1 ? [[gateStart, end]] : [[0, end - 1], [gateStart, 1]];
  for (let j = 0; j < bins; ++j) {
    open[j] = open[bins + j] = j / bins;
    for (const [low, high] of parts) {
      const a = Math.min(Math.max(low, j / bins), (j + 1) / bins), b = Math.min(Math.max(high, j / bins), (j + 1) / bins);
      if (b > a) [open[j], open[bins + j]] = [a, b];
    }
  }
  return open;
}

/** An image from its photons and those around each pixel: delays (pixels), periods, and half widths of 90 % intervals. */
export function byImage(native, system, counts, height, width, networks) {
  const maps = native.imageMaps(recordOf(native, system), counts, height, width, networks), pixels = height * width;
  return { delay: maps.slice(0, pixels), halfWidth: maps.slice(pixels, 2 * pixels) };
}

/** Maximum likelihood of pixels: arrays signal, background (photons per period), delay and its error (periods), flags. */
export function byLikelihood(native, system, counts) {
  const { found, flags } = native.maximumLikelihood(recordOf(native, system), counts);
  const column = (c) => Float64Array.from({ length: flags.length }, (_, p) => found[8 * p + c]);
  const seen = (c) => column(c).map((x, p) => (flags[p] & (NO_SIGNAL | EMPTY) ? NaN : x));
  return { signal: column(0), background: column(1), delay: seen(2), delayError: seen(5), flags };
}
