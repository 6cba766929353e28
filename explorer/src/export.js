// What the figure shows, as a picture and as a table.

function save(blob, name) {
  const link = Object.assign(document.createElement("a"), { href: URL.createObjectURL(blob), download: name });
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 1000);
}

/** CSV of results of figure.js: a line a bin; the settings stand above as comments. */
export function table({ state, draw, mean, spread }, settings) {
  const cell = (values, j) => (values ? String(values[j]) : ""), width = state.period / state.bins;
  const lines = [`# mars-lidar explorer: ${settings}`, "time_ns,arriving_photons_mean,counts,exact_mean,standard_deviation"];
  for (let j = 0; j < state.bins; ++j)
    lines.push([(j + 0.5) * width, state.cycles * draw.incident[j], draw.counts[j], cell(mean?.mean, j), cell(spread, j)].join());
  return lines.join("\n") + "\n";
}

export const saveTable = (results, settings) => save(new Blob([table(results, settings)], { type: "text/csv" }), "mars-lidar.csv");

/** PNG of canvases side by side over `caption`, in the colours of the page. */
export async function picture(canvases, caption) {
  const style = getComputedStyle(document.body), gap = 16 * devicePixelRatio, line = 18 * devicePixelRatio;
  const sheet = document.createElement("canvas"), context = sheet.getContext("2d");
  sheet.width = canvases.reduce((sum, { width }) => sum + width + gap, gap);
  sheet.height = Math.max(...canvases.map(({ height }) => height)) + 2 * gap + line;
  context.fillStyle = style.backgroundColor;
  context.fillRect(0, 0, sheet.width, sheet.height);
  let x = gap;
  for (const canvas of canvases) {
    context.drawImage(canvas, x, gap);
    x += canvas.width + gap;
  }
  context.fillStyle = style.color;
  context.font = `${12 * devicePixelRatio}px system-ui, sans-serif`;
  context.fillText(caption, gap, sheet.height - gap, sheet.width - 2 * gap);
  return new Promise((done) => { sheet.toBlob(done, "image/png"); });
}

export const savePicture = async (canvases, caption) => save(await picture(canvases, caption), "mars-lidar.png");
