// What the page is set to: parameters in the units of the page, their place in the link, and the same in laser periods.

export const SPEED_OF_LIGHT = 0.299792458; // m / ns
export const MODES = ["nonparalyzable", "paralyzable", "synchronous", "gated"];

const log = (key, label, unit, value, low, high, more = {}) => ({ key, label, unit, value, low, high, scale: "log", ...more });
const linear = (key, label, unit, value, low, high, more = {}) => ({ key, label, unit, value, low, high, scale: "linear", ...more });

/** Numbers with a slider, by groups. `zero`: the lowest place of a logarithmic slider is 0, which turns an effect off. */
export const GROUPS = [
  { name: "Light", numbers: [
    log("signal", "Signal S", "photons / period", 1, 0.001, 100, { zero: true, short: "S" }),
    log("background", "Background B", "photons / period", 1, 0.001, 100, { zero: true, short: "B" }),
    linear("delay", "Delay of the return", "ns", 60, 0, 500, { most: "period" }),
    log("sigma", "Pulse width σ", "ns", 2, 0.1, 10),
  ] },
  { name: "Detector", numbers: [
    linear("dead", "Dead time", "ns", 30, 0, 500),
    linear("gateStart", "Gate opens at", "ns", 30, 0, 500, { mode: "gated", most: "period" }),
    linear("gateWidth", "Gate stays open for", "ns", 40, 1, 500, { mode: "gated", most: "period" }),
  ] },
  { name: "Histogram", numbers: [
    log("cycles", "Laser periods", "cycles", 2000, 10, 100000, { whole: true }),
    log("bins", "Bins", "per period", 128, 8, 1024, { whole: true }),
    log("period", "Laser period", "ns", 100, 20, 500),
  ] },
  { name: "Effects", folded: true, numbers: [
    linear("efficiency", "Detection efficiency", "", 1, 0.01, 1),
    log("dark", "Dark counts", "counts / s", 0, 10, 1e6, { zero: true }),
    log("jitter", "Timing jitter σ", "ns", 0, 0.02, 5, { zero: true }),
    log("afterpulses", "Afterpulses per avalanche", "", 0, 0.001, 0.5, { zero: true }),
    log("trapDelay", "Mean delay of an afterpulse", "ns", 50, 1, 1000),
    log("twilight", "Twilight before the dead time's end", "ns", 0, 0.1, 20, { zero: true, mode: "nonparalyzable" }),
    log("electronics", "Dead time of the electronics", "ns", 0, 1, 500, { zero: true }),
  ] },
];
export const NUMBERS = GROUPS.flatMap((group) => group.numbers);
const CHOICES = { mode: MODES, start: ["armed", "stationary"], method: ["truth", "peak", "likelihood"] };

/** Where the page begins. `pixel`: of the picture, row * width + column, or -1 for a pixel of its own. */
export const INITIAL = {
  ...Object.fromEntries(NUMBERS.map(({ key, value }) => [key, value])),
  mode: "nonparalyzable", start: "armed", method: "peak", seed: 1, pixel: -1, log: 0,
};

/** The nearest value that a number may have: whole, within its bounds, to four digits. */
export function rounded(number, value) {
  if (!Number.isFinite(value)) return number.value;
  const bounded = Math.min(Math.max(value, number.zero && value < number.low / 2 ? 0 : number.low), number.high);
  return number.whole ? Math.round(bounded) : Number(bounded.toPrecision(4));
}

/** The link: what is not as in INITIAL. */
export function toHash(state) {
  const told = new URLSearchParams();
  for (const key of Object.keys(INITIAL)) if (state[key] !== INITIAL[key]) told.set(key, state[key]);
  return told.toString();
}

/** The state of a link; what it gets wrong is left as it is at first. */
export function fromHash(hash, pixels) {
  const state = { ...INITIAL }, told = new URLSearchParams(hash.replace(/^#/, ""));
  for (const number of NUMBERS) if (told.has(number.key)) state[number.key] = rounded(number, Number(told.get(number.key)));
  for (const [key, choices] of Object.entries(CHOICES)) if (choices.includes(told.get(key))) state[key] = told.get(key);
  const whole = (key, low, high) => {
    const value = Number(told.get(key) ?? NaN);
    if (Number.isInteger(value) && value >= low && value <= high) state[key] = value;
  };
  whole("seed", 0, 2 ** 32 - 1);
  whole("pixel", -1, pixels - 1);
  whole("log", 0, 1);
  return state;
}

const turn = (x) => x - Math.floor(x);

/** What is wrong with a state, in words, or "". */
export function problem(state) {
  if (state.sigma > state.period) return "The pulse is longer than the period: choose a narrower one.";
  if (state.twilight > 0 && state.mode === "nonparalyzable" && state.twilight > state.dead) return "The twilight must not be longer than the dead time.";
  if (state.jitter > 0 && state.jitter > state.period / 4) return "The jitter must be shorter than a quarter of the period.";
  return "";
}

/** The system in laser periods, of detected photons. */
export function inPeriods(state) {
  const { period } = state, gated = state.mode === "gated";
  return {
    cycles: state.cycles, bins: state.bins, sigma: state.sigma / period, dead: state.dead / period,
    stationary: state.start === "stationary", mode: MODES.indexOf(state.mode),
    gateStart: gated ? turn((state.gateStart % period) / period) : 0, gateWidth: gated ? Math.min(state.gateWidth / period, 1) : 1,
    afterpulses: state.afterpulses, trapDelay: state.trapDelay / period,
    twilight: state.mode === "nonparalyzable" ? state.twilight / period : 0,
    electronics: state.electronics / period, jitter: state.jitter / period,
  };
}

/** Effects with which there is no exact law here, by name. */
export const lawless = (state) => [
  state.afterpulses > 0 && "afterpulses", state.twilight > 0 && state.mode === "nonparalyzable" && "twilight",
  state.electronics > state.dead && "the dead time of the electronics",
].filter(Boolean);

/** Light of pixels that is detected: arrays of photons per period, delays in periods, and the names of random streams. */
export function detected(state, signal, delayNs, index) {
  const { efficiency, dark, period } = state, back = state.background * efficiency + dark * period * 1e-9;
  return {
    signal: Float64Array.from(signal, (s) => s * efficiency), delay: Float64Array.from(delayNs, (d) => turn(d / period)),
    background: new Float64Array(signal.length).fill(back), index: Uint32Array.from(index),
  };
}
