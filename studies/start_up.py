"""What a table's shape leaves out: the start-up of an exposure at other delays than the table's own.

Only exact mean histograms are compared (`statistics.exposure_moments`): that of a pixel at its own delay with the one
at the canonical delay t_r / 2 moved there, which is what a table without any interpolation error would give.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from mars_lidar.instrument.pulse import GaussianPulse
from mars_lidar.instrument.system import Detector, System
from mars_lidar.statistics.exposure import exposure_moments
from studies import Request
from studies.report import Row, configuration, number, save_csv, save_text, table

_PERIOD_NS = 1e3 / 7.5
_LEVELS = (0.01, 10.0)
_DIM = 0.1  # photons per period, signal and background each
_TOLERANCE = 1e-5
_CASES = tuple(
    {"dead_time_ns": dead, "cycles": cycles}
    for dead, cycles in (
        (75.0, 100),
        (75.0, 1000),
        (75.0, 10_000),
        (85.0, 1000),
        (13.0, 1000),
        (130.2, 1000),
        (200.0, 1000),
    )
)


def run(request: Request) -> list[Path]:
    """Measure, write ``start_up.md`` and ``start_up.csv``."""
    points, delays = (4, 4) if request.quick else (13, 24)
    rows = []
    for case in _CASES[: 2 if request.quick else None]:
        rows += _measure(case, points, delays)
        request.tell(f"start_up: {case}")
    settings = {
        "command": "`python -m studies start-up`" + (" --quick" if request.quick else ""),
        "system": "t_r = 133.33 ns, 1024 bins, Gaussian pulse of sigma = 0.5 ns, armed start",
        "cells": f"{points} x {points} of S and B, log-spaced in {list(_LEVELS)}, each at {delays} equidistant delays",
        "tolerance": f"{_TOLERANCE:g}",
    }
    text = [
        "# The start-up of an exposure in the shape of a table",
        configuration(settings),
        "A table moves the mean histogram of the canonical delay to the delay of the pixel, its start-up with it; but "
        "the exposure begins where it begins. Total variation between the shape so moved and the pixel's own, both "
        "exact; *displaced*: that times the mean count, in registrations of an exposure; *exposures to see it*: how "
        "many independent exposures of one pixel a chi-square test over all bins (of Poisson variance, the mean of "
        "both) needs until the difference is one standard deviation of its statistic. Over all cells and delays, and "
        f"over the dim cells, S and B up to {_DIM:g}. Mean and variance of the count have their own correction for the "
        "delay, and are not touched by this.",
        table([_line(case, [row for row in rows if _of(row, case)]) for case in _shown(rows)]),
        _said(rows),
    ]
    return [save_text(request.out / "start_up.md", text), save_csv(request.out / "start_up.csv", rows)]


def _measure(case: Mapping[str, Any], points: int, delays: int) -> list[Row]:
    """A row for each cell: the worst delay."""
    system = System(
        period_ns=_PERIOD_NS,
        cycles=case["cycles"],
        bins=1024,
        pulse=GaussianPulse(sigma_ns=0.5),
        detector=Detector(dead_time_ns=case["dead_time_ns"]),
    )
    levels = np.geomspace(*_LEVELS, points)
    shifts = np.arange(1, delays) * system.bins // delays
    canonical = exposure_moments(levels[:, None], levels, system, tolerance=_TOLERANCE)
    variation, chi_square = [], []
    for shift in shifts:
        own = exposure_moments(
            levels[:, None], levels, system, delay_ns=0.5 * _PERIOD_NS + shift * system.bin_ns, tolerance=_TOLERANCE
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
            "dead_time_ns": case["dead_time_ns"],
            "cycles": case["cycles"],
            "signal": float(levels[i]),
            "background": float(levels[j]),
            "tv": float(worst[i, j]),
            "displaced": float(worst[i, j] * canonical.mean[i, j]),
            "exposures": float(math.sqrt(2.0 * system.bins) / strongest[i, j]),
        }
        for i, j in np.ndindex(points, points)
    ]


def _shown(rows: list[Row]) -> list[tuple[Any, Any]]:
    return list(dict.fromkeys((row["dead_time_ns"], row["cycles"]) for row in rows))


def _of(row: Row, case: tuple[Any, Any]) -> bool:
    return (row["dead_time_ns"], row["cycles"]) == case


def _dim(row: Row) -> bool:
    return float(row["signal"]) <= 1.001 * _DIM and float(row["background"]) <= 1.001 * _DIM


def _line(case: tuple[Any, Any], rows: list[Row]) -> Row:
    tv = [float(row["tv"]) for row in rows]
    worst = rows[int(np.argmax(tv))]
    dim = [row for row in rows if _dim(row)]
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


def _said(rows: list[Row]) -> str:
    """What the numbers come to."""
    away = [row for row in rows if float(row["dead_time_ns"]) < 0.9 * _PERIOD_NS]
    near = [row for row in rows if 0.9 * _PERIOD_NS <= float(row["dead_time_ns"]) <= _PERIOD_NS]
    most = max(float(row["displaced"]) for row in away)
    text = (
        f"Where the dead time is not near the period at most {number(most)} registrations of an exposure are "
        "displaced, however long it is: the error falls as 1 / N_r."
    )
    if near:
        text += f" Near the period, where start-up lasts, it is {number(max(float(row['displaced']) for row in near))}."
    return text
