"""Study "start-up": what a table's shape leaves out: the start-up of an exposure at other delays than the table's own.

Only exact mean histograms are compared (`statistics.exposure_moments`): that of a pixel at its own delay with the one
at the canonical delay t_r / 2 moved there, which is what a table without any interpolation error would give.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from mars_lidar import Flux
from mars_lidar.statistics import exposure_moments
from studies import Facts, Request
from studies.common.report import Row
from studies.common.sample import PERIOD_NS, system_of

_LEVELS = (0.01, 10.0)
_DIM = 0.1  # photons per period, signal and background each
_TOLERANCE = 1e-5
_CASES = (
    (75.0, 100),
    (75.0, 1000),
    (75.0, 10_000),
    (85.0, 1000),
    (13.0, 1000),
    (130.2, 1000),
    (200.0, 1000),
)  # ns, cycles


def run(request: Request) -> Facts:
    """All dead times and exposures."""
    points, delays = (4, 4) if request.quick else (13, 24)
    rows = []
    for case in _CASES[: 2 if request.quick else None]:
        rows += _measure(*case, points, delays)
        request.tell("start-up: t_d = {:g} ns, {} cycles".format(*case))
    examples = dict.fromkeys((row["dead_time_ns"], row["cycles"]) for row in rows)
    # start-up lasts where the dead time is near the period
    close = [row["displaced"] for row in rows if 0.9 * PERIOD_NS <= row["dead_time_ns"] <= PERIOD_NS]
    return {
        "points": points,
        "delays": delays,
        "levels": list(_LEVELS),
        "lines": [
            _line(case, [row for row in rows if (row["dead_time_ns"], row["cycles"]) == case]) for case in examples
        ],
        "away": max(row["displaced"] for row in rows if row["dead_time_ns"] < 0.9 * PERIOD_NS),
        "near": max(close, default=None),
        "rows": rows,
    }


def _measure(dead_ns: float, cycles: int, points: int, delays: int) -> list[Row]:
    """A row for each cell: the worst delay."""
    system = system_of(dead_ns, cycles)
    levels = np.geomspace(*_LEVELS, points)
    shifts = np.arange(1, delays) * system.bins // delays
    canonical = exposure_moments(Flux(levels[:, None], levels, 0.5 * system.period_ns), system, tolerance=_TOLERANCE)
    variation, chi_square = [], []
    for shift in shifts:
        own = exposure_moments(
            Flux(levels[:, None], levels, 0.5 * PERIOD_NS + shift * system.bin_ns), system, tolerance=_TOLERANCE
        )
        mean = own.histogram
        count = mean.sum(-1, keepdims=True)
        moved = np.roll(canonical.histogram, shift, axis=-1)
        moved = moved * (count / moved.sum(-1, keepdims=True))
        off, both = moved - mean, 0.5 * (moved + mean)
        variation.append(0.5 * np.abs(off).sum(-1) / count[..., 0])
        chi_square.append((off**2 / np.where(both > 0.0, both, 1.0)).sum(-1))
    worst, strongest = np.max(variation, axis=0), np.max(chi_square, axis=0)
    return [
        {
            "dead_time_ns": dead_ns,
            "cycles": cycles,
            "signal": float(levels[i]),
            "background": float(levels[j]),
            "tv": float(worst[i, j]),
            "displaced": float(worst[i, j] * canonical.mean[i, j]),
            "exposures": float(math.sqrt(2.0 * system.bins) / strongest[i, j]),
        }
        for i, j in np.ndindex(points, points)
    ]


def _line(case: tuple[Any, Any], rows: list[Row]) -> Row:
    tv = [float(row["tv"]) for row in rows]
    worst = rows[int(np.argmax(tv))]
    dim = [row for row in rows if max(row["signal"], row["background"]) <= 1.001 * _DIM]
    return {
        "t_d, ns": case[0],
        "N_r": case[1],
        "TV median": float(np.median(tv)),
        "TV max": max(tv),
        "at S": worst["signal"],
        "at B": worst["background"],
        "displaced, most": max(float(row["displaced"]) for row in rows),
        "exposures to see it, fewest": min(float(row["exposures"]) for row in rows),
        "dim: TV max": max(float(row["tv"]) for row in dim),
        "dim: exposures, fewest": min(float(row["exposures"]) for row in dim),
    }
