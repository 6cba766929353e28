"""The report on hardware: T6 of the MaRS paper, the paper's own figures beside it."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mars_lidar.studies import Request
from mars_lidar.studies.hardware import (
    BINS,
    DEAD_NS,
    DELAY_NS,
    FULL,
    PERIOD_NS,
    PIXELS,
    QUICK,
    SIGMA_NS,
    Case,
    Example,
    Settings,
    Spread,
    example,
    matched,
    spreads,
    sweeps,
)
from mars_lidar.studies.hardware_figures import draw_all
from mars_lidar.studies.hardware_mismatches import Mismatch, mismatches
from mars_lidar.studies.machine import machine
from mars_lidar.studies.report import Row, configuration, save_csv, save_text, table

PAPER = {"bright": 0.0651, "dark": 0.0601}  # T6 of arXiv 2512.04924: total variation of the count law
AT_FLOOR = 1.15  # times the floor that the matched pixels may have


def run(request: Request) -> list[Path]:
    """Compute, draw and write the study; returns the paths written."""
    settings = QUICK if request.quick else FULL
    began = time.process_time()
    pixels = matched(settings, request.tell)
    swept = sweeps(settings, request.tell)
    faults = mismatches(settings, request.tell)
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
        f"S = {PIXELS['bright'][0]:g}, {settings.fault_realizations:,} realizations of {settings.fault_cycles:,} "
        f"cycles. "
        "The verdict is that of `mars-lidar validate` at 1 % false alarms; *failed* lists the tests that failed. Where "
        "the detector is *told*, effects and all, calibration and prediction are made with it: by the laws that there "
        "are, else by simulation with the exact engine, and the stream should fit.",
        table([_fault_row(one, case) for one, case in faults]),
        _fault_finding(faults),
        "What the recovery says, where it says something:",
        "\n".join(f"- {case.name}: {text}." for _, case in faults for text in case.found.recovery.findings()),
        "Recovery: registrations by time since the last one, over the light that fell on the pixel at that age; "
        "the vertical line is the dead time that was assumed, the stepped one the recovery of the simulated stream.",
        _image(figures[2]),
        *_measured(measured, settings, figures),
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


def _ratio(case: Case) -> float:
    return case.found.total_variation / case.found.total_variation_floor[0]


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
        "verdict": _verdict(case),
    }


def _check(case: Case, name: str) -> float:
    return next(check.score for check in case.found.checks if check.name == name)


def _verdict(case: Case) -> str:
    return "fits" if case.found.consistent else "does not fit"


def _pixel_finding(case: Case) -> str:
    ratio = _ratio(case)
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
        "stream": case.name, "calibrated S": returns, "z S": z[0], "z B": z[1], "z delay": z[2],
        "TV / floor": _ratio(case), "99 %": found.total_variation_floor[1] / found.total_variation_floor[0],
        "histogram TV / floor": found.shape_variation / found.shape_floor, "verdict": _verdict(case),
    }  # fmt: skip


def _sweep_finding(cases: Sequence[Case]) -> str:
    scores = [value for case in cases for value in case.scores if not np.isnan(value)]
    fits = sum(case.found.consistent for case in cases)
    mean = float(np.mean([_ratio(case) for case in cases]))
    return (
        f"{fits} of {len(cases)} fit; total variation {mean:.3f} times the floor in the mean. Mean square of the "
        f"{len(scores)} "
        f"scores {float(np.mean(np.square(scores))):.2f} (1 is right), largest {max(map(abs, scores)):.1f}."
    )


def _fault_row(one: Mismatch, case: Case) -> Row:
    found = case.found
    light = found.calibration
    told = [check.name for check in found.failed]
    told += ["short intervals"] * bool(light.too_short and found.prediction.recovery is None)
    return {
        "detector": one.name, "dead time (ns)": light.dead_time_ns, "S": light.signal, "B": light.background,
        "true B": case.truth[1], "z S": f"{case.scores[0]:+.1f}", "z B": f"{case.scores[1]:+.1f}",
        "TV / floor": _ratio(case), "verdict": _verdict(case),
        "predicted by": found.prediction.words, "failed": ", ".join(told) or "-",
    }  # fmt: skip


def _fault_finding(faults: Sequence[tuple[Mismatch, Case]]) -> str:
    lines = []
    wrong = [case.name for one, case in faults if not one.fits and case.found.consistent]
    alarms = [case.name for one, case in faults if one.fits and not case.found.consistent]
    number = sum(not one.fits for one, _ in faults)
    lines.append(f"- {number - len(wrong)} of {number} mismatches are told apart from the model.")
    for name in wrong:
        case = next(case for _, case in faults if case.name == name)
        lines.append(
            f"- **Not told apart**: {name}. The model with S = {case.found.calibration.signal:.4f} and B = "
            f"{case.found.calibration.background:.4f} makes the same stream at this length; the light is off by "
            f"{case.scores[0]:+.1f} and {case.scores[1]:+.1f} standard errors, so a fit is no proof of the detector."
        )
    lines += [f"- **False alarm**: {name}." for name in alarms]
    below = [case.name for one, case in faults if not case.found.consistent and _ratio(case) < AT_FLOOR]
    lines.append(
        f"- Total variation of the count law alone is within {AT_FLOOR} floors in {len(below)} of the streams "
        f"that do not fit "
        f"({'; '.join(below)}): by itself it is a weak test, because S and B are fitted to the same stream."
    )
    return "\n".join(lines)


def _measured(found: Example | None, settings: Settings, figures: Sequence[Path]) -> list[str]:
    if found is None:
        return ["## A measured stream", "Not given: `--stream FILE` adds it."]
    told = ", ".join(f"{name} {value:.4g} ns" for name, value in found.told.items())
    rows = [
        {
            "calibration": name, "dead time (ns)": case.calibration.dead_time_ns,
            "Lambda": f"{case.calibration.total:.3f} ± {case.calibration.total_error:.3f}",
            "by Rapp": f"{case.calibration.rapp.total:.3f} ± {case.calibration.rapp.total_error:.3f}",
            "photons used": case.calibration.armed.used, "TV": case.total_variation,
            "floor": case.total_variation_floor[0],
            "failed": ", ".join(check.name for check in case.failed) or "-",
            "verdict": "fits" if case.consistent else "does not fit",
        }
        for name, case in found.cases
    ]  # fmt: skip
    first = found.cases[0][1].calibration
    return [
        "## A measured stream",
        f"{found.registrations:,} photons of a TCSPC instrument in {found.cycles:,} periods of "
        f"{found.period_ns:.5g} ns (the file says: {told}), cut into realizations of {settings.example_cycles} cycles.",
        "What does not fit, or cannot be known from this file:",
        "\n".join(_example_limits(found, settings)),
        f"The dead time estimated from the photons alone is {first.dead_time_ns:.2f} ± "
        f"{first.dead_time_error_ns:.2f} ns.",
        table(rows),
        _image(figures[3]),
    ]


def _example_limits(found: Example, settings: Settings) -> list[str]:
    """What the measured stream does not fit, from its own calibrations."""
    free = [case for name, case in found.cases if name.startswith("free shape, t_e")]
    gaussian = [case for name, case in found.cases if name.startswith("Gaussian")]
    lines = [
        "- The light is a decay (fluorescence), not a pulse on a background. S and B are not separate, and the "
        "free shape's mean histogram agrees by construction."
    ]
    if gaussian:
        refused = "refused" if not gaussian[0].consistent else "not refused, for lack of photons"
        lines.append(f"- A Gaussian pulse is {refused}.")
    if free:
        trace = "is seen in the recovery" if any(case.recovery.findings() for case in free) else (
            "leaves no trace in the recovery of so few photons"
        )
        agrees = "agrees" if all(case.consistent for case in free) else "does not agree"
        lines.append(
            "- The dead time is that of the electronics, longer than the detector's. Detections that the "
            "electronics miss "
            f"blind the detector after them, which the model does not have: this {trace}, and the law with t_e "
            f"alone {agrees}."
        )
    lines.append(
        f"- {found.cycles:,} periods do not make realizations of the paper's {FULL.cycles:,} cycles: "
        f"{settings.example_cycles} are taken."
    )
    return lines


def _csv_row(case: Case) -> Row:
    found = case.found
    light = found.calibration
    signal, background, delay = case.truth
    return {
        "stream": case.name, "true_signal": signal, "true_background": background, "true_delay_ns": delay,
        "registrations": light.summary.registrations, "realizations": found.realizations, "cycles": found.system.cycles,
        "signal": light.signal, "background": light.background, "delay_ns": light.delay_ns,
        "dead_time_ns": light.dead_time_ns, "hold_off_ns": light.hold_off_ns,
        "signal_error": light.errors.get("signal", float("nan")), "background_error": light.errors["background"],
        "rapp_total": light.rapp.total, "count_tv": found.total_variation,
        "count_tv_floor": found.total_variation_floor[0],
        "count_kl": found.kl, "count_kl_floor": found.kl_floor[0], "histogram_tv": found.shape_variation,
        "histogram_tv_floor": found.shape_floor, **{f"p_{check.name}": check.p for check in found.checks},
        "consistent": found.consistent,
    }  # fmt: skip


def _image(path: Path) -> str:
    return f"![{path.stem}]({path.name})"
