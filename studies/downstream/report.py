"""The report of the downstream experiment: the paper's table beside ours, the gaps with their spread, pictures."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from studies import Facts
from studies.common.kept import spread
from studies.common.report import Row
from studies.downstream import run
from studies.downstream.budget import arithmetic
from studies.downstream.data import CONFIGS, QUARTERS, SYSTEM, WORDS, Config, crop
from studies.downstream.run import MODELS, TARGETS, Run, by_arm

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
LEAST = {"poisson": 10.0, "renewal": 10.0}  # dB by which reflectivity falls at least
MOST = {"mars": 2.0, "exact": 0.3}  # and at most
TIMES, BELOW = 2.0, 4.0  # of maximum likelihood's depth RMSE the bin network has at most, and times below the filter's
ASSUMED = (
    "the scenes, the light (S = 4 x reflectivity) and the system, which the paper does not give in full",
    "the networks: small ones that use the bins, in place of the paper's U-Net of the kind of DDPMs",
    "the neural simulator, whose layers, loss and law of the count are not public: a stand-in, tabulated over (S, B)",
    "the second pair of columns at SBR 1.0, which one summary of the paper labels depth PSNR and depth RMSE; it is "
    "read here as the first pair is",
)


def facts(
    folder: Path,
    config: Config,
    found: Mapping[Run, Any],
    references: Mapping[str, Mapping[str, float]],
    counts: Mapping[str, Mapping[str, list[float]]],
) -> Facts:
    """What the report states of the results by run, with a figure for each ratio."""
    return {
        "c": config,
        "full": CONFIGS["full"],
        "system": SYSTEM,
        "arithmetic": arithmetic,
        "minutes": sum(result["seconds"] for result in found.values()) / 60.0,
        "arms": list(by_arm(found)),
        "models": MODELS,
        "run": run,
        "over": over,
        "falls": falls,
        "findings": {sbr: list(_findings(found, sbr, references[f"{sbr:g}"])) for sbr in config.sbr},
        "references": references,
        "quarters": QUARTERS,
        "counts": counts,
        "words": WORDS,
        "rows": _csv(found),
        "figures": {f"sbr{sbr:g}": picture(folder, config, found, sbr) for sbr in config.sbr},
    }


def _values(results: list[Any], where: str, model: str, target: str, measure: str) -> list[float]:
    return [result[where][model][target][measure] for result in results]


def over(results: list[Any], where: str, model: str, target: str, measure: str, digits: int) -> str:
    """One measure over the seeds; "-" where the model does not tell that map or interval."""
    try:
        return spread(_values(results, where, model, target, measure), digits)
    except KeyError:
        return "-"


def falls(results: list[Any], model: str) -> str:
    """PSNR of reflectivity, own less gold, dB."""
    own, gold = (_values(results, where, model, "reflectivity", "psnr") for where in ("own", "gold"))
    return spread([a - b for a, b in zip(own, gold, strict=True)], 2)


def _findings(found: Mapping[Run, Any], ratio: float, references: Mapping[str, float]) -> Iterator[tuple[str, bool]]:
    """What was expected, and whether it came so."""
    arms = {arm: results for arm, sbr, results in by_arm(found) if sbr == ratio}
    for arm, limit in (LEAST | MOST).items():
        if arm not in arms:
            continue
        for model, words in MODELS.items():
            own, gold = (np.mean(_values(arms[arm], where, model, "reflectivity", "psnr")) for where in ("own", "gold"))
            fall, sign = float(own - gold), "at least" if arm in LEAST else "at most"
            holds = fall >= limit if arm in LEAST else abs(fall) <= limit
            yield f"{words}, trained on {WORDS[arm]}: reflectivity falls by {fall:.2f} dB ({sign} {limit:g})", holds
    if "exact" in arms:
        told = {name: float(np.mean(_values(arms["exact"], "gold", name, "reflectivity", "psnr"))) for name in MODELS}
        for name in ("window", "bins"):
            gain = told[name] - told["polynomial"]
            words = (
                f"{MODELS[name]}, trained on exact: {gain:+.2f} dB on the polynomial's reflectivity (better than it)"
            )
            yield words, gain > 0.0
        bins = float(np.mean(_values(arms["exact"], "gold", "bins", "depth", "rmse")))
        best, filtered = references["maximum likelihood"], references["matched filter"]
        yield (
            f"bin network, trained on exact: depth RMSE {bins:.4f} m, {bins / best:.2f} times maximum likelihood's "
            f"(at most {TIMES:g}), {filtered / bins:.1f} times below the matched filter's (at least {BELOW:g})",
            bins <= TIMES * best and bins * BELOW <= filtered,
        )


def _csv(found: Mapping[Run, Any]) -> list[Row]:
    rows: list[Row] = []
    for one, result in found.items():
        for where in ("own", "gold"):
            for model, targets in result[where].items():
                for target, measures in targets.items():
                    row: dict[str, Any] = {"arm": one.arm, "sbr": one.sbr, "seed": one.seed, "model": model}
                    row |= {"tested": where, "target": target} | measures
                    rows.append(row | {"covered": measures.get("covered", "")})
    return rows


_SHORT = {"poisson": "Poisson", "nearest": "MaRS, nearest", "mars": "MaRS"}


def picture(folder: Path, config: Config, found: Mapping[Run, Any], sbr: float) -> Figure:
    """The first test scene: truth, and every arm's window network on its own and on gold-standard data."""
    scene = crop(config.test[0], config)
    arms = list(config.arms)
    figure = Figure(figsize=(1.05 * (len(arms) + 1), 4.7), dpi=90, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(4, len(arms) + 1, squeeze=False)
    for half, target in enumerate(TARGETS):
        true = scene.depth_m if target == "depth" else scene.reflectivity
        limits: dict[str, Any] = {"vmin": float(np.nanmin(true)), "vmax": float(np.nanmax(true))}
        limits["cmap"] = "viridis" if target == "depth" else "gray"
        axes[2 * half, 0].imshow(true, **limits)
        axes[2 * half, 0].set_title(f"{target}, true")
        axes[2 * half + 1, 0].axis("off")
        for k, arm in enumerate(arms, 1):
            one = Run(arm, sbr, config.arms[arm][0])
            with np.load(folder / f"{one.name}.npz") as shown:
                for row, data in enumerate(("own", "gold")):
                    ax = axes[2 * half + row, k]
                    ax.imshow(shown[f"{data}_window_{target}"], **limits)
                    error = found[one][data]["window"][target]
                    told = f"{error['rmse']:.3f} m" if target == "depth" else f"{error['psnr']:.1f} dB"
                    ax.set_title(f"{_SHORT.get(arm, arm)}\n{data}: {told}" if row == 0 else f"{data}: {told}")
    for ax in axes.flat:
        ax.set(xticks=[], yticks=[])
    figure.suptitle(f"Window networks, SBR {sbr:g}; figures under the names: over all test scenes", fontsize=8)
    return figure
