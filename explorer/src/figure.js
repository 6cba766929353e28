// One pixel's figure: its stages are computed one after the other, the newest state first, and drawn as they come.
import { HistogramChart, LawChart } from "./charts.js";
import { Refusal } from "./engine.js";
import { SPEED_OF_LIGHT, detected, inPeriods, lawless } from "./model.js";
import { digits, length, measured } from "./units.js";

const LATER = ["mean", "law", "estimate", "band"]; // after "draw"
const LATE_MS = 60;

const metres = (periods, period) => (SPEED_OF_LIGHT / 2) * period * periods;
const turn = (x) => x - Math.floor(x);
const sentence = (text) => `${text[0].toUpperCase()}${text.slice(1)}.`;

export class Figure {
  constructor(page, engine) {
    this.page = page; // elements by name
    this.engine = engine;
    const small = () => innerWidth < 760 || innerHeight < 620;
    this.histogram = new HistogramChart(page.histogram, () => (small() ? 230 : 340));
    this.count = new LawChart(page.law, () => (small() ? 210 : 340));
    this.busy = false;
    this.wanted = null;
    this.settled = Promise.resolve();
    this.results = {};
  }

  /** Draws a state, with the pixel that it means; what is computed for an older state is dropped. */
  want(state, pixel, reason) {
    this.wanted = { state, pixel, reason };
    if (!this.busy) this.settled = this.#run();
    return this.settled;
  }

  restyle() {
    this.histogram.reset();
    this.count.reset();
  }

  async #run() {
    this.busy = true;
    try {
      while (this.wanted) {
        const { state, pixel, reason } = this.wanted;
        this.wanted = null;
        const light = detected(state, [pixel.signal], [pixel.delayNs], [pixel.index], pixel.second > 0 ? [pixel.second] : null);
        const system = inPeriods(state), results = { state, pixel, notes: [] };
        results.draw = await this.engine.ask("draw", { system, light, seed: state.seed, counts: pixel.counts });
        results.truth = { delay: light.delay[0], signal: light.signal[0], background: light.background[0], second: light.second?.[0] ?? 0 };
        const without = lawless(state);
        const why = reason || (without.length ? `There is no exact law here with ${without.join(" and ")}: the dots are simulated all the same.` : "");
        if (why) results.notes.push(why);
        results.lawless = Boolean(why);
        results.computing = why ? "estimate" : "mean";
        const late = setTimeout(() => this.#show(results), LATE_MS); // the dots do not wait for a slow mean
        for (const stage of why ? ["estimate"] : LATER) {
          results.computing = stage;
          await this.#stage(stage, results);
          clearTimeout(late);
          if (this.wanted) break;
        }
        results.computing = "";
        results.whole = !this.wanted;
        this.#show(results);
      }
    } catch (error) {
      this.#pending("");
      this.page.notes.textContent = error instanceof Refusal ? `Stopped: ${error.message}.` : `Something failed: ${error.message}`;
      if (!(error instanceof Refusal)) console.error(error);
    } finally {
      this.busy = false;
    }
    if (this.wanted) await this.#run();
  }

