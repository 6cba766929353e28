// The two charts: the histogram of one exposure before its exact law, and the law of the count.
import uPlot from "uplot";

const css = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
const FONT = "12px system-ui, sans-serif";

const axis = (label, more = {}) => ({
  label, labelFont: FONT, font: FONT, labelSize: 20, stroke: css("--text"), grid: { stroke: css("--grid"), width: 1 },
  ticks: { stroke: css("--grid"), width: 1 }, ...more,
});

const short = (value) => {
  if (value === 0) return "0";
  const size = Math.abs(value);
  return size >= 1e5 || size < 1e-3 ? value.toExponential(0).replace("e+", "e") : String(Number(value.toPrecision(4)));
};
const shortAll = (_, values) => values.map((value) => (value === null ? "" : short(value)));

class Chart {
  constructor(element, height) {
    this.element = element;
    this.height = height;
    this.data = null;
    new ResizeObserver(() => this.resize()).observe(element);
  }

  get size() {
    return { width: Math.max(200, this.element.clientWidth), height: this.height() };
  }

  resize() {
    const { width, height } = this.size;
    if (this.plot && (this.plot.width !== width || this.plot.height !== height)) this.plot.setSize({ width, height });
  }

  /** Anew: for other colours, or another scale. */
  reset() {
    this.plot?.destroy();
    this.plot = null;
    if (this.data) this.draw();
  }

  draw() {
    if (this.plot) this.plot.setData(this.data);
    else this.plot = new uPlot({ ...this.options(), ...this.size, legend: { show: false } }, this.data, this.element);
  }
}

const LOWEST = 0.2, ZERO = 0.25; // of a logarithmic axis of counts: its lower end, and where counts of 0 are drawn, as rings

export class HistogramChart extends Chart {
  logarithmic = false;

  options() {
    const positive = (u, low, high) => [0, Math.max(high, 1) * 1.05];
    const logRange = (u, low, high) => [LOWEST, Math.max(high, 10) * 1.5];
    const tick = (_, values) => values.map((value) => (value === null || value < 0.99 ? "" : short(value)));
    return {
      cursor: { drag: { x: true, y: false }, points: { show: false } },
      scales: {
        x: { time: false }, counts: this.logarithmic ? { distr: 3, range: logRange } : { range: positive },
      },
      axes: [
        axis("time in the period (ns)", { space: 40 }), axis("photons or counts per bin", { scale: "counts", values: this.logarithmic ? tick : shortAll, size: 56 }),
      ],
      series: [
        {},
        { scale: "counts", stroke: css("--light-line"), fill: css("--light"), fillTo: this.logarithmic ? LOWEST : 0, width: 1, points: { show: false } },
        { scale: "counts", stroke: css("--band-line"), width: 1, points: { show: false } },
        { scale: "counts", stroke: css("--band-line"), width: 1, points: { show: false } },
        { scale: "counts", stroke: css("--mean"), width: 2, points: { show: false } },
        { scale: "counts", stroke: css("--dots"), paths: () => null, points: { show: true, size: 4, width: 0, fill: css("--dots") } },
        { scale: "counts", stroke: css("--dots"), paths: () => null, points: { show: true, size: 5, width: 1, fill: css("--card") } },
      ],
      bands: [{ series: [3, 2], fill: css("--band") }],
    };
  }

  /** Arrays of the bins, or null where there is nothing yet; `spread`: one standard deviation. */
  show({ time, incident, mean, spread, counts }, logarithmic) {
    const none = new Array(time.length).fill(null), least = logarithmic ? LOWEST : 0;
    const band = (sign) => (mean && spread ? mean.map((m, j) => Math.max(m + sign * 2 * spread[j], least)) : none);
    const line = (a) => (logarithmic ? a.map((x) => Math.max(x, LOWEST)) : a), dots = Array.from(counts);
    const zeros = logarithmic ? dots.map((x) => (x > 0 ? null : ZERO)) : none; // where a logarithmic axis has no place for them
    this.data = [time, line(incident), band(-1), band(1), mean ? line(Array.from(mean)) : none, logarithmic ? dots.map((x) => (x > 0 ? x : null)) : dots, zeros];
    if (logarithmic !== this.logarithmic) {
      this.logarithmic = logarithmic;
      this.reset();
    } else this.draw();
  }
}

export class LawChart extends Chart {
  options() {
    const mark = (u) => {
      if (this.registered === null) return;
      const x = Math.round(u.valToPos(this.registered, "x", true));
      const { left, top, width, height } = u.bbox;
      if (x < left || x > left + width) return;
      u.ctx.save();
      u.ctx.strokeStyle = css("--dots");
      u.ctx.lineWidth = 2 * devicePixelRatio;
      u.ctx.beginPath();
      u.ctx.moveTo(x, top);
      u.ctx.lineTo(x, top + height);
      u.ctx.stroke();
      u.ctx.restore();
    };
    const range = (u, low, high) => [Math.min(low, this.registered ?? low) - 1, Math.max(high, this.registered ?? high) + 1];
    return {
      cursor: { drag: { x: true, y: false }, points: { show: false } },
      scales: { x: { time: false, range }, y: { range: (u, low, high) => [0, Math.max(high, 1e-9) * 1.05] } },
      axes: [axis("registrations N of an exposure", { space: 60 }), axis("probability", { values: shortAll, size: 56 })],
      series: [{}, { fill: css("--law"), width: 0, paths: uPlot.paths.bars({ size: [1, 100] }), points: { show: false } }],
      hooks: { draw: [mark] },
    };
  }

  /** The law { first, p }, or null, and the number that was registered. */
  show(law, registered) {
    this.registered = registered;
    let low = 0, high = law ? law.p.length - 1 : 0;
    if (law) { // tails below 1e-9 of the peak are nothing to be seen
      const least = 1e-7 * law.p.reduce((a, b) => Math.max(a, b), 0);
      while (low < high && law.p[low] < least) ++low;
      while (high > low && law.p[high] < least) --high;
    }
    const counts = law ? Array.from({ length: high - low + 1 }, (_, k) => law.first + low + k) : [registered];
    this.data = [counts, law ? Array.from(law.p.subarray(low, high + 1)) : [null]];
    this.draw();
  }
}
