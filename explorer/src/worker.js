// What computes, beside the page: one request after the other, each a stage of a figure. The page ends a worker that
// takes too long, and starts another.
import { Native } from "./native.js";
import { Refused, exposure } from "./exposure.js";
import { binVariances } from "./band.js";
import { byImage, byLikelihood, byPeak, hasLikelihood } from "./estimate.js";
import { countLaw, nativeCharacteristic, poissonLaw } from "./count_law.js";
import { goldenBits } from "./golden.js";
import { photonsIn, sum } from "./light.js";
import { synchronous } from "./synchronous.js";
import { Jitter } from "./timing.js";

const SYNCHRONOUS = 2, SLICE = 256; // pixels at a time, between which the page is told how far it is
let native = null, kept = {}; // what later stages of the same request need

const poissonVariances = ({ histogram }, jitter) => (jitter ? jitter.forward(histogram) : histogram);

const stages = {
  /** The dots and the light: counts (bins), their number, and photons that arrive in a bin and period, gate or not. */
  draw({ system, light, seed, counts }) {
    const pixel = { signal: light.signal[0], background: light.background[0], delay: light.delay[0], second: light.second?.[0], secondDelay: light.secondDelay?.[0] };
    const drawn = counts ?? native.simulate(system, light, seed);
    kept = { system, pixel, drawn };
    return { counts: drawn, registered: sum(drawn), incident: photonsIn(native, { ...system, mode: 0 }, pixel, system.bins) };
  },

  /** The exact mean histogram, and mean and variance of the count. */
  mean() {
    const { system, pixel } = kept;
    kept.jitter = system.jitter > 0 ? new Jitter(native, system, pixel) : null;
    const out = kept.jitter?.parts ?? system.bins;
    kept.law = system.mode === SYNCHRONOUS ? synchronous(native, system, pixel, out) : exposure(native, system, pixel, out);
    const { cumulants, histogram, bins } = kept.law;
    return { cumulants: cumulants.slice(0, 2), mean: kept.jitter ? kept.jitter.forward(histogram) : histogram, grid: bins };
  },

  /** The law of the count. */
  law() {
    const { system, pixel, law } = kept;
    if ((system.dead === 0 && system.mode !== SYNCHRONOUS) || law.cumulants[0] === 0) return poissonLaw(law.cumulants[0]);
    return countLaw(law.characteristic ?? nativeCharacteristic(native, system, pixel, law.bins), law.cumulants, system.cycles);
  },

  /** Delays of the dots: by the fullest bin, and by maximum likelihood. */
  estimate() {
    const { system, drawn } = kept, peak = byPeak(drawn, system.bins)[0];
    if (!hasLikelihood(system)) return { peak, likelihood: null };
    const { signal, background, delay, delayError, flags } = byLikelihood(native, system, drawn);
    return { peak, likelihood: { signal: signal[0], background: background[0], delay: delay[0], delayError: delayError[0], flags: flags[0] } };
  },

  /** Exact variances of the bins. */
  band() {
    const { system, pixel, law, jitter } = kept;
    if (system.dead === 0 && system.mode !== SYNCHRONOUS) return { variances: poissonVariances(law, jitter) };
    if (system.mode !== 0) throw new Refused("for this mode the page has no exact variance of a bin");
    return { variances: binVariances(native, system, pixel, law, jitter) };
  },

  /** Counts and delays of all pixels of a picture. */
  picture({ system, light, seed }, tell) {
    const pixels = light.signal.length, cube = new Uint32Array(pixels * system.bins);
    for (let first = 0; first < pixels; first += SLICE) {
      const some = Object.fromEntries(Object.entries(light).map(([name, values]) => [name, values.slice(first, first + SLICE)]));
      cube.set(native.simulate(system, some, seed), first * system.bins);
      tell((first + SLICE) / pixels);
    }
    kept = { system, cube };
    const totals = Float64Array.from({ length: pixels }, (_, p) => sum(cube.subarray(p * system.bins, (p + 1) * system.bins)));
    return { totals, delay: byPeak(cube, system.bins) };
  },

  /** Delays of all pixels of the last picture by maximum likelihood. */
  likelihood(_, tell) {
    const { system, cube } = kept, pixels = cube.length / system.bins, delay = new Float64Array(pixels);
    if (!hasLikelihood(system)) throw new Refused("maximum likelihood does not hold for this mode, pulse or effect");
    for (let first = 0; first < pixels; first += SLICE) {
      delay.set(byLikelihood(native, system, cube.subarray(first * system.bins, (first + SLICE) * system.bins)).delay, first);
      tell((first + SLICE) / pixels);
    }
    return { delay };
  },

  /** Delays of all pixels of the last picture, each from its photons and those around it. */
  image({ height, width, networks }) {
    const { system, cube } = kept;
    if (!hasLikelihood(system)) throw new Refused("this method does not hold for this mode, pulse or effect");
    return byImage(native, system, cube, height, width, networks);
  },

  /** The cube of the last picture. */
  cube: () => ({ cube: kept.cube }),

  golden: async () => ({ cubes: await goldenBits(native) }),
};

onmessage = async ({ data: { id, stage, ...request } }) => {
  const began = performance.now();
  try {
    if (stage === "start") {
      native = await Native.load(request.module);
      postMessage({ id, done: {} });
      return;
    }
    const done = await stages[stage](request, (share) => postMessage({ id, share }));
    postMessage({ id, done: { ...done, took: performance.now() - began } });
  } catch (error) {
    if (error instanceof Refused) postMessage({ id, refused: error.message });
    else postMessage({ id, failed: String(error?.stack ?? error) });
  }
};
