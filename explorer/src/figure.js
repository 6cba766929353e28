// One pixel's figure: its stages are computed one after the other, the newest state first, and drawn as they come.
import { HistogramChart, LawChart } from "./charts.js";
import { Refusal } from "./engine.js";
import { SPEED_OF_LIGHT, detected, inPeriods, lawless } from "./model.js";

const LATER = ["mean", "law", "estimate", "band"]; // after "draw"
const LATE_MS = 60;

const digits = (x, n = 4) => (Number.isFinite(x) ? Number(x.toPrecision(n)).toLocaleString("en") : "none");
const metres = (periods, period) => (SPEED_OF_LIGHT / 2) * period * periods;

export class Figure {
  constructor(page, engine) {
    this.page = page; // elements by name
    this.engine = engine;
    this.histogram = new HistogramChart(page.histogram, () => (innerWidth < 760 ? 230 : 340));
    this.count = new LawChart(page.law, () => (innerWidth < 760 ? 210 : 340));
    this.busy = false;
    this.wanted = null;
    this.settled = Promise.resolve();
    this.results = {};
  }

  /** Draws a state, with the pixel that it means; what is computed for an older one is left. */
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
        const light = detected(state, [pixel.signal], [pixel.delayNs], [pixel.index]);
        const system = inPeriods(state), results = { state, notes: [] };
        results.draw = await this.engine.ask("draw", { system, light, seed: state.seed, counts: pixel.counts });
        const without = lawless(state);
        const why = reason || (without.length ? `There is no exact law here with ${without.join(" and ")}: the dots are simulated all the same.` : "");
        if (why) results.notes.push(why);
        results.lawless = Boolean(why);
        const late = setTimeout(() => this.#show(results), LATE_MS); // the dots do not wait for a slow mean
        for (const stage of why ? ["estimate"] : LATER) {
          await this.#stage(stage, results);
          clearTimeout(late);
          if (this.wanted) break;
        }
        results.whole = !this.wanted;
        this.#show(results);
      }
    } catch (error) {
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
      results.notes.push(`${error.message[0].toUpperCase()}${error.message.slice(1)}${stage === "band" ? ": the band is Poisson's, two roots of the mean." : "."}`);
      if (stage === "band") results.band = { variances: null };
      if (stage === "law") results.lawless = true;
    }
    this.#show(results);
  }

  #show(results) {
    const { state, draw, mean, law, estimate, band, notes } = results, { period } = state;
    const time = Array.from(draw.counts, (_, j) => ((j + 0.5) * period) / state.bins);
    const spread = mean && band ? (band.variances ?? mean.mean).map(Math.sqrt) : null;
    this.histogram.show({ time, incident: draw.incident, mean: mean?.mean, spread, counts: draw.counts }, state.log === 1);
    if (law || results.lawless) this.count.show(law ?? null, draw.registered); // until then the last one stays
    this.results = { ...results, spread };
    const photons = state.cycles * draw.incident.reduce((a, b) => a + b, 0);
    const facts = [["Arriving photons, mean", digits(photons, 5)], ["Registered, this exposure", draw.registered.toLocaleString("en")]];
    if (mean) facts.push(["Registered, exact mean", `${digits(mean.cumulants[0], 6)} ± ${digits(Math.sqrt(mean.cumulants[1]), 3)}`], ["Variance over mean", digits(mean.cumulants[1] / mean.cumulants[0], 3)]);
    if (estimate) {
      facts.push(["Depth by the peak", `${digits(metres(estimate.peak, period))} m`]);
      const found = estimate.likelihood;
      if (found && Number.isFinite(found.delay)) {
        const turned = found.delay - Math.floor(found.delay);
        facts.push(["Depth by maximum likelihood", `${digits(metres(turned, period))} ± ${digits(metres(found.delayError, period), 2)} m`],
          ["Its S and B", `${digits(found.signal, 3)} and ${digits(found.background, 3)}`]);
      } else facts.push(["Depth by maximum likelihood", found ? "no signal seen" : "not for this detector"]);
    }
    this.page.facts.replaceChildren(...facts.map(([name, value]) => {
      const pair = document.createElement("div"), put = (tag, textContent) => Object.assign(document.createElement(tag), { textContent });
      pair.append(put("dt", name), put("dd", value));
      return pair;
    }));
    this.page.notes.textContent = notes.join(" ");
    this.page.drawn?.(this.results);
  }
}
