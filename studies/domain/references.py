"""Engines and predictions against the cases of another program: `--data DIR` with its *.json."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from scipy import stats

from mars_lidar import Detector, GaussianPulse, System, count_law, joint_law, simulate
from mars_lidar._base.types import FloatArray
from mars_lidar.statistics import mean_histogram
from studies.domain.case import PERIOD_NS, Case
from studies.domain.checks import Check, homogeneous

_EXPOSURES = 4000
_PIXELS = 16


def compare(folder: Path | None, seed: int) -> list[Check]:
    """Checks of every case in `folder`; none where it is None."""
    return [check for path in sorted(folder.glob("*.json")) for check in _case(path, seed)] if folder else []


def _case(path: Path, seed: int) -> list[Check]:
    data = json.loads(path.read_text())
    system = System(
        period_ns=PERIOD_NS,
        cycles=data["cycles"],
        bins=data["bins"],
        pulse=GaussianPulse(sigma_ns=data["sigma"] * PERIOD_NS),
        detector=Detector(dead_time_ns=data["dead"] * PERIOD_NS),
    )
    case = Case(path.stem, "reference", system, (data["S"],), (data["tau"],), data["B"])
    items = int(np.clip(4e6 / case.registrations(), 200, _EXPOSURES))
    mean, reals = np.array(data["hist_mean"]), data["reals"]
    counts = {int(k): v for k, v in data["count"].items()}
    table = np.bincount(list(counts), weights=list(counts.values())).astype(np.int64)
    found = []
    for engine in ("exact", "sequential", "auto", "feedback", "mars"):
        rounds = -(-items // _PIXELS)
        cube = simulate(case.flux(_PIXELS), system, engine=engine, realizations=rounds, seed=seed, threads=1)
        cube = cube.reshape(-1, system.bins)
        drawn = np.bincount(cube.sum(1, dtype=np.int64), minlength=table.size)
        rows = np.array([drawn, np.pad(table, (0, drawn.size - table.size))])
        found.append(homogeneous(f"{engine}, {path.stem}", "reference", "law of the count", rows))
        share = 1.0 / len(cube) + 1.0 / reals
        z = (cube.mean(0) - mean) / np.sqrt(np.maximum(np.array(data["hist_var"]), 1e-12) * share)
        found.append(_normal(f"{engine}, {path.stem}", "mean histogram", z[mean * len(cube) > 200]))
    return found + _laws(case, data)


def _normal(who: str, what: str, z: FloatArray) -> Check:
    """The largest of some |z|, by Bonferroni."""
    p = float(min(1.0, z.size * (2.0 * stats.norm.sf(np.abs(z))).min(initial=1.0)))
    return Check(who, "reference", what, p, float(np.abs(z).max(initial=0.0)))


def _laws(case: Case, data: dict[str, Any]) -> list[Check]:
    """Predictions against the means and variances of the reference; an error of its variance from normal counts."""
    reals, light = data["reals"], case.light()
    law, joint = count_law(system=case.system, threads=1, **light), joint_law(system=case.system, **light)
    histogram = mean_histogram(system=case.system, threads=1, **light)
    found = []
    for name, mean, variance in (
        ("count_law", float(law.mean), float(law.variance)),
        ("joint_law", joint.count_mean, joint.count_variance),
    ):
        z = np.array([(data["count_mean"] - mean) / np.sqrt(max(variance, 1e-12) / reals)])
        found.append(_normal(f"{name}, {case.name}", "mean of the count", z))
        if variance > 0.5:
            z = np.array([np.log(data["count_var"] / variance) / np.sqrt(2.0 / reals)])
            found.append(_normal(f"{name}, {case.name}", "variance of the count", z))
    z = (np.array(data["hist_mean"]) - histogram) / np.sqrt(np.maximum(np.array(data["hist_var"]), 1e-9) / reals)
    return [*found, _normal(f"mean_histogram, {case.name}", "mean histogram", z[histogram * reals > 400])]
