// The law of the count from its generating function on the unit circle, as statistics/pmf.py composes it: the support is
// guessed from mean and variance, and the result tells whether the guess was right.
import { Refused, lightOn } from "./exposure.js";
import { gridOf, sum } from "./light.js";

const REACH = 7.5, MARGIN = 6, WIDEST = 4096, QUIET = 1e-15, EDGE = 1e-10, CONSISTENT = 1e-5, STEPS = 40e6;

/** { first, p } of a Poisson count. */
export function poissonLaw(mean) {
  const half = Math.ceil(REACH * Math.sqrt(mean) + MARGIN), first = Math.max(Math.floor(mean) - half, 0);
  const top = Math.floor(mean), p = new Float64Array(Math.floor(mean) + half - first + 1);
  p[top - first] = 1; // relative to the most likely count, then normalised
  for (let n = top + 1; n < first + p.length; ++n) p[n - first] = (p[n - first - 1] * mean) / n;
  for (let n = top - 1; n >= first; --n) p[n - first] = (p[n - first + 1] * (n + 1)) / mean;
  const total = sum(p);
  return { first, p: p.map((x) => x / total) };
}

/** The generating function of free-running, gated and paralyzable pixels, on the grid that their cumulants needed. */
export function nativeCharacteristic(native, system, pixel, bins) {
  const light = lightOn(native, system, pixel, bins);
  return (zRe, zIm, cycles = system.cycles) => {
    const steps = Math.max(Math.floor((2 * STEPS) / Math.max(zRe.length, 1)), bins);
    const found = native.characteristic(gridOf({ ...system, cycles }, bins, 1, steps), light.photons, light.rates, zRe, zIm);
    if (found.settled < -1) throw new Refused("the law of the count takes too long here; its mean and variance are exact");
    return found;
  };
}

const onCircle = (value, angle, cycles) => value(angle.map(Math.cos), angle.map(Math.sin), cycles);

/** { first, p }: `value` (re, im of z, cycles) gives E z^N. */
export function countLaw(value, [mean, variance], cycles) {
  const spread = Math.sqrt(Math.max(variance, 0));
  for (const reach of [REACH, 2 * REACH]) {
    const half = Math.ceil(reach * spread + MARGIN), first = Math.max(Math.floor(mean) - half, 0);
    const counts = Math.floor(mean) + half - first + 1, size = 4 * Math.ceil(counts / 4);
    if (size > WIDEST) throw new Refused(`the law of the count is ${size} counts wide, more than is drawn here; its mean and variance are exact`);
    const { re, im } = transform(value, size, variance, cycles);
    const cosines = Float64Array.from({ length: size }, (_, k) => Math.cos((2 * Math.PI * k) / size));
    const p = new Float64Array(counts);
    for (let c = 0; c < counts; ++c) {
      let total = 0;
      const n = (first + c) % size;
      for (let k = 0, at = 0; k < re.length; ++k, at = (at + n) % size) {
        const weight = k === 0 || 2 * k === size ? 1 : 2;
        total += weight * (re[k] * cosines[at] + im[k] * cosines[(at + (3 * size) / 4) % size]);
      }
      p[c] = total / size;
    }
    const total = sum(p), away = p.reduce((s, x, c) => s + x * (first + c - mean), 0);
    const ends = Math.max(Math.abs(p[counts - 1]), first > 0 ? Math.abs(p[0]) : 0);
    const fits = ends <= EDGE + 1e-13 * cycles && Math.abs(total - 1) <= CONSISTENT && Math.abs(away) <= CONSISTENT * Math.max(spread, 1) + 1e-13 * cycles * Math.max(spread, 1);
    if (fits) return { first, p: p.map((x) => Math.max(x, 0) / total) };
  }
  throw new Refused("the law of the count does not end where its mean and variance let expect it");
}

/** E z^N at the points 0 .. size / 2 of the circle, up to where a wide law's is nothing. */
function transform(value, size, variance, cycles) {
  const points = size / 2 + 1, angle = Float64Array.from({ length: points }, (_, k) => (2 * Math.PI * k) / size);
  const shorter = Math.max(1, Math.ceil((4 * cycles) / Math.max(variance, 1e-300)));
  if (size <= 64 || 6 * shorter > cycles) return onCircle(value, angle, cycles);
  const re = [], im = [], step = Math.max(8, Math.ceil((2 * size) / (2 * Math.PI * Math.sqrt(variance))));
  while (re.length < points) {
    const some = onCircle(value, angle.slice(re.length, re.length + step), cycles);
    re.push(...some.re);
    im.push(...some.im);
    if (some.re.every((x, k) => Math.hypot(x, some.im[k]) <= QUIET)) break;
  }
  if (re.length >= points) return { re, im };
  // counts that keep to a lattice have other peaks: looked for in a much shorter exposure, where they are wide
  const spread = Math.sqrt((variance * shorter) / cycles), begin = Math.min(4 / spread, Math.PI);
  const many = 2 + Math.ceil(((Math.PI - begin) * spread) / 0.3);
  const beyond = Float64Array.from({ length: many }, (_, k) => begin + ((Math.PI - begin) * k) / (many - 1));
  const brief = onCircle(value, beyond, shorter);
  let highest = 0;
  brief.re.forEach((x, k) => { highest = Math.max(highest, Math.hypot(x, brief.im[k])); });
  return highest ** (cycles / shorter) <= 1e-3 * QUIET ? { re, im } : onCircle(value, angle, cycles);
}
