// Puts the page together, in one file that needs nothing else: node bundle.mjs MODULE.wasm NETWORKS PAGE.html
import { readFileSync, writeFileSync } from "node:fs";
import { gzipSync } from "node:zlib";
import { build } from "esbuild";

const here = (name) => new URL(name, import.meta.url).pathname;
const [module, networks, page] = process.argv.slice(2);

async function bundled(entry) {
  const { outputFiles } = await build({
    entryPoints: [here(`src/${entry}`)], bundle: true, minify: true, write: false, format: "iife", target: "es2022", charset: "utf8",
    legalComments: "none",
  });
  return outputFiles[0].text.replaceAll("</script", "<\\/script").replaceAll("<!--", "<\\!--");
}

const packed = (bytes) => gzipSync(bytes, { level: 9 }).toString("base64");
const card = JSON.parse(readFileSync(`${networks}/image_card.json`, "utf8")), { signal, sbr, cells, side } = card.holds_for;
const stored = readFileSync(`${networks}/image_weights.npy`); // float16, after a header whose length its bytes 8 and 9 hold

const parts = {
  STYLE: readFileSync(here("node_modules/uplot/dist/uPlot.min.css"), "utf8") + readFileSync(here("src/style.css"), "utf8"),
  NATIVE: packed(readFileSync(module)),
  WEIGHTS: packed(stored.subarray(10 + stored.readUInt16LE(8))),
  CARD: JSON.stringify([card.interval_factor, card.interval_exponent, ...signal, ...sbr, ...cells, ...side]),
  WORKER: await bundled("worker.js"),
  MAIN: await bundled("main.js"),
};
const html = readFileSync(here("src/template.html"), "utf8").replace(/%([A-Z]+)%/g, (_, name) => parts[name]);
writeFileSync(page, html);
console.log(`${page}: ${html.length} characters`);
