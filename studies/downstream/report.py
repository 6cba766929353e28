"""The report of the downstream experiment: the paper's table beside ours, the gaps with their spread, pictures."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from studies.downstream.counts import QUARTERS
from studies.downstream.data import SYSTEM, WORDS, Config, crop
from studies.downstream.run import SHOWN, TARGETS, Run, by_arm
from studies.machine import machine
from studies.report import Row, configuration, save_csv, save_figure, save_text, table

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PAPER = {  # T5 of arXiv 2512.04924: by ratio and arm, own then gold; reflectivity PSNR in dB, depth RMSE in m
    (0.6, "poisson"): ((36.49, 0.072), (7.02, 1.654)),
    (0.6, "renewal"): ((29.72, 0.054), (12.12, 0.096)),
    (0.6, "neural"): ((22.74, 0.053), (22.54, 0.082)),
    (0.6, "nearest"): ((24.03, 0.053), (24.25, 0.074)),
    (1.0, "poisson"): ((33.68, 0.061), (7.25, 0.785)),
    (1.0, "renewal"): ((30.97, 0.051), (11.70, 0.097)),
    (1.0, "neural"): ((21.95, 0.051), (22.21, 0.119)),
    (1.0, "nearest"): ((24.28, 0.055), (23.58, 0.095)),
}
_SHORT = {"poisson": "Poisson", "nearest": "MaRS, nearest", "mars": "MaRS"}
_CLAIM_DB, _CLAIM_TIMES = 10.0, 5.0  # by which the mars-trained network is to beat the Poisson-trained one


def write(
    out: Path, folder: Path, config: Config, found: Mapping[Run, Any], counts: Mapping[str, Mapping[str, list[float]]]
) -> list[Path]:
    """downstream.md, downstream.csv and a figure for each ratio; the `found` results are complete."""
    pictures = [
        save_figure(out / f"downstream_sbr{sbr:g}.png", picture(folder, config, found, sbr)) for sbr in config.sbr
    ]
    text = save_text(out / "downstream.md", _text(config, found, counts, pictures))
    return [text, save_csv(out / "downstream.csv", [_csv_row(one, result) for one, result in found.items()]), *pictures]


def _text(
    config: Config, found: Mapping[Run, Any], counts: Mapping[str, Mapping[str, list[float]]], pictures: list[Path]
) -> list[str]:
    seconds = sum(result["training"]["seconds"] for result in found.values())
    stopped = sum(bool(result["training"]["stopped"]) for result in found.values())
    return [
        "# Networks trained on every simulator's data (T5)",
        "_A tiny configuration, for tests: not for citing._" if config.name == "tiny" else "",
        "One U-Net architecture, trained separately for depth and reflectivity on the data of each simulator, and "
        f"tested on that simulator's own data and on the gold standard, engine `{config.gold}`. Train, validation and "
        "test scenes are disjoint.",
        "## Configuration",
        configuration(
            {
                "command": f"`python -m studies downstream --config {config.name} --out DIR`",
                "system": f"t_r = {SYSTEM.period_ns:.6g} ns, N_r = {SYSTEM.cycles}, {SYSTEM.bins} bins, Gaussian pulse "
                f"of sigma = 0.5 ns, t_d = {SYSTEM.detector.dead_time_ns:g} ns, armed start",
                "flux": f"S = {config.photons:g} x reflectivity photons per period; B uniform, by the ratio of the "
                f"means",
                "scenes": f"{config.train[1]} to train, {config.validation[1]} to validate, {config.test[1]} to test: "
                f"crops of {config.size} x {config.size} of rooms of {config.render} x {config.render}, depths scaled "
                f"by {config.depth_scale[0]:g} to {config.depth_scale[1]:g}; one exposure of each; flips as "
                f"augmentation",
                "input": f"all {SYSTEM.bins} bins; sqrt(counts / {config.plan(0).scale:g}) for every pixel and "
                f"simulator",
                "network": f"`CubeUNet`, stem {config.stem}, levels {config.widths}, {config.blocks} block(s) a level",
                "training": f"L1, AdamW, at most {config.steps} steps of {config.batch}; stops after {config.patience} "
                f"validations, {config.every} steps each, without improvement ({stopped} of {len(found)} did so); the "
                "best validation's weights are tested",
                "PSNR": f"range 1 for reflectivity, {config.depth_range_m:g} m for depth",
                "tables": f"{config.table[0]} x {config.table[1]} points on [0.01, 10] photons per period",
                "machine": machine(),
                "training time": f"{seconds / 60:.0f} minutes in all",
            }
        ),
        "## Result",
        "Reflectivity PSNR (dB) / depth RMSE (m), mean over the seeds, with the standard deviation between seeds where "
        "there are several.",
        table(_rows(found)),
        "The paper's second pair of columns at SBR 1.0 is labelled depth PSNR and depth RMSE in one summary of it; it "
        "is read here as the first pair is.",
        *_findings(found),
        "### Why: the counts that a network meets",
        "Mean count of a pixel on the test scenes over that of the gold standard, less 1, in %, by quarters of the "
        "pixels in reflectivity; last, what a single count scatters by.",
        table(_count_rows(counts)),
        "### All measures",
        table(_all(found)),
        *_measured(found),
        "## Pictures",
        *[f"![Reconstructions]({path.name})" for path in pictures],
        "The first test scene, seed 0 of each simulator.",
    ]


def _values(results: list[Any], data: str, measure: str) -> list[float]:
    return [result[data][measure] for result in results]


def spread(values: list[float], digits: int) -> str:
    """Mean, and the standard deviation between seeds where there are several."""
    mean = f"{np.mean(values):.{digits}f}"
    return mean if len(values) < 2 else f"{mean} ± {np.std(values, ddof=1):.{digits}f}"


def _rows(found: Mapping[Run, Any]) -> list[Row]:
    rows: list[Row] = []
    for arm, sbr, results in by_arm(found):
        row: dict[str, Any] = {"SBR": f"{sbr:g}", "trained on": WORDS[arm], "seeds": len(results["depth"])}
        for k, data in enumerate(("own", "gold")):
            row[data] = " / ".join(
                spread(_values(results[target], data, measure), digits)
                for target, measure, digits in (("reflectivity", "psnr", 2), ("depth", "rmse", 3))
            )
            paper = PAPER.get((sbr, arm))
            row[f"{data}, paper"] = "-" if paper is None else f"{paper[k][0]:.2f} / {paper[k][1]:.3f}"
        rows.append(row)
    return rows


def _findings(found: Mapping[Run, Any]) -> list[str]:
    lines = []
    for sbr in dict.fromkeys(one.sbr for one in found):
        arms = {arm: results for arm, ratio, results in by_arm(found) if ratio == sbr}

        def gold(arm: str, target: str, arms: dict[str, Any] = arms) -> list[float]:
            return _values(arms[arm][target], "gold", "rmse" if target == "depth" else "psnr")

        def better(one: str, other: str, target: str) -> float:
            return float(np.mean(gold(one, target)) - np.mean(gold(other, target)))

        if {"mars", "poisson"} <= set(arms):
            gain = better("mars", "poisson", "reflectivity")
            times = float(np.mean(gold("poisson", "depth")) / np.mean(gold("mars", "depth")))
            lines.append(
                f"- SBR {sbr:g}: on gold-standard data the network trained on MaRS beats the one trained on Poisson by "
                f"{gain:.1f} dB in reflectivity ({'at least' if gain >= _CLAIM_DB else '**less than**'} "
                f"{_CLAIM_DB:g}) and {times:.1f} times in depth RMSE "
                f"({'at least' if times >= _CLAIM_TIMES else '**less than**'} {_CLAIM_TIMES:g})."
            )
        if "mars" in arms:
            for target, measure, unit, digits in (("reflectivity", "psnr", "dB", 2), ("depth", "rmse", "m", 4)):
                gaps = [r["gold"][measure] - r["own"][measure] for r in arms["mars"][target]]
                line = f"- SBR {sbr:g}, {target}: gold less own of the network trained on MaRS "
                line += f"{spread(gaps, digits)} {unit}"
                if "exact" in arms:
                    pairs = zip(gold("exact", target), gold("mars", target), strict=False)
                    line += f"; exact less MaRS, on gold {spread([a - b for a, b in pairs], digits)} {unit}"
                lines.append(line + ".")
        if {"mars", "nearest"} <= set(arms):
            lines.append(
                f"- SBR {sbr:g}: the nearest grid point and the paper's count law cost "
                f"{better('mars', 'nearest', 'reflectivity'):.2f} dB and {better('nearest', 'mars', 'depth'):.4f} m."
            )
    return ["\n".join(lines)]


def _count_rows(counts: Mapping[str, Mapping[str, list[float]]]) -> list[Row]:
    words = {**WORDS, "scatter": "_gold standard's own scatter_"}
    return [
        {"SBR": sbr, "simulator": words[name]}
        | {
            quarter: f"{100 * value:.2f}" if name == "scatter" else f"{100 * value:+.2f}"
            for quarter, value in zip(QUARTERS, row, strict=True)
        }
        for sbr, rows in counts.items()
        for name, row in rows.items()
    ]


def _all(found: Mapping[Run, Any]) -> list[Row]:
    rows: list[Row] = []
    for arm, sbr, results in by_arm(found):
        for target in TARGETS:
            row: dict[str, Any] = {"SBR": f"{sbr:g}", "trained on": WORDS[arm], "target": target}
            for data in ("own", "gold"):
                for measure, digits in (("psnr", 2), ("ssim", 3), ("rmse", 4)):
                    row[f"{measure.upper()}, {data}"] = spread(_values(results[target], data, measure), digits)
            rows.append(row)
    return rows


def _measured(found: Mapping[Run, Any]) -> list[str]:
    if not any("measured" in result for result in found.values()):
        return []
    rows: list[Row] = []
    for arm, sbr, results in by_arm(found):
        for name in results["depth"][0].get("measured", {}):
            pair = [
                spread([r["measured"][name][measure] for r in results[target]], digits)
                for target, measure, digits in (("reflectivity", "psnr", 2), ("depth", "rmse", 3))
            ]
            rows.append(
                {"SBR": f"{sbr:g}", "trained on": WORDS[arm], "scene": name, "PSNR, dB": pair[0], "RMSE, m": pair[1]}
            )
    return [
        "### Measured scenes, gold-standard data",
        "Depth and image of a kind that no network was trained on.",
        table(rows),
    ]


def _csv_row(one: Run, result: Any) -> Row:
    row: dict[str, Any] = {"arm": one.arm, "sbr": one.sbr, "target": one.target, "seed": one.seed}
    row |= {f"{data}_{measure}": v for data in ("own", "gold") for measure, v in result[data].items()}
    row |= result["training"]
    return row


def picture(folder: Path, config: Config, found: Mapping[Run, Any], sbr: float) -> Figure:
    """The first test scene: truth, and every arm on its own and on gold-standard data, reflectivity and depth."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    from mars_lidar.plot.style import style

    scene = crop(config.test[0], config)
    arms = list(config.arms)
    with style():
        figure = Figure(figsize=(1.05 * (len(arms) + 1), 4.7), dpi=90, layout="constrained")
        FigureCanvasAgg(figure)
        axes = figure.subplots(4, len(arms) + 1, squeeze=False)
        for half, target in enumerate(TARGETS):
            true = scene.depth_m if target == "depth" else scene.reflectivity
            limits: dict[str, Any] = {"vmin": float(np.nanmin(true)), "vmax": float(np.nanmax(true))}
            limits["cmap"] = "viridis" if target == "depth" else "gray"
            scale = config.depth_range_m if target == "depth" else 1.0
            axes[2 * half, 0].imshow(true, **limits)
            axes[2 * half, 0].set_title(f"{target}, true")
            axes[2 * half + 1, 0].axis("off")
            for k, arm in enumerate(arms, 1):
                one = Run(arm, sbr, target, config.arms[arm][0])
                with np.load(folder / one.name / SHOWN) as shown:
                    for row, data in enumerate(("own", "gold")):
                        ax = axes[2 * half + row, k]
                        ax.imshow(shown[data] * scale, **limits)
                        error = found[one][data]
                        told = f"{error['rmse']:.3f} m" if target == "depth" else f"{error['psnr']:.1f} dB"
                        ax.set_title(f"{_SHORT.get(arm, arm)}\n{data}: {told}" if row == 0 else f"{data}: {told}")
        for ax in axes.flat:
            ax.set(xticks=[], yticks=[])
        figure.suptitle(f"SBR {sbr:g}; figures under the names: over all test scenes", fontsize=8)
    return figure
