"""The feedback engine at long exposures: its means and variances against the closed form, in standard deviations."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import mars_lidar as ml
from mars_lidar.engines.engine import Task
from mars_lidar.engines.exact import ExactEngine
from mars_lidar.engines.feedback import FeedbackEngine
from mars_lidar.engines.feedback_grid import cell_cuts, internal_cells
from mars_lidar.engines.feedback_rule import draw_rest
from studies import Request
from studies.machine import machine
from studies.report import Row, configuration, save_csv, save_text, table

PERIOD_NS = 1e3 / 7.5
GOAL = 0.05  # standard deviations of a bin that its mean may be off (engines/_feedback_grid.py)


@dataclass(frozen=True)
class Settings:
    """Random systems, exposures of each, seed."""

    systems: int
    items: int
    seed: int = 20_261


FULL, QUICK = Settings(40, 8000), Settings(3, 1000)


class _Sampled(FeedbackEngine):
    """Leaves the rows of pixels that it would give to the exact engine at 0."""

    def histogram(self, task: Task, out: NDArray[Any]) -> None:
        out[...] = 0
        rest = self.sample(task, out, np.arange(task.pixel_index.size))
        task.report["refused"] = float(rest.pixels.size)
        # single exposures that did not settle: a simulation would draw them again
        draw_rest(ExactEngine(), task, out, replace(rest, pixels=rest.pixels[:0]))


def run(request: Request) -> list[Path]:
    """Draw, compare and write the study; returns the paths written."""
    settings = QUICK if request.quick else FULL
    began = time.monotonic()
    random = np.random.default_rng(settings.seed)
    rows = []
    for k in range(settings.systems):
        rows.append(compare(*_system(random), settings.items, seed=k))
        request.tell(f"{k + 1} of {settings.systems}: {rows[-1]}")
    drawn = [row for row in rows if row["cells"]]
    text = save_text(
        request.out / "long_exposures.md",
        [
            "# The feedback engine at long exposures",
            "_Quick form: a look, not for citing._" if request.quick else "",
            "Means and variances of drawn histograms against `joint_law`, which uses a grid of its own. Differences of "
            "means are in standard deviations of what is compared; *rms* is their root mean square over the bins less "
            f"the sample's own error, {1 / np.sqrt(settings.items):.2g}; *window*: counts within 3 sigma of the "
            f"return; *bins*: ratio of variances, mean over the bins. The engine aims at {GOAL:g} in any bin.",
            "## Configuration",
            f"Command: `python -m studies long-exposures{' --quick' if request.quick else ''} --out DIR`",
            configuration(
                {
                    "systems": f"{settings.systems}: S 0.05-10, B 0.01-10, t_d 0.05-2.5 periods, sigma 0.002-0.02 "
                    "periods, log-uniform; 1e6, 1e7 or 1e8 cycles; 64, 256 or 1024 bins; any delay; armed start",
                    "exposures": f"{settings.items} each; seed {settings.seed}",
                    "machine": machine(),
                    "run time": f"{time.monotonic() - began:.0f} s",
                }
            ),
            "## Result",
            "\n".join(_findings(drawn, settings)),
            table([{key: value if value is not None else "" for key, value in row.items()} for row in rows]),
            "Rows without cells: given to the exact engine. *cells*: those of the internal grid, *cut* into how many "
            "parts a bin is cut everywhere, and again near the pulse.",
        ],
    )
    return [text, save_csv(request.out / "long_exposures.csv", rows)]


def _system(random: np.random.Generator) -> tuple[float, float, ml.System, float]:
    signal, background, dead, sigma = 10 ** random.uniform([-1.3, -2.0, -1.3, -2.7], [1.0, 1.0, 0.4, -1.7])
    cycles, bins = int(random.choice([10**6, 10**7, 10**8])), int(random.choice([64, 256, 1024]))
    system = ml.System(
        period_ns=PERIOD_NS,
        cycles=cycles,
        bins=bins,
        pulse=ml.GaussianPulse(sigma_ns=sigma * PERIOD_NS),
        detector=ml.Detector(dead_time_ns=dead * PERIOD_NS),
    )
    return float(signal), float(background), system, float(random.uniform(0.0, PERIOD_NS))


def compare(signal: float, background: float, system: ml.System, delay_ns: float, items: int, seed: int) -> Row:
    """A row of the study for one pixel: cells of 0 where the engine refuses it."""
    flux = ml.Flux(signal, background, delay_ns)
    report: dict[str, float] = {}
    cube = ml.simulate(flux, system, engine=_Sampled(), realizations=items, seed=seed, report=report)
    x = cube.reshape(items, system.bins).astype(np.float64)
    sigma = float(getattr(system.pulse, "sigma_ns", 0.0))
    merge, parts = cell_cuts(flux, system)
    row: dict[str, Any] = {
        "S": signal,
        "B": background,
        "t_d": system.dead_time_periods,
        "sigma": sigma / PERIOD_NS,
        "cycles": f"{system.cycles:.0e}",
        "bins": system.bins,
        "cells": int(internal_cells(flux, system)[0, 0]),
        "cut": f"{merge[0, 0]} x {parts[0, 0]}",
    }
    keys = ("largest", "rms", "count", "window", "var count", "var window", "var bins")
    if report["refused"]:
        return row | {"cells": 0} | dict.fromkeys(keys)
    law = ml.joint_law(signal, background, system, delay_ns=delay_ns, tolerance=1e-4)
    apart = ((np.arange(system.bins) + 0.5) / system.bins - delay_ns / PERIOD_NS + 0.5) % 1.0 - 0.5
    near = np.abs(apart) < max(3.0 * sigma / PERIOD_NS, 0.51 / system.bins)
    weights = np.stack([np.ones(system.bins), near.astype(np.float64)])
    mean, variance = law.window(weights)
    y = x @ weights.T
    off = (x.mean(0) - law.mean) / np.sqrt(law.variance)
    count, window = (y.mean(0) - mean) / np.sqrt(np.maximum(variance, 1e-300))
    spread = y.var(0) / np.maximum(variance, 1e-300)
    found = (
        float(np.abs(off).max()),
        float(np.sqrt(max(0.0, np.mean(off**2) - 1.0 / items))),
        float(count),
        float(window),
        float(spread[0]),
        float(spread[1]),
        float(np.mean(x.var(0) / law.variance)),
    )
    return row | dict(zip(keys, found, strict=True))


def _findings(rows: list[Row], settings: Settings) -> list[str]:
    def column(key: str) -> NDArray[np.float64]:
        return np.array([row[key] for row in rows], dtype=np.float64)

    error = 1.0 / np.sqrt(settings.items)
    ratio = np.sqrt(2.0) * error
    return [
        f"- {len(rows)} of {settings.systems} systems drawn by the engine itself.",
        f"- Means of bins: rms at most {column('rms').max():.2g} standard deviations, largest difference "
        f"{column('largest').max():.2g} (of {int(column('bins').sum())} bins, sample error of each {error:.2g}).",
        f"- Mean of the count: at most {np.abs(column('count')).max():.2g} standard deviations off, of the window "
        f"{np.abs(column('window')).max():.2g}.",
        f"- Variance of the count over the closed form: {column('var count').mean():.4f} on average, "
        f"{column('var count').min():.3f} to {column('var count').max():.3f} (sample error {ratio:.2g}); of the window "
        f"{column('var window').mean():.4f}, {column('var window').min():.3f} to {column('var window').max():.3f}.",
        f"- Variance of the bins over the closed form, mean over bins and systems: {column('var bins').mean():.4f}.",
    ]
