// The Python that makes the page's figure: same light, same system, same seed, and so the same dots.
import { lawless } from "./model.js";

const num = (x) => (Number.isInteger(x) && Math.abs(x) < 1e15 ? `${x}.0` : String(x).replace("e+", "e"));

function detector(state) {
  const told = [`dead_time_ns=${num(state.dead)}`];
  if (state.mode !== "nonparalyzable") told.push(`mode="${state.mode}"`);
  if (state.mode === "gated") told.push(`gate_start_ns=${num(state.gateStart)}`, `gate_width_ns=${num(state.gateWidth)}`);
  if (state.efficiency !== 1) told.push(`detection_efficiency=${num(state.efficiency)}`);
  if (state.dark > 0) told.push(`dark_count_hz=${num(state.dark)}`);
  if (state.afterpulses > 0) told.push(`afterpulsing=ml.Afterpulsing(probability=${num(state.afterpulses)}, delay_ns=${num(state.trapDelay)})`);
  if (state.twilight > 0 && state.mode === "nonparalyzable") told.push(`twilight_ns=${num(state.twilight)}`);
  if (state.electronics > 0) told.push(`electronics_dead_time_ns=${num(state.electronics)}`);
  if (state.jitter > 0) told.push(`jitter=ml.Jitter(sigma_ns=${num(state.jitter)})`);
  return told.join(",\n        ");
}

/** Python for a state and its pixel (signal, background, delayNs, index), with the dots of a stored cube if `stored`. */
export function snippet(state, pixel, stored) {
  const exact = lawless(state).length === 0, two = pixel.second > 0, poisson = state.dead === 0 && state.mode !== "synchronous";
  const joint = exact && state.mode === "nonparalyzable" && !poisson;
  const names = ["photons_per_bin", ...(exact ? ["count_law", "mean_histogram"] : []), ...(joint ? ["joint_law"] : [])].sort();
  const lines = [
    "import matplotlib.pyplot as plt", "import numpy as np", "", "import mars_lidar as ml",
    `from mars_lidar.statistics import ${names.join(", ")}`, "",
    "system = ml.System(", `    period_ns=${num(state.period)},`, `    cycles=${state.cycles},`, `    bins=${state.bins},`,
    `    pulse=ml.GaussianPulse(sigma_ns=${num(state.sigma)}),`, `    detector=ml.Detector(\n        ${detector(state)}\n    ),`,
    ...(state.start === "armed" ? [] : [`    start="${state.start}",`]), ")",
    `flux = ml.Flux(signal=${num(pixel.signal)}, background=${num(pixel.background)}, delay_ns=${num(pixel.delayNs)})`,
    ...(two ? [`flux = ml.Flux.multi(flux, ml.Flux(signal=${num(pixel.second)}, delay_ns=${num(pixel.delayNs)} + ${num(state.gap)}))`] : []),
  ];
  if (stored) {
    lines.push(`drawn = np.asarray(ml.io.load(${JSON.stringify(stored.path)}).histogram[${stored.image}, ${stored.row}, ${stored.column}])`);
  } else {
    lines.push(`drawn = ml.simulate(flux, system, seed=${state.seed}, pixel_index=[${pixel.index}])[0, 0, 0]`);
  }
  lines.push("incident = photons_per_bin(flux, system, bins=system.bins)");
  if (exact) lines.push("mean = mean_histogram(flux, system)", "law = count_law(flux, system)");
  if (joint) lines.push("spread = np.sqrt(joint_law(flux, system).variance)");
  else if (exact && poisson) lines.push("spread = np.sqrt(mean)  # no dead time: counts are Poisson's");
  lines.push("", 'figure, (left, right) = plt.subplots(1, 2, figsize=(12, 4), layout="constrained", width_ratios=(2, 1))',
    'left.fill_between(system.time_ns, system.cycles * incident, step="mid", color="0.85", label="photons that arrive")',
    'left.plot(system.time_ns, drawn, ".", label="one exposure")');
  if (exact) {
    lines.push('left.plot(system.time_ns, mean, label="exact mean")');
    if (joint || poisson) lines.push('left.fill_between(system.time_ns, mean - 2 * spread, mean + 2 * spread, alpha=0.3, label="two standard deviations")');
    lines.push("right.bar(law.support, law.pmf, width=1.0)");
  }
  if (state.log === 1) lines.push('left.set_yscale("symlog", linthresh=1.0)  # linear below 1, so that zeros are there');
  lines.push('left.set(xlabel="time (ns)", ylabel="counts")', "left.legend()",
    'right.axvline(drawn.sum(), color="k")', 'right.set(xlabel="registrations N", ylabel="probability")', "plt.show()");
  return lines.join("\n") + "\n";
}
