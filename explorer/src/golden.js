// The golden cubes of the package's tests that this page can draw (tests/test_reproducibility.py has the first ones,
// tests/test_detector_bits.py those of modes), and whether the bits here are theirs.

export const PLAIN = { cycles: 120, bins: 50, sigma: 0.75 / 100, dead: 63.75 / 100, stationary: false, mode: 0, gateStart: 0, gateWidth: 1,
  afterpulses: 0, trapDelay: 0, twilight: 0, electronics: 0, jitter: 0 };
const GATE = { mode: 3, gateStart: 83 / 100, gateWidth: 31 / 100 };

/** By the name of the test's cube: what is not as in PLAIN, realizations, and the start of the cube's SHA-256. */
export const GOLDEN = {
  "gaussian": [{}, 3, "5a451c78a96e7cec"],
  "stationary": [{ stationary: true }, 3, "22bc8ffbea4eed89"],
  "whole periods": [{ dead: 3 }, 3, "bc6adf866ba6d843"],
  "no dead time": [{ dead: 0, cycles: 7 }, 3, "5b2d8d0cfdec1796"],
  "long dead time": [{ dead: 777.7 / 100, stationary: true, cycles: 500 }, 3, "eac2ff35de9603ca"],
  "paralyzable gaussian": [{ mode: 1, dead: 23.75 / 100 }, 2, "5f5cf4fe0c38"],
  "synchronous gaussian": [{ mode: 2 }, 2, "b87b9d6581cf"],
  "gated gaussian": [GATE, 2, "443a62a92ec5"],
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
