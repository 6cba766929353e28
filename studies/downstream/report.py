"""The report of the downstream experiment: the paper's table beside ours, the gaps with their spread, pictures."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from studies import Request
from studies.common.report import Row, save_figure, write
from studies.downstream.counts import QUARTERS
from studies.downstream.data import SYSTEM, WORDS, Config
from studies.downstream.figures import picture
from studies.downstream.run import Run, by_arm

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
_CLAIM_DB, _CLAIM_TIMES = 10.0, 5.0  # by which the mars-trained network is to beat the Poisson-trained one


def report(
    request: Request,
    folder: Path,
    config: Config,
    found: Mapping[Run, Any],
    counts: Mapping[str, Mapping[str, list[float]]],
) -> list[Path]:
    """downstream.md, downstream.csv and a figure for each ratio; the `found` results are complete."""
    pictures = [
        save_figure(request.out / f"downstream_sbr{sbr:g}.png", picture(folder, config, found, sbr))
        for sbr in config.sbr
    ]
    facts = {
        "c": config,
        "system": SYSTEM,
        "stopped": sum(bool(result["training"]["stopped"]) for result in found.values()),
        "networks": len(found),
        "seconds": sum(result["training"]["seconds"] for result in found.values()),
        "arms": list(by_arm(found)),
        "spread": spread,
        "findings": {sbr: _finding(found, sbr) for sbr in dict.fromkeys(one.sbr for one in found)},
        "quarters": QUARTERS,
        "counts": counts,
        "words": WORDS,
        "measured": list(next(iter(found.values())).get("measured", ())),
        "pictures": pictures,
    }
    rows = [_csv_row(one, result) for one, result in found.items()]
    return write(request, "downstream", __name__, "report", facts, rows=rows, figures=pictures)


def _values(results: list[Any], data: str, measure: str) -> list[float]:
    return [result[data][measure] for result in results]


def spread(values: list[float], digits: int) -> str:
    """Mean, and the standard deviation between seeds where there are several."""
    mean = f"{np.mean(values):.{digits}f}"
    return mean if len(values) < 2 else f"{mean} ± {np.std(values, ddof=1):.{digits}f}"


def _finding(found: Mapping[Run, Any], ratio: float) -> dict[str, Any]:
    arms = {arm: results for arm, sbr, results in by_arm(found) if sbr == ratio}

    def gold(arm: str, target: str) -> list[float]:
        return _values(arms[arm][target], "gold", "rmse" if target == "depth" else "psnr")

    def better(one: str, other: str, target: str) -> float:
        return float(np.mean(gold(one, target)) - np.mean(gold(other, target)))

    one: dict[str, Any] = {"gaps": []}
    if {"mars", "poisson"} <= set(arms):
        one["gain"] = better("mars", "poisson", "reflectivity")
        one["times"] = float(np.mean(gold("poisson", "depth")) / np.mean(gold("mars", "depth")))
    if "mars" in arms:
        for target, measure, unit, digits in (("reflectivity", "psnr", "dB", 2), ("depth", "rmse", "m", 4)):
            gaps = [r["gold"][measure] - r["own"][measure] for r in arms["mars"][target]]
            pairs = zip(gold("exact", target), gold("mars", target), strict=False) if "exact" in arms else ()
            exact = [a - b for a, b in pairs]
            one["gaps"].append((target, spread(gaps, digits), spread(exact, digits) if exact else "", unit))
    if {"mars", "nearest"} <= set(arms):
        one["nearest"] = better("mars", "nearest", "reflectivity"), better("nearest", "mars", "depth")
    return one


def _csv_row(one: Run, result: Any) -> Row:
    row: dict[str, Any] = {"arm": one.arm, "sbr": one.sbr, "target": one.target, "seed": one.seed}
    row |= {f"{data}_{measure}": v for data in ("own", "gold") for measure, v in result[data].items()}
    row |= result["training"]
    return row
