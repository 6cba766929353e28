"""Study "hardware", T6 of the MaRS paper: calibrated streams, their tests of fit, compared with the paper."""

from __future__ import annotations

import time

import numpy as np

from mars_lidar.plot.stream import calibration_figure
from studies import Facts, Request
from studies.common.report import Row
from studies.hardware import cases, figures
from studies.hardware.cases import FULL as FULL
from studies.hardware.cases import PIXELS as PIXELS
from studies.hardware.cases import QUICK as QUICK
from studies.hardware.cases import Case

PAPER = {"bright": 0.0651, "dark": 0.0601}  # T6 of arXiv 2512.04924: total variation of the count law


def run(request: Request) -> Facts:
    """All streams: the paper's pixels, sweeps, detectors with effects, and a measured one if there is one."""
    settings = QUICK if request.quick else FULL
    began = time.process_time()
    pixels = cases.pixels(settings, request.tell)
    swept = cases.sweeps(settings, request.tell)
    faults = cases.faults(settings, request.tell)
    measured = [] if request.stream is None else cases.example(request.stream, settings, request.tell)
    drawn = {"pixels": figures.pixels(pixels), "range": figures.dynamic_range(swept)}
    if measured:
        drawn["measured"] = calibration_figure(measured[0].result, measured[0].name)
    scores = [value for case in (*pixels, *swept) for value in case.scores if not np.isnan(value)]
    return {
        "s": settings,
        "pixels": pixels,
        "swept": swept,
        "scores": scores,
        "square": float(np.mean(np.square(scores))),
        "faults": faults,
        "measured": measured,
        "stream": None if request.stream is None else request.stream.name,
        "figures": drawn,
        "spent": time.process_time() - began,
        "rows": [_csv_row(case) for case in (*pixels, *swept, *faults, *measured)],
    }


def _csv_row(case: Case) -> Row:
    result = case.result
    row: dict[str, object] = {
        "stream": case.name,
        "true_signal": case.truth[0],
        "true_background": case.truth[1],
        "true_delay_ns": case.truth[2],
        "registrations": result.look.registrations,
        "p": result.p_value,
        "fits": result.fits,
        "suspects": "; ".join(case.suspects),
    }
    for name in ("signal", "background", "delay_ns", "dead_time_ns", "jitter_ns"):
        estimate = result.estimates.get(name)
        row[name] = float("nan") if estimate is None else estimate.value
        row[f"{name}_error"] = float("nan") if estimate is None else estimate.error
    counts = case.counts
    row["count_tv"] = float("nan") if counts is None else counts.total_variation
    row["count_tv_floor"] = float("nan") if counts is None else counts.total_variation_floor[0]
    return row
