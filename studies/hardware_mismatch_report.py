"""The report on hardware: detectors that are not the model's, which are told apart, and how weak they may be."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from studies.hardware import AT_FLOOR, PIXELS, Case, Settings
from studies.hardware_mismatches import Mismatch, Sensitivity
from studies.report import Row, table


def mismatch_parts(
    faults: Sequence[tuple[Mismatch, Case]], weak: Sequence[Sensitivity], settings: Settings, figure: Path
) -> list[str]:
    """Paragraphs, tables and the figure of the recoveries."""
    return [
        f"S = {PIXELS['bright'][0]:g}, {settings.fault_realizations:,} realizations of {settings.fault_cycles:,} "
        f"cycles. "
        "The verdict is that of `mars-lidar validate` at 1 % false alarms; *failed* lists the tests that failed. Where "
        "the detector is *told*, effects and all, calibration and prediction are made with it: by the laws that there "
        "are, else by simulation with the exact engine, and the stream should fit.",
        table([_fault_row(one, case) for one, case in faults]),
        _fault_finding(faults),
        "What the recovery says of detectors that are not told, where it says something:",
        "\n".join(f"- {case.name}: {text}." for _, case in faults for text in case.findings),
        "Recovery: registrations by time since the last one, over the light that fell on the pixel at that age; "
        "the vertical line is the dead time that was assumed, the stepped one the recovery of the simulated stream.",
        f"![{figure.stem}]({figure.name})",
        "### How weak a mismatch is seen",
        f"Streams of the same length, S = {PIXELS['bright'][0]:g}, pulse and dead time of 85 ns told and nothing more. "
        "*Refused* at 1 % false alarms of all tests together; *B is off* in standard errors of the calibration, in the "
        "mean: the harm that passes.",
        table([_weak_row(one) for one in weak]),
    ]


def _weak_row(one: Sensitivity) -> Row:
    by = sorted(one.by.items(), key=lambda item: -item[1])
    return {
        "detector": one.name,
        "B": f"{one.background:g}",
        "streams": one.streams,
        "refused": one.refused,
        "B is off": f"{one.score:+.1f}",
        "by": "; ".join(f"{name} ({times})" for name, times in by) or "-",
    }


def _fault_row(one: Mismatch, case: Case) -> Row:
    found = case.found
    light = found.calibration
    told = [check.name for check in found.failed]
    told += ["short intervals"] * found.too_short
    return {
        "detector": one.name,
        "dead time (ns)": light.dead_time_ns,
        "S": light.signal,
        "B": light.background,
        "true B": case.truth[1],
        "z S": f"{case.scores[0]:+.1f}",
        "z B": f"{case.scores[1]:+.1f}",
        "TV / floor": case.ratio,
        "verdict": case.verdict,
        "predicted by": found.prediction.words,
        "failed": "; ".join(told) or "-",
    }


def _fault_finding(faults: Sequence[tuple[Mismatch, Case]]) -> str:
    lines = []
    wrong = [case.name for one, case in faults if not one.fits and case.found.consistent]
    alarms = [case for one, case in faults if one.fits and not case.found.consistent]
    number = sum(not one.fits for one, _ in faults)
    lines.append(f"- {number - len(wrong)} of {number} mismatches are told apart from the model.")
    for name in wrong:
        case = next(case for _, case in faults if case.name == name)
        lines.append(
            f"- **Not told apart**: {name}. The model with S = {case.found.calibration.signal:.4f} and B = "
            f"{case.found.calibration.background:.4f} passes all tests at this length; the light is off by "
            f"{case.scores[0]:+.1f} and {case.scores[1]:+.1f} standard errors, so a fit is no proof of the detector."
        )
    right = sum(one.fits for one, _ in faults)
    for case in alarms:
        by = "; ".join(f"{check.name} (p = {check.p:.1g})" for check in case.found.failed)
        lines.append(
            f"- **False alarm**: {case.name}, by {by}. "
            f"Of {right} streams that should fit, each is refused with a probability of 1 %."
        )
    below = [case.name for one, case in faults if not case.found.consistent and case.ratio < AT_FLOOR]
    lines.append(
        f"- Total variation of the count law alone is within {AT_FLOOR} floors in {len(below)} of the streams "
        f"that do not fit "
        f"({'; '.join(below)}): by itself it is a weak test, because S and B are fitted to the same stream."
    )
    return "\n".join(lines)
