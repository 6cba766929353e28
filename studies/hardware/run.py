"""Study "hardware", T6 of the MaRS paper: streams calibrated and validated, the paper's own figures beside them."""

from __future__ import annotations

import time

import numpy as np

from mars_lidar.plot.stream import validation_figure
from studies import Facts, Request
from studies.common.report import Row, picked
from studies.hardware import cases, figures
from studies.hardware.cases import AT_FLOOR, FULL, PIXELS, QUICK, Case
from studies.hardware.mismatches import ALARM_BINS, alarms, mismatches, sensitivities

PAPER = {"bright": 0.0651, "dark": 0.0601}  # T6 of arXiv 2512.04924: total variation of the count law


def run(request: Request) -> Facts:
    """All streams: matched, swept, mismatched, replicated, and measured if there is one."""
    settings = QUICK if request.quick else FULL
    began = time.process_time()
    pixels = cases.matched(settings, request.tell)
    swept = cases.sweeps(settings, request.tell)
    faults = mismatches(settings, request.tell)
    weak = sensitivities(settings, request.tell)
    false = alarms(settings, request.tell)
    many = cases.spreads(settings, request.tell)
    measured = None if request.stream is None else cases.example(request.stream, settings, request.tell)
    drawn = {
        "pixels": figures.pixels(pixels),
        "range": figures.dynamic_range(swept),
        "recovery": figures.recoveries(faults),
    }
    if measured is not None:
        name, found = measured["cases"][0]
        drawn["measured"] = validation_figure(found, name)
    scores = [float(value) for case in swept for value in case.scores if not np.isnan(value)]
    ways = [] if measured is None else measured["cases"]
    free = [case for name, case in ways if name.startswith("free shape, t_e")]
    return {
        "s": settings,
        "bright": PIXELS["bright"][0],
        "pixels": pixels,
        "many": many,
        "bias": max(float(np.abs(one["bias"]).max()) for one in many),
        "scatters": [float(value) for one in many for value in one["scatter"]],
        "stateds": [float(value) for one in many for value in one["stated"]],
        "swept": swept,
        "fits": sum(case.found.consistent for case in swept),
        "scores": scores,
        "square": float(np.mean(np.square(scores))),
        "faults": faults,
        "wrong": sum(not one.fits for one, _ in faults),
        "missed": [case for one, case in faults if not one.fits and case.found.consistent],
        "refused": [case for one, case in faults if one.fits and not case.found.consistent],
        "below": [case.name for _, case in faults if not case.found.consistent and case.ratio < AT_FLOOR],
        "weak": weak,
        "alarms": false,
        "alarm_bins": ALARM_BINS,
        "measured": measured,
        "free": free,
        "traced": any(case.recovery.findings() for case in free),
        "gaussian": [case for name, case in ways if name.startswith("Gaussian")],
        "figures": drawn,
        "spent": time.process_time() - began,
        "rows": [_csv_row(case) for case in (*pixels, *swept, *(case for _, case in faults))],
    }


def _csv_row(case: Case) -> Row:
    found = case.found
    light = found.calibration
    signal, background, delay = case.truth
    return {
        "stream": case.name,
        "true_signal": signal,
        "true_background": background,
        "true_delay_ns": delay,
        **picked(light.summary, "registrations"),
        **picked(found, "realizations"),
        **picked(found.system, "cycles"),
        **picked(light, "signal background delay_ns dead_time_ns hold_off_ns"),
        "signal_error": light.errors.get("signal", float("nan")),
        "background_error": light.errors["background"],
        "rapp_total": light.rapp.total,
        "count_tv": found.total_variation,
        "count_tv_floor": found.total_variation_floor[0],
        "count_kl": found.kl,
        "count_kl_floor": found.kl_floor[0],
        "histogram_tv": found.shape_variation,
        "histogram_tv_floor": found.shape_floor,
        **{f"p_{check.name}": check.p for check in found.checks},
        "consistent": found.consistent,
    }
