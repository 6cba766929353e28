// Numbers as text: digits that their error allows, lengths in units that fit.

export const digits = (x, n = 4) => (Number.isFinite(x) ? Number(x.toPrecision(n)).toLocaleString("en", { maximumSignificantDigits: n }) : "none");

const UNITS = [[1, "m"], [1e-2, "cm"], [1e-3, "mm"], [1e-6, "µm"]];

/** A length in the largest unit in which it is at least 1, with `n` digits: "12.3 cm". */
export function length(metres, n = 2) {
  if (metres === 0) return "0 m";
  const [size, unit] = UNITS.find(([least]) => Math.abs(metres) >= least) ?? UNITS[UNITS.length - 1];
  return `${Number((metres / size).toPrecision(n)).toLocaleString("en")} ${unit}`;
}

/** A length to a tenth of its standard error, and that error: "8.99413 m ± 0.12 mm". */
export function measured(metres, error) {
  if (!(error > 0) || !Number.isFinite(error)) return `${metres.toFixed(3)} m`;
  const places = Math.min(Math.max(1 - Math.floor(Math.log10(error)), 0), 8);
  return `${metres.toFixed(places)} m ± ${length(error)}`;
}
