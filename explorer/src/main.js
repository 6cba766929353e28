// The page: state, link, controls, figure and pictures together.
import { Controls } from "./controls.js";
import { Engine, Refusal, unpacked, widened } from "./engine.js";
import { picture, savePicture, saveTable, table } from "./export.js";
import { Figure } from "./figure.js";
import { INITIAL, SPEED_OF_LIGHT, detected, fromHash, inPeriods, problem, toHash } from "./model.js";
import { Picture } from "./pictures.js";
import { PRESETS } from "./presets.js";
import { snippet } from "./snippet.js";
import { CubeSource, SceneSource } from "./sources.js";
import { length } from "./units.js";
import colours from "./colours.json";

const at = (id) => document.getElementById(id);
const PICTURE_KEYS = ["signal", "background", "second", "gap", "dead", "sigma", "mode", "start", "cycles", "bins", "period", "gateStart", "gateWidth", "efficiency",
  "dark", "jitter", "afterpulses", "trapDelay", "twilight", "electronics", "seed", "method"];
const PAUSE_MS = 250; // after the last change, before all pixels are drawn again
const LINK_MS = 400; // after the last change, before the address has it: Safari throws at 100 changes in 30 s

async function begin() {
  const told = JSON.parse(at("cube").textContent);
  const networks = async () => ({ weights: widened(await unpacked(at("weights").textContent)), card: Float64Array.from(JSON.parse(at("card").textContent)) });
  const source = told ? new CubeSource(told) : new SceneSource(networks);
  const module = await WebAssembly.compile(await unpacked(at("native").textContent)), worker = at("worker").textContent;
  const page = { histogram: at("histogram"), law: at("law"), facts: at("facts"), notes: at("notes"), computing: at("computing") };
  const figureAlone = new URLSearchParams(location.search).has("figure"); // embedded in a page of its own prose
  document.body.classList.toggle("figure-alone", figureAlone);
  const figure = new Figure(page, new Engine(module, worker)), painter = new Engine(module, worker);
  const pixels = source.height * source.width;
  const base = told ? { ...INITIAL, ...source.settings } : INITIAL;
  const first = fromHash(location.hash, pixels, base, source.images);
  let state = first.state, painted = "", timer = 0, linkTimer = 0, lastPicture = {};
  at("changed").textContent = first.changed;

  const set = (changes, warning = "") => {
    const next = { ...state, ...changes };
    for (const key of ["delay", "gap"]) if (next[key] > next.period) next[key] = next.period;
    state = next;
    at("changed").textContent = warning;
    return refresh();
  };
  const address = () => {
    const hash = toHash(state, base);
    return hash ? `#${hash}` : location.pathname + location.search;
  };
  const linked = () => {
    clearTimeout(linkTimer);
    linkTimer = setTimeout(() => {
      try {
        history.replaceState(null, "", address());
      } catch { // a browser that counts: the next change tries again
      }
    }, LINK_MS);
  };
  // The state of a preset, with a place in the picture kept out: its sentence is about one pixel's figure.
  const presetState = ({ changes }) => ({ ...INITIAL, ...changes });
  const story = () => PRESETS.find((preset) => toHash(presetState(preset)) === toHash({ ...state, seed: INITIAL.seed }));

  const pick = async (row, column) => {
    const pixel = row * source.width + column;
    if (!told) return set({ pixel });
    try {
      const { light } = await source.read(pixel);
      return set({ pixel, ...(light ?? {}) });
    } catch (error) {
      at("problem").textContent = `The pixel could not be read: ${error.message}`;
    }
  };
  const pictures = [new Picture(at("depth"), colours.depth, pick), new Picture(at("counts"), colours.counts, pick)];
  const controls = new Controls(at("controls"), set);

  function refresh() {
    linked();
    const wrong = problem(state), pixel = source.pixel(state), active = told ? null : story();
    at("story").textContent = active?.sentence ?? "";
    for (const link of at("presets").querySelectorAll("a")) link.ariaCurrent = link.textContent === active?.name ? "true" : null;
    controls.show(state, [...source.fixed, ...(state.pixel >= 0 && !told ? ["delay"] : [])]);
    at("method").value = state.method;
    at("log").checked = state.log === 1;
    at("again").textContent = `Draw again (${state.seed})`;
    at("python").textContent = snippet(state, pixel, pixel.stored);
    at("which").textContent = whichPixel(pixel);
    at("free").hidden = told || state.pixel < 0;
    for (const picture of pictures) picture.select(state.pixel < 0 ? null : [Math.floor(state.pixel / source.width), state.pixel % source.width]);
    at("problem").textContent = wrong;
    if (wrong) return Promise.resolve();
    const key = told ? state.method + state.image : PICTURE_KEYS.map((name) => state[name]).join();
    if (key !== painted && !figureAlone) {
      painted = key;
      lastPicture = {}; // the picture that still stands is that of the state before
      clearTimeout(timer);
      painter.stop();
      timer = setTimeout(paint, PAUSE_MS);
    }
    return figure.want(state, pixel, told ? source.reason : "");
  }

  function whichPixel(pixel) {
    if (state.pixel < 0) return told ? "Click a pixel of the pictures." : "A pixel with the light of the sliders. Click the pictures for one of theirs.";
    const row = Math.floor(state.pixel / source.width), column = state.pixel % source.width;
    const number = (x) => Number(x.toPrecision(4));
    return `Pixel (${row}, ${column}) of the picture: S = ${number(pixel.signal)}, delay ${number(pixel.delayNs)} ns, depth ${number((pixel.delayNs * SPEED_OF_LIGHT) / 2)} m.`;
  }

  async function paint() {
    const mine = painted, current = state, range = (SPEED_OF_LIGHT / 2) * current.period;
    const found = lastPicture;
    const tell = (share) => { if (mine === painted) at("progress").textContent = share < 1 ? `${Math.round(100 * share)} %` : ""; };
    try {
      await source.picture(current, painter, tell, (some) => {
        if (mine !== painted) return;
        Object.assign(found, some);
        showPictures(found, current, range);
      });
      found.whole = true;
      at("progress").textContent = "";
    } catch (error) {
      if (mine !== painted) return;
      at("progress").textContent = error instanceof Refusal ? `No depth by this method here: ${error.message}. The picture is that of the peak.` : error.message;
      if (error instanceof Refusal) found.whole = true;
    }
  }

  function showPictures({ totals, delay, peak }, current, range) {
    const depths = (delays) => delays.map((periods) => range * (periods - Math.floor(periods))), depth = depths(delay);
    const scale = (values, low, high) => {
      const sorted = Float64Array.from(values).filter((x) => !Number.isNaN(x)).sort();
      return sorted.length ? [sorted[Math.floor(low * (sorted.length - 1))], sorted[Math.ceil(high * (sorted.length - 1))]] : [0, 1];
    };
    const metres = (x) => `${Number(x.toPrecision(3))} m`, whole = (x) => Math.round(x).toLocaleString("en");
    pictures[0].show(depth, source.height, source.width, scale(source.truth ? source.truth.map((z) => z % range) : depth, 0.01, 0.99), metres);
    pictures[1].show(totals, source.height, source.width, scale(totals, 0, 1), whole);
    if (!source.truth) return;
    const errors = (z) => z.map((x, p) => Math.abs(x - (source.truth[p] % range))).filter((x) => !Number.isNaN(x)).sort();
    const off = errors(depth), wide = (3 * SPEED_OF_LIGHT / 2) * current.sigma;
    const share = (of) => `${Number(((100 * of.filter((x) => x > wide).length) / of.length).toPrecision(2))} %`;
    const lost = depth.length - off.length;
    at("error").textContent = current.method === "truth" ? "" : off.length === 0 ? "No pixel has a depth." :
      `Median error of the depth ${length(off[Math.floor(off.length / 2)], 3)}, ${share(off)} off by more than 3 σ${
        current.method === "peak" ? "" : ` (by the fullest bin ${share(errors(depths(peak)))})`}${lost ? `, ${lost} pixels without` : ""}.`;
  }

  at("method").onchange = (event) => set({ method: event.target.value });
  at("log").onchange = (event) => set({ log: event.target.checked ? 1 : 0 });
  at("again").onclick = () => set({ seed: (state.seed + 1) % 2 ** 32 });
  at("again").hidden = Boolean(told);
  at("free").onclick = () => set({ pixel: -1 });
  at("reset").onclick = () => set({ ...base, ...(told ? { pixel: state.pixel, image: state.image } : {}) });
  const settings = () => `${toHash(state) || "as at first"}; Registered ${figure.results.draw.registered}`;
  const canvases = () => [...document.querySelectorAll(".chart canvas")];
  at("csv").onclick = () => saveTable(figure.results, settings());
  at("png").onclick = () => savePicture(canvases(), `mars-lidar explorer: ${settings()}`);
  at("presets").append(...(told ? [] : PRESETS.map((preset) => Object.assign(document.createElement("a"), { href: `#${toHash(presetState(preset))}`, textContent: preset.name,
    onclick: (event) => { // the state first: an address still to be written would replace the link's before it is read
      if (event.ctrlKey || event.metaKey || event.shiftKey) return; // a new tab
      event.preventDefault();
      clearTimeout(linkTimer);
      history.pushState(null, "", event.currentTarget.href);
      set(presetState(preset));
    } }))));
  const copied = (button, text) => async () => {
    await navigator.clipboard.writeText(text());
    const label = button.textContent;
    button.textContent = "Copied";
    setTimeout(() => { button.textContent = label; }, 1200);
  };
  at("copy").onclick = copied(at("copy"), () => at("python").textContent);
  at("link").onclick = copied(at("link"), () => new URL(address(), location.href).href);
  at("link").hidden = Boolean(told);
  at("image-number").hidden = source.images < 2;
  at("image").max = source.images - 1;
  at("image").value = source.image = state.image;
  at("image").onchange = async (event) => {
    const wanted = event.target.value === "" ? NaN : Number(event.target.value);
    const image = Number.isFinite(wanted) ? Math.min(Math.max(Math.round(wanted), 0), source.images - 1) : state.image;
    event.target.value = source.image = image;
    if (state.pixel >= 0) await source.read(state.pixel);
    set({ image }, image === wanted ? "" : `Images are numbered from 0 to ${source.images - 1}: it is ${image}.`);
  };
  at("check").onclick = async () => {
    const { cubes } = await figure.engine.ask("golden"), same = cubes.filter(({ found, expected }) => found === expected);
    at("golden").textContent = same.length === cubes.length
      ? `All ${cubes.length} golden cubes have the bits that the package's tests hold (${cubes[0].name}: SHA-256 ${cubes[0].found}).`
      : `${cubes.length - same.length} of ${cubes.length} golden cubes differ: please report this with your browser's name.`;
    return cubes;
  };
  addEventListener("hashchange", (event) => {
    if (told) return; // its address is written, and read when the page loads
    const answer = fromHash(new URL(event.newURL).hash, pixels);
    set(answer.state, answer.changed);
  });
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => figure.restyle());
  at("title-cube").textContent = told ? `${told.path}: ${told.height} x ${told.width} pixels` : "";

  // For tests, and for those who look behind the page.
  window.explorer = {
    set, pick, figure, painter, source, initial: INITIAL, presets: PRESETS, address, table: () => table(figure.results, settings()),
    png: () => picture(canvases(), settings()),
    counts: async (changes) => { // of the page's own pixel in some state, not shown
      const some = { ...INITIAL, ...changes }, light = detected(some, [some.signal], [some.delay], [0], some.second > 0 ? [some.second] : null);
      return (await painter.ask("draw", { system: inPeriods(some), light, seed: some.seed })).counts;
    }, get state() { return state; }, get picture() { return lastPicture; },
    golden: async () => (await figure.engine.ask("golden")).cubes, pictureCube: async () => (await painter.ask("cube")).cube,
  };
  at("loading").hidden = true;
  if (!told) return refresh();
  at("dots-name").textContent = "the stored exposure";
  if (!source.known) at("method").querySelector("[value=truth]").remove();
  if (state.pixel < 0) return pick(source.height >> 1, source.width >> 1);
  await source.read(state.pixel); // the light of the link is kept
  await refresh();
}

begin().catch((error) => {
  at("loading").textContent = `This browser cannot run the page: ${error.message}. It needs WebAssembly with SIMD and DecompressionStream (browsers of 2023 and later).`;
  console.error(error);
});