  async #stage(stage, results) {
    try {
      results[stage] = await this.engine.ask(stage);
    } catch (error) {
      if (!(error instanceof Refusal)) throw error;
      if (stage === "mean") throw error;
      results.notes.push(sentence(stage === "band" ? `${error.message}, so no band is drawn` : error.message));
      if (stage === "band") results.band = { variances: null };
      if (stage === "law") results.lawless = true;
    }
    this.#show(results);
  }

  /** Marks the charts whose curves are still those of the state before. */
  #pending(computing) {
    const law = computing === "mean" || computing === "law";
    this.page.histogram.classList.toggle("pending", computing === "mean");
    this.page.law.classList.toggle("pending", law);
    this.page.computing.textContent = law ? `computing the ${computing === "mean" ? "exact mean" : "law of the count"} …` : "";
  }

  #show(results) {
    const { state, draw, mean, law, band } = results, { period } = state;
    const time = Array.from(draw.counts, (_, j) => ((j + 0.5) * period) / state.bins);
    const spread = mean && band?.variances ? Array.from(band.variances, Math.sqrt) : null;
    const incident = Array.from(draw.incident, (x) => state.cycles * x);
    this.#pending(results.computing);
    this.histogram.show({ time, incident, mean: mean?.mean, spread, counts: draw.counts }, state.log === 1);
    if (law || results.lawless) this.count.show(law ?? null, draw.registered); // until then the last law stays, marked as pending
    this.results = { ...results, spread };
    this.page.facts.replaceChildren(...this.#facts(results, incident).map(([name, value]) => {
      const pair = document.createElement("div"), put = (tag, textContent) => Object.assign(document.createElement(tag), { textContent });
      pair.append(put("dt", name), put("dd", value));
      return pair;
    }));
    this.page.notes.textContent = results.notes.join(" ");
    this.#describe(results, time);
    this.page.drawn?.(this.results);
  }

  #facts({ state, pixel, draw, mean, estimate, truth }, incident) {
    const { period } = state, measuredCube = Boolean(pixel.counts), photons = incident.reduce((a, b) => a + b, 0);
    const facts = [["Arriving photons, mean", digits(photons, 5)], ["Registered, this exposure", draw.registered.toLocaleString("en")]];
    if (mean) {
      facts.push(["Registered, exact mean", `${digits(mean.cumulants[0], 6)} ± ${digits(Math.sqrt(mean.cumulants[1]), 3)}`]);
      if (mean.cumulants[0] > 0) facts.push(["Variance over mean", digits(mean.cumulants[1] / mean.cumulants[0], 3)], ["Photons lost", `${digits(Math.abs(+(100 * (1 - mean.cumulants[0] / photons)).toFixed(9)), 3)} %`]);
    }
    const known = truth.signal > 0, where = metres(truth.delay, period), range = metres(1, period);
    const off = (depth) => { // the shorter way round the range
      const away = turn((depth - where) / range + 0.5) * range - 0.5 * range;
      return known ? `, ${length(Math.abs(away))} ${away < 0 ? "short" : "long"}` : "";
    };
    if (known) facts.push([measuredCube ? "Depth of the settings" : "True depth", `${where.toFixed(3)} m`]);
    if (!estimate) return facts;
    const peak = metres(estimate.peak, period);
    facts.push(["Depth by the fullest bin", Number.isFinite(peak) ? `${peak.toFixed(2)} m${off(peak)}` : "no counts"]);
    const fit = estimate.likelihood, name = `Depth by maximum likelihood${truth.second > 0 ? " of one return" : ""}`;
    if (fit && Number.isFinite(fit.delay)) {
      const depth = metres(turn(fit.delay), period);
      facts.push([name, `${measured(depth, metres(fit.delayError, period))}${off(depth)}`],
        [`Its S and B${measuredCube ? "" : " (true)"}`, `${digits(fit.signal, 3)} and ${digits(fit.background, 3)}${measuredCube ? "" : ` (${digits(truth.signal, 3)} and ${digits(truth.background, 3)})`}`]);
    } else facts.push([name, fit ? "no signal detected" : "not for this detector"]);
    return facts;
  }

  /** The charts in words, for those who do not see them. */
  #describe({ draw, mean, law }, time) {
    const top = (values) => values.reduce((best, x, j) => (x > values[best] ? j : best), 0), at = top(draw.counts), crest = mean && top(mean.mean);
    this.page.histogram.setAttribute("aria-label", `Histogram of one exposure: ${draw.registered} registrations, the fullest bin at ${digits(time[at])} ns with ${draw.counts[at]} counts${mean ? `; its exact mean is highest at ${digits(time[crest])} ns with ${digits(mean.mean[crest])} counts` : ""}.`);
    const words = law ? `between ${law.first} and ${law.first + law.p.length - 1} counts, most likely ${law.first + top(law.p)}` : "not computed";
    this.page.law.setAttribute("aria-label", `Exact law of the number of registrations: ${words}; this exposure has ${draw.registered}.`);
  }
}
