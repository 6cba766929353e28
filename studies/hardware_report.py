"""The report on hardware: T6 of the MaRS paper, the paper's own figures beside it."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from studies import Request
from studies.hardware import (
    AT_FLOOR,
    BINS,
    DEAD_NS,
    DELAY_NS,
    FULL,
    PERIOD_NS,
    PIXELS,
    QUICK,
    SIGMA_NS,
    Case,
    Settings,
    Spread,
    example,
    matched,
    spreads,
    sweeps,
)
from studies.hardware_alarms import ALARM_BINS, Alarms, alarm_row, alarms
from studies.hardware_example_report import example_parts
from studies.hardware_figures import draw_all
from studies.hardware_mismatch_report import mismatch_parts
from studies.hardware_mismatches import mismatches, sensitivities
from studies.machine import machine
from studies.report import Row, configuration, save_csv, save_text, table

PAPER = {"bright": 0.0651, "dark": 0.0601}  # T6 of arXiv 2512.04924: total variation of the count law


def run(request: Request) -> list[Path]:
    """Compute, draw and write the study; returns the paths written."""
    settings = QUICK if request.quick else FULL
    began = time.process_time()
    pixels = matched(settings, request.tell)
    swept = sweeps(settings, request.tell)
    faults = mismatches(settings, request.tell)
    weak = sensitivities(settings, request.tell)
    false = alarms(settings, request.tell)
    many = spreads(settings, request.tell)
    measured = None if request.stream is None else example(request.stream, settings, request.tell)
    figures = draw_all(request.out, pixels, swept, faults, measured)
    seconds = time.process_time() - began
    parts = [
        "# T6: hardware, calibrated and validated",
        "The recipe of [calibration.md](../calibration.md) on streams whose truth is known, on detectors that "
        "the model does not have, and on a measured stream. The MaRS paper ([arXiv "
        "2512.04924](https://arxiv.org/abs/2512.04924)) "
        "validates its count law on two pixels of a 7.5 MHz laser and a detector of 85 ns dead time, 10,000 "
        "realizations "
        "of 9975 cycles each; its data are not public, nor its S and B. Here a pixel is simulated at these "
        "settings as one "
        "continuous stream; then its S, B and delay are calibrated from the timestamps alone, the stream is cut into "
        "realizations, and the exact law of the calibrated model is compared with them. *Floor*: mean total "
        "variation of samples of the same size drawn from the predicted law itself.",
        configuration(_settings(settings)),
        f"- machine: {machine()}\n- processor time: {seconds:.0f} s",
        "## The paper's two pixels",
        table([_pixel_row(case) for case in pixels]),
        "\n".join(_pixel_finding(case) for case in pixels),
        _image(figures[0]),
        "## Calibration against the Cramer-Rao bound",
        f"{settings.replicates} streams of {settings.replicate_cycles:,} cycles for each light; pulse and dead time "
        "known. Bias in standard errors of the mean; *scatter* and *stated error* over the bound (1 is the best that "
        "can be); the last column is the scatter of Rapp's total flux over that of the likelihood's (inf: some streams "
        "had no empty period to count).",
        table([_spread_row(one) for one in many]),
        _spread_finding(many, settings),
        "## Distance, dynamic range, several returns",
        f"{settings.swept_realizations:,} realizations of {settings.swept_cycles:,} cycles; the dead time is "
        f"known, the width of the pulse is fitted. `z` are errors of the calibration in its standard errors.",
        table([_sweep_row(case) for case in swept]),
        _sweep_finding(swept),
        _image(figures[1]),
        "## Detectors that are not the model's",
        *mismatch_parts(faults, weak, settings, figures[2]),
        "## False alarms",
        f"Streams of the model itself (the bright pixel, {ALARM_BINS} bins), {settings.replicate_cycles:,} cycles cut "
        f"into realizations of {settings.alarm_cycles}, at the verdict's 1 %. The fit leaves less or more to the "
        "tests: it is made of the same photons, of some of them, or of those of another stream.",
        table([alarm_row(one) for one in false]),
        _alarm_finding(false),
        *example_parts(measured, settings, figures),
    ]
    rows = [_csv_row(case) for case in (*pixels, *swept, *(case for _, case in faults))]
    text = save_text(request.out / "hardware.md", parts)
    return [text, save_csv(request.out / "hardware.csv", rows), *figures]


def _settings(settings: Settings) -> dict[str, Any]:
    pixels = ", ".join(f"{name} S = {s:g}, B = {b:g}" for name, (s, b) in PIXELS.items())
    return {
        "laser and histogram": f"period {PERIOD_NS:.6g} ns, {BINS} bins, Gaussian pulse of sigma {SIGMA_NS:g} ns",
        "detector": f"dead time {DEAD_NS:g} ns, non-paralyzable",
        "pixels": f"{pixels}, delay {DELAY_NS:g} ns",
        "realizations": f"{settings.realizations:,} of {settings.cycles:,} cycles",
        "seed": settings.seed,
        "engine": "exact, timestamps",
    }


def _pixel_row(case: Case) -> Row:
    found = case.found
    light = found.calibration
    return {
        "pixel": case.name,
        "photons": f"{light.summary.registrations:,}",
        "S": f"{light.signal:.5f} ± {light.errors['signal']:.5f}",
        "B": f"{light.background:.5f} ± {light.errors['background']:.5f}",
        "TV of the count": found.total_variation,
        "floor": found.total_variation_floor[0],
        "paper's TV": PAPER[case.name],
        "KL (nats)": found.kl,
        "KL floor": found.kl_floor[0],
        "TV of the histogram": found.shape_variation,
        "its floor": found.shape_floor,
        "window variance z": _check(case, "window variance"),
        "verdict": case.verdict,
    }


def _check(case: Case, name: str) -> float:
    return next(check.score for check in case.found.checks if check.name == name)


def _pixel_finding(case: Case) -> str:
    ratio = case.ratio
    judged = "at the floor" if ratio <= AT_FLOOR else "**above the floor**"
    z = ", ".join(f"{value:+.1f}" for value in case.scores)
    return (
        f"- {case.name}: total variation {ratio:.3f} times the floor, {judged} (limit {AT_FLOOR}); S, B and delay "
        f"off by {z} standard errors."
    )


def _spread_row(one: Spread) -> Row:
    names = ("B", "S", "delay")
    row: dict[str, Any] = {"S": one.signal, "B": one.background, "photons": one.registrations}
    row |= {f"bias {name}": f"{value:+.1f}" for name, value in zip(names, one.bias, strict=True)}
    row |= {f"scatter {name}": f"{value:.2f}" for name, value in zip(names, one.scatter, strict=True)}
    row |= {f"stated {name}": f"{value:.3f}" for name, value in zip(names, one.stated, strict=True)}
    row["Rapp"] = f"{one.rapp:.2f}"
    return row


def _spread_finding(many: Sequence[Spread], settings: Settings) -> str:
    bias = max(float(np.abs(one.bias).max()) for one in many)
    scatter = [float(value) for one in many for value in one.scatter]
    stated = [float(value) for one in many for value in one.stated]
    noise = 1.0 / np.sqrt(2.0 * settings.replicates)
    return (
        f"Largest bias {bias:.1f} standard errors of the mean of {settings.replicates} streams, among {3 * len(many)}. "
        f"Scatter {min(scatter):.2f} to {max(scatter):.2f} times the bound, whose own sampling error is "
        f"{noise:.2f}; stated errors {min(stated):.3f} to {max(stated):.3f} times the bound."
    )


def _sweep_row(case: Case) -> Row:
    found = case.found
    light = found.calibration
    z = ["-" if np.isnan(value) else f"{value:+.1f}" for value in case.scores]
    returns = ", ".join(
        f"{s:.4f} at {tau:.3f} ns" for s, tau in zip(light.returns_signal, light.returns_delay_ns, strict=True)
    )
    return {
        "stream": case.name,
        "calibrated S": returns,
        "z S": z[0],
        "z B": z[1],
        "z delay": z[2],
        "TV / floor": case.ratio,
        "99 %": found.total_variation_floor[1] / found.total_variation_floor[0],
        "histogram TV / floor": found.shape_variation / found.shape_floor,
        "verdict": case.verdict,
    }


def _sweep_finding(cases: Sequence[Case]) -> str:
    scores = [value for case in cases for value in case.scores if not np.isnan(value)]
    fits = sum(case.found.consistent for case in cases)
    mean = float(np.mean([case.ratio for case in cases]))
    return (
        f"{fits} of {len(cases)} fit; total variation {mean:.3f} times the floor in the mean. Mean square of the "
        f"{len(scores)} "
        f"scores {float(np.mean(np.square(scores))):.2f} (1 is right), largest {max(map(abs, scores)):.1f}."
    )


def _alarm_finding(false: Sequence[Alarms]) -> str:
    streams, refused = sum(one.streams for one in false), sum(one.refused for one in false)
    return f"{refused} of {streams:,} are refused, {refused / streams:.1%}."


def _csv_row(case: Case) -> Row:
    found = case.found
    light = found.calibration
    signal, background, delay = case.truth
    return {
        "stream": case.name,
        "true_signal": signal,
        "true_background": background,
        "true_delay_ns": delay,
        "registrations": light.summary.registrations,
        "realizations": found.realizations,
        "cycles": found.system.cycles,
        "signal": light.signal,
        "background": light.background,
        "delay_ns": light.delay_ns,
        "dead_time_ns": light.dead_time_ns,
        "hold_off_ns": light.hold_off_ns,
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


def _image(path: Path) -> str:
    return f"![{path.stem}]({path.name})"
