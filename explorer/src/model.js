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
    log("second", "Signal of a second return", "photons / period", 0, 0.001, 100, { zero: true }),
    linear("gap", "Delay of the second after the first", "ns", 15, 0, 500, { most: "period", with: "second" }),
    log("sigma", "Pulse width σ", "ns", 2, 0.1, 10),
  ] },
  { name: "Detector", numbers: [
    linear("dead", "Dead time", "ns", 75, 0, 500),
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
    log("trapDelay", "Mean delay of an afterpulse", "ns", 50, 1, 1000, { with: "afterpulses" }),
    log("twilight", "Twilight before the dead time's end", "ns", 0, 0.1, 20, { zero: true, mode: "nonparalyzable" }),
    log("electronics", "Dead time of the electronics", "ns", 0, 1, 500, { zero: true }),
  ] },
];
export const NUMBERS = GROUPS.flatMap((group) => group.numbers);
const CHOICES = { mode: MODES, start: ["armed", "stationary"], method: ["truth", "peak", "likelihood", "image"] };

/** Where the page begins. `pixel`: of the picture, row * width + column, or -1 for a pixel of its own. */
export const INITIAL = {
  ...Object.fromEntries(NUMBERS.map(({ key, value }) => [key, value])),
  mode: "nonparalyzable", start: "armed", method: "peak", seed: 1, pixel: -1, image: 0, log: 1,
};

/** The nearest value that a number may have: whole, within its bounds, to four digits. */
export function rounded(number, value) {
  const bounded = Math.min(Math.max(value, number.zero && value < number.low / 2 ? 0 : number.low), number.high);
  return number.whole ? Math.round(bounded) : Number(bounded.toPrecision(4));
}

/** A value from text, and what had to be changed of it in words ("" if nothing); text that is no number gives `fallback`. */
export function entered(number, text, fallback) {
  const wanted = String(text).trim() === "" ? NaN : Number(text), range = `${number.zero ? "0, or " : ""}${number.low} to ${number.high}`;
  if (!Number.isFinite(wanted)) return { value: fallback, changed: `${number.label}: "${text}" is not a number; it stays ${fallback}.` };
  const value = rounded(number, wanted), apart = Math.abs(value - wanted) > 5e-4 * Math.abs(wanted);
  return { value, changed: apart ? `${number.label} takes ${range}${number.whole ? ", whole" : ""}: ${wanted} became ${value}.` : "" };
}

/** The link: what is not as in `base`. */
export function toHash(state, base = INITIAL) {
  const parameters = new URLSearchParams();
  for (const key of Object.keys(INITIAL)) if (state[key] !== base[key]) parameters.set(key, state[key]);
  return parameters.toString();
}

/** { state, changed } of a link: what it gets wrong is as in `base`, and `changed` says so. */
export function fromHash(hash, pixels, base = INITIAL, images = 1) {
  const state = { ...base }, parameters = new URLSearchParams(hash.replace(/^#/, "")), changed = [];
  for (const number of NUMBERS) {
    if (!parameters.has(number.key)) continue;
    const answer = entered(number, parameters.get(number.key), base[number.key]);
    state[number.key] = answer.value;
    if (answer.changed) changed.push(answer.changed);
  }
  for (const [key, choices] of Object.entries(CHOICES)) {
    if (!parameters.has(key)) continue;
    if (choices.includes(parameters.get(key))) state[key] = parameters.get(key);
    else changed.push(`"${parameters.get(key)}" is no ${key}: it is ${base[key]}.`);
  }
  for (const [key, low, high] of [["seed", 0, 2 ** 32 - 1], ["pixel", -1, pixels - 1], ["image", 0, images - 1], ["log", 0, 1]]) {
    if (!parameters.has(key)) continue;
    const value = Number(parameters.get(key));
    if (Number.isInteger(value) && value >= low && value <= high) state[key] = value;
    else changed.push(`${key} takes whole numbers from ${low} to ${high}: it is ${base[key]}.`);
  }
  return { state, changed: changed.join(" ") };
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
    afterpulses: state.afterpulses, trapDelay: state.afterpulses > 0 ? state.trapDelay / period : 0, // warm-ups last as long as what avalanches leave
    twilight: state.mode === "nonparalyzable" ? state.twilight / period : 0,
    electronics: state.electronics / period, jitter: state.jitter / period,
  };
}

/** Effects with which there is no exact law here, by name. */
export const lawless = (state) => [
  state.afterpulses > 0 && "afterpulses", state.twilight > 0 && state.mode === "nonparalyzable" && "twilight",
  state.electronics > state.dead && "the dead time of the electronics",
].filter(Boolean);

/** Light of pixels that is detected: arrays of photons per period, delays in periods, and the names of random streams.
 *  `second`: signal of a second return in each pixel, `state.gap` after the first, or null. */
export function detected(state, signal, delayNs, index, second) {
  const { efficiency, dark, period } = state, back = state.background * efficiency + dark * period * 1e-9;
  const light = {
    signal: Float64Array.from(signal, (s) => s * efficiency), delay: Float64Array.from(delayNs, (d) => turn(d / period)),
    background: new Float64Array(signal.length).fill(back), index: Uint32Array.from(index),
  };
  if (second) {
    light.second = Float64Array.from(second, (s) => s * efficiency);
    light.secondDelay = Float64Array.from(delayNs, (d) => turn((d + state.gap) / period));
  }
  return light;
}
