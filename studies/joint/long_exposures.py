"""Study "long-exposures": the feedback engine's means and variances at long exposures, against the closed form."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mars_lidar.engines.engine import Task
from mars_lidar.engines.exact import ExactEngine
from mars_lidar.engines.feedback import FeedbackEngine
from mars_lidar.engines.feedback_grid import Grids
from mars_lidar.engines.feedback_rule import draw_rest
from studies import Facts, Request
from studies.common.report import Row, picked
from studies.joint.cases import Case

GOAL = 0.05  # standard deviations of a bin that its mean may be off (engines/feedback_grid.py)


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


def run(request: Request) -> Facts:
    """Random systems, compared one by one."""
    settings = QUICK if request.quick else FULL
    random = np.random.default_rng(settings.seed)
    rows = []
    for k in range(settings.systems):
        rows.append(compare(*_drawn(random, k), settings.items, seed=k))
        request.tell(f"{k + 1} of {settings.systems}: {rows[-1]}")
    drawn = [row for row in rows if row["cells"]]
    return {
        "s": settings,
        "error": 1.0 / np.sqrt(settings.items),
        "drawn": drawn,
        "rows": rows,
    }


def _drawn(random: np.random.Generator, k: int) -> tuple[Case, int]:
    """A random pixel, and its number of bins."""
    signal, background, dead, sigma = 10 ** random.uniform([-1.3, -2.0, -1.3, -2.7], [1.0, 1.0, 0.4, -1.7])
    cycles, bins = int(random.choice([10**6, 10**7, 10**8])), int(random.choice([64, 256, 1024]))
    delay = float(random.uniform())
    return Case(f"r{k:02d}", float(signal), float(background), float(dead), delay, float(sigma), cycles), bins


def compare(case: Case, bins: int, items: int, seed: int) -> Row:
    """A row of the study for one pixel: cells of 0 where the engine refuses it."""
    report: dict[str, float] = {}
    x, system = case.histograms(bins, _Sampled(), items, seed, report).astype(np.float64), case.system(bins)
    task = Task(case.flux, system, 1, 0, np.zeros(1, np.uint32), 0, 1, None)
    grids = Grids.checked(task, np.arange(1))
    row: dict[str, Any] = {
        **picked(case, "S=signal B=background t_d=dead sigma"),
        "cycles": f"{case.cycles:.0e}",
        "bins": bins,
        "cells": int(grids.cells()[0]),
        "cut": f"{1 << int(grids.kinds[0].max())}" if grids.kinds else "",
    }
    if report["refused"]:
        keys = ("largest", "rms", "count", "window", "var count", "var window", "var bins")
        return row | {"cells": 0} | dict.fromkeys(keys, "")
    law = case.law(bins)
    weights = np.stack([np.ones(bins), case.window(bins).astype(np.float64)])
    mean, variance = law.window(weights)
    y = x @ weights.T
    off = (x.mean(0) - law.mean) / np.sqrt(law.variance)
    count, window = (y.mean(0) - mean) / np.sqrt(np.maximum(variance, 1e-300))
    spread = y.var(0) / np.maximum(variance, 1e-300)
    return row | {
        "largest": float(np.abs(off).max()),
        "rms": float(np.sqrt(max(0.0, np.mean(off**2) - 1.0 / items))),
        "count": float(count),
        "window": float(window),
        "var count": float(spread[0]),
        "var window": float(spread[1]),
        "var bins": float(np.mean(x.var(0) / law.variance)),
    }
