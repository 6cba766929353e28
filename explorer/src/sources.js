// Where pixels come from: the picture that the page carries, drawn here, or a cube that `mars-lidar explore` serves.
import { SPEED_OF_LIGHT, detected, inPeriods } from "./model.js";
import scene from "./scene.json";

const NS_PER_M = 2 / SPEED_OF_LIGHT;

const wordsOf = (text) => {
  const bytes = Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
  return new Uint16Array(bytes.buffer);
};

/** The picture of the page: its depth, and its light relative to the mean. */
export class SceneSource {
  fixed = [];
  images = 1;

  /** `networks` unpacks those of the image method, which only that method needs. */
  constructor(networks) {
    this.networks = networks;
    this.height = scene.height;
    this.width = scene.width;
    this.depth = Float64Array.from(wordsOf(scene.depth_mm), (mm) => mm / 1000);
    this.light = Float64Array.from(wordsOf(scene.light), (light) => light / 4096);
  }

  /** Light of a pixel, or of the page's own where `state.pixel` is -1. */
  pixel(state) {
    const { pixel } = state;
    if (pixel < 0) return { signal: state.signal, second: state.second, background: state.background, delayNs: state.delay, index: 0 };
    const share = this.light[pixel];
    return { signal: state.signal * share, second: state.second * share, background: state.background, delayNs: NS_PER_M * this.depth[pixel], index: pixel };
  }

  /** Counts and delays (periods) of all pixels, by parts to `show`. */
  async picture(state, engine, tell, show) {
    const delays = this.depth.map((depth) => NS_PER_M * depth), pixels = Array.from(delays, (_, p) => p);
    const second = state.second > 0 ? this.light.map((x) => state.second * x) : null;
    const light = detected(state, this.light.map((x) => state.signal * x), delays, pixels, second);
    const found = await engine.ask("picture", { system: inPeriods(state), light, seed: state.seed }, tell);
    show({ totals: found.totals, delay: found.delay, peak: found.delay });
    if (state.method === "likelihood") show(await engine.ask("likelihood", {}, tell));
    if (state.method === "image") show(await engine.ask("image", { height: this.height, width: this.width, networks: await this.networks() }, tell));
    if (state.method === "truth") show({ delay: light.delay });
  }

  /** Depths that are true, modulo the range. */
  get truth() {
    return this.depth;
  }
}

/** A stored cube, read from the server pixel by pixel and some rows at a time. */
export class CubeSource {
  constructor(told) {
    Object.assign(this, told); // path, api, height, width, images, settings, reason, known
    this.fixed = ["period", "bins", "cycles"];
    this.image = 0;
    this.truth = null;
    this.shown = null;
  }

  async #get(what) {
    const answer = await fetch(`${this.api}/${what}`);
    if (!answer.ok) throw new Error(await answer.text());
    return answer;
  }

  /** Counts of a pixel, and its light where the file tells it; kept as the one that is shown. */
  async read(pixel) {
    const row = Math.floor(pixel / this.width), column = pixel % this.width;
    const told = await (await this.#get(`pixel?image=${this.image}&row=${row}&column=${column}`)).json();
    this.shown = { pixel, counts: Uint32Array.from(told.counts), light: told.light };
    return this.shown;
  }

  pixel(state) {
    const stored = this.shown && { path: this.path, image: this.image, row: Math.floor(this.shown.pixel / this.width), column: this.shown.pixel % this.width };
    return { signal: state.signal, second: state.second, background: state.background, delayNs: state.delay, index: 0, stored, counts: this.shown?.counts };
  }

  async picture(state, engine, tell, show) {
    const pixels = this.height * this.width, totals = new Float64Array(pixels).fill(NaN), delay = new Float64Array(pixels).fill(NaN);
    const step = Math.max(1, Math.ceil(4096 / this.width));
    for (let first = 0; first < this.height; first += step) {
      const rows = Math.min(step, this.height - first);
      const answer = await this.#get(`rows?image=${this.image}&first=${first}&rows=${rows}&method=${state.method}`);
      const values = new Float64Array(await answer.arrayBuffer()), some = rows * this.width;
      totals.set(values.subarray(0, some), first * this.width);
      delay.set(values.subarray(some).map((ns) => ns / state.period), first * this.width);
      tell((first + rows) / this.height);
      show({ totals, delay });
    }
  }
}
