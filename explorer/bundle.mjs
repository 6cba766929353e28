// Puts the page together, in one file that needs nothing else: node bundle.mjs MODULE.wasm PAGE.html
import { readFileSync, writeFileSync } from "node:fs";
import { gzipSync } from "node:zlib";
import { build } from "esbuild";

const here = (name) => new URL(name, import.meta.url).pathname;
const [module, page] = process.argv.slice(2);

async function bundled(entry) {
  const { outputFiles } = await build({
    entryPoints: [here(`src/${entry}`)], bundle: true, minify: true, write: false, format: "iife", target: "es2022", charset: "utf8",
    legalComments: "none",
  });
  return outputFiles[0].text.replaceAll("</script", "<\\/script").replaceAll("<!--", "<\\!--");
}

const parts = {
  STYLE: readFileSync(here("node_modules/uplot/dist/uPlot.min.css"), "utf8") + readFileSync(here("src/style.css"), "utf8"),
  NATIVE: gzipSync(readFileSync(module), { level: 9 }).toString("base64"),
  WORKER: await bundled("worker.js"),
  MAIN: await bundled("main.js"),
};
const html = readFileSync(here("src/template.html"), "utf8").replace(/%([A-Z]+)%/g, (_, name) => parts[name]);
writeFileSync(page, html);
console.log(`${page}: ${html.length} characters`);
