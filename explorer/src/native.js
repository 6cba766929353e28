// The package's native sources, compiled (native/api.cpp), behind functions that take and give plain arrays.
// Times in laser periods. Every view of the memory is made after the last allocation: growth detaches older ones.

/** One number as two of 32 bits, low first. */
export const seedWords = (seed) => {
  const word = BigInt.asUintN(64, BigInt(seed));
  return [Number(word & 0xffffffffn), Number(word >> 32n)];
};

export class Native {
  constructor(instance) {
    this.calls = instance.exports;
    this.calls._initialize();
  }

  static async load(module) {
    const host = { proc_exit: (code) => { throw new Error(`the native code stopped (${code})`); } };
    const unused = new Proxy(host, { get: (known, name) => known[name] ?? (() => 0) });
    const imports = { env: { emscripten_notify_memory_growth: () => {} }, wasi_snapshot_preview1: unused };
    return new Native(await WebAssembly.instantiate(module, imports));
  }

  /** Calls use(pointers) with copies of `inputs` in memory and room for `outputs` ([type, length]); returns copies of those. */
  with(inputs, outputs, use) {
    const places = [];
    try {
      for (const array of inputs) places.push(array ? this.calls.malloc(Math.max(array.byteLength, 8)) >>> 0 : 0);
      for (const [type, length] of outputs) places.push(this.calls.malloc(Math.max(type.BYTES_PER_ELEMENT * length, 8)) >>> 0);
      const wanted = inputs.length;
      if (places.some((place, k) => place === 0 && !(k < wanted && !inputs[k]))) throw new Error("out of memory");
      inputs.forEach((array, k) => {
        if (array) new array.constructor(this.calls.memory.buffer, places[k], array.length).set(array);
      });
      const value = use(...places);
      const copies = outputs.map(([type, length], k) => new type(this.calls.memory.buffer, places[wanted + k], length).slice());
      return { value, copies };
    } finally {
      for (const place of places) if (place) this.calls.free(place);
    }
  }

  /** Histograms (realizations * pixels * bins) of `light`: arrays signal, delay, background and index of the pixels, and of
   *  pixels with a second return `second` and `secondDelay`. */
  simulate(system, light, seed, realizations = 1) {
    const pixels = light.signal.length;
    const told = new Float64Array([
      system.cycles, system.bins, system.dead, system.stationary ? 1 : 0, system.mode, system.gateStart, system.gateWidth,
      system.afterpulses, system.trapDelay, system.twilight, system.electronics, system.jitter,
    ]);
    const [low, high] = seedWords(seed);
    const returns = light.second ? 2 : 1, both = (first, second) => (second ? Float64Array.from([...first, ...second]) : first);
    const inputs = [told, both(light.signal, light.second), both(light.delay, light.secondDelay), light.background, light.index];
    return this.with(inputs, [[Uint32Array, pixels * realizations * system.bins]], (t, s, d, b, i, out) =>
      this.calls.simulate(system.sigma, t, pixels, returns, s, d, b, i, low, high, realizations, out)).copies[0];
  }

  /** Energy of the train of pulses up to times `t` after the delay. */
  energyBefore(sigma, t) {
    return this.with([t], [[Float64Array, t.length]], (from, to) => this.calls.energy_before(sigma, from, t.length, to)).copies[0];
  }

  /** Cumulants and mean histogram of one exposure: `settled` below -1 where there is none. */
  moments(grid, photons, rates) {
    const outputs = [[Float64Array, 4], [Float64Array, grid.outBins], [Float64Array, 4 + grid.outBins]];
    const { value, copies } = this.with([told(grid), photons, rates], outputs, (...at) => this.calls.exposure_moments(...at));
    return { settled: value, cumulants: copies[0], histogram: copies[1] };
  }

  /** E z^N at points of the circle. */
  characteristic(grid, photons, rates, zRe, zIm) {
    const n = zRe.length;
    const { value, copies } = this.with(
      [told(grid), photons, rates, zRe, zIm], [[Float64Array, n], [Float64Array, n]],
      (g, p, r, re, im, outRe, outIm) => this.calls.characteristic(g, p, r, n, re, im, outRe, outIm));
    return { settled: value, re: copies[0], im: copies[1] };
  }

  /** P(standard normal number <= t). */
  normalBelow(t) {
    return this.with([t], [[Float64Array, t.length]], (from, to) => this.calls.normal_below(from, t.length, to)).copies[0];
  }

  /** Variances of windows of an exposure that is carried through all of its periods, weights (windows * out bins); or null. */
  windowVariances(grid, photons, weights) {
    const windows = weights.length / grid.outBins;
    const { value, copies } = this.with([told(grid), photons, weights], [[Float64Array, windows]], (g, p, w, out) =>
      this.calls.window_variances(g, p, windows, w, out));
    return value ? copies[0] : null;
  }

  settlingPeriods(grid, photons, tolerance, mostSteps) {
    return this.with([told(grid), photons], [], (g, p) => this.calls.settling_periods(g, p, tolerance, mostSteps)).value;
  }

  /** Maximum likelihood of pixels: (pixels * 8) of S, B, delay, their errors, gain, ..., and flags. */
  maximumLikelihood(record, counts) {
    const pixels = counts.length / record.told[1];
    const { copies } = this.with(
      [record.told, record.curve, record.open, counts], [[Float64Array, 8 * pixels], [Uint8Array, pixels]],
      (t, c, o, h, out, flags) => this.calls.maximum_likelihood(
        t, record.curve.length / 2, c, o, pixels, h, record.starts, record.leastGain, out, flags));
    return { found: copies[0], flags: copies[1] };
  }

  /** Maps (8 * pixels) of native/image/solver.h, of an image from its photons and those around each pixel. */
  imageMaps(record, counts, height, width, { weights, card }) {
    return this.with([record.told, record.curve, record.open, counts, weights, card], [[Float64Array, 8 * height * width]],
      (t, c, o, h, w, k, out) => this.calls.image_maps(
        t, record.curve.length / 2, c, o, height, width, h, record.starts, record.leastGain, w, k, out)).copies[0];
  }
}

const told = (grid) => new Float64Array([
  grid.cycles, grid.maxPeriods, grid.whole, grid.bins, grid.outBins, grid.shift, grid.fraction, grid.stationary ? 1 : 0,
  grid.tolerance, grid.warmPeriods,
]);
