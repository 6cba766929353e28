// The golden cubes of the package's tests that this page can draw (tests/test_reproducibility.py has the first ones,
// tests/test_detector_bits.py those of modes), and whether the bits here are theirs.

export const PLAIN = { cycles: 120, bins: 50, sigma: 0.75 / 100, dead: 63.75 / 100, stationary: false, mode: 0, gateStart: 0, gateWidth: 1,
  afterpulses: 0, trapDelay: 0, twilight: 0, electronics: 0, jitter: 0 };
const GATE = { mode: 3, gateStart: 83 / 100, gateWidth: 31 / 100 };

/** By the name of the test's cube: what is not as in PLAIN, realizations, and the start of the cube's SHA-256. */
export const GOLDEN = {
  "gaussian": [{}, 3, "67664de020ee6891"],
  "stationary": [{ stationary: true }, 3, "d9811fcfe1ed1553"],
  "whole periods": [{ dead: 3 }, 3, "398c5a8069ad4f41"],
  "no dead time": [{ dead: 0, cycles: 7 }, 3, "73bf40e6baba9750"],
  "long dead time": [{ dead: 777.7 / 100, stationary: true, cycles: 500 }, 3, "d3bbc1adbd302269"],
  "paralyzable gaussian": [{ mode: 1, dead: 23.75 / 100 }, 2, "195c64d00133"],
  "synchronous gaussian": [{ mode: 2 }, 2, "5e2fb06ab885"],
  "gated gaussian": [GATE, 2, "1ccd551675ad"],
};
const SEED = 2n ** 63n + 1n;

/** The image (6, 11) of those tests. */
function image() {
  const light = { signal: new Float64Array(66), delay: new Float64Array(66), background: new Float64Array(66), index: new Uint32Array(66) };
  for (let y = 0; y < 6; ++y)
    for (let x = 0; x < 11; ++x) {
      const p = 11 * y + x;
      light.signal[p] = (x + y) % 5 === 0 ? 0 : 0.01 * 2 ** ((3 * x + 7 * y) % 13);
      light.background[p] = (2 * x + y) % 7 === 0 ? 0 : 0.02 * 3 ** ((x + 5 * y) % 6);
      const delay = (9.7 * x - 31.3 * y) / 100;
      light.delay[p] = delay - Math.floor(delay);
      light.index[p] = p;
    }
  return light;
}

export async function sha256(counts) {
  const bytes = new Uint8Array(await crypto.subtle.digest("SHA-256", counts));
  return Array.from(bytes, (byte) => byte.toString(16).padStart(2, "0")).join("");
}

/** For each golden cube its name, the hash that is expected, and the one of the cube drawn here. */
export async function goldenBits(native) {
  const light = image();
  return Promise.all(Object.entries(GOLDEN).map(async ([name, [changes, realizations, expected]]) => {
    const counts = native.simulate({ ...PLAIN, ...changes }, light, SEED, realizations);
    return { name, expected, found: (await sha256(counts)).slice(0, expected.length) };
  }));
}
