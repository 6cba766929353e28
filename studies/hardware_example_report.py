"""The report on hardware: a measured stream, and what of it does not fit."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from studies.hardware import FULL, Example, Settings
from studies.report import table


def example_parts(found: Example | None, settings: Settings, figures: Sequence[Path]) -> list[str]:
    """Paragraphs, table and figure; `found` is None where no stream is given."""
    if found is None:
        return ["## A measured stream", "Not given: `--stream FILE` adds it."]
    told = ", ".join(f"{name} {value:.4g} ns" for name, value in found.told.items())
    rows = [
        {
            "calibration": name,
            "dead time (ns)": case.calibration.dead_time_ns,
            "Lambda": f"{case.calibration.total:.3f} ± {case.calibration.total_error:.3f}",
            "by Rapp": f"{case.calibration.rapp.total:.3f} ± {case.calibration.rapp.total_error:.3f}",
            "photons used": case.calibration.armed.used,
            "TV": case.total_variation,
            "floor": case.total_variation_floor[0],
            "failed": "; ".join(check.name for check in case.failed) or "-",
            "verdict": "fits" if case.consistent else "does not fit",
        }
        for name, case in found.cases
    ]
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
        f"![{figures[3].stem}]({figures[3].name})",
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
        trace = (
            "is seen in the recovery"
            if any(case.recovery.findings() for case in free)
            else ("leaves no trace in the recovery of so few photons")
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
