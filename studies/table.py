"""Errors of lookup tables: interpolation, start phase and count law against the exact law of each pixel."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mars_lidar.instrument.pulse import GaussianPulse
from mars_lidar.instrument.system import Detector, System
from mars_lidar.table import LawError, QuantisationError, Table
from mars_lidar.table.axes import PAPER_GRID
from studies import Request
from studies.report import Row, configuration, save_csv, save_text, table

_PERIOD_NS = 1e3 / 7.5
_SEED = 20263
_SAMPLES, _LAWS = 400, 60
_CASES: tuple[Mapping[str, Any], ...] = (
    {"dead_time_ns": 75.0},
    {"dead_time_ns": 85.0},
    {"dead_time_ns": 85.0, "start": "stationary"},
    {"dead_time_ns": 85.0, "method": "mars"},
    {"dead_time_ns": 13.0},
    {"dead_time_ns": 130.2},
    {"dead_time_ns": 75.0, "cycles": 20},
)


@dataclass(frozen=True, eq=False)
class Case:
    """One table, and its errors between entries."""

    system: System
    table: Table
    errors: tuple[QuantisationError, QuantisationError]
    law: LawError

    def content(self) -> Row:
        """A line of the first table."""
        kept, phases = self.table, self.table.start_phases
        enough = kept.entries.enough
        return {
            **self._name(),
            "entries": f"{kept.signal.size} x {kept.background.size}",
            "MB": kept.nbytes / 1e6,
            "shapes, MB": kept.entries.shape.nbytes / 1e6,
            "phases": phases.phase.size,
            "(S, B) of the phases": f"{phases.signal.size} x {phases.background.size}",
            "unsettled": int((enough < 0).sum()),
            "others serve from N_r =": int(enough.max()),
        }

    def quantisation(self) -> list[Row]:
        """Lines of the second table: bilinear, nearest."""
        return [
            {
                **self._name(),
                "interpolation": e.interpolation,
                "mean rms": e.mean_rms,
                "mean max": e.mean_max,
                "variance max": e.variance_max,
                "third max": e.third_max,
                "fourth max": e.fourth_max,
                "shape mean": e.shape_mean,
                "shape max": e.shape_max,
                "delayed: mean max": e.delayed_mean_max,
                "delayed: variance max": e.delayed_variance_max,
                "delayed: shape max": e.delayed_shape_max,
            }
            for e in self.errors
        ]

    def exposures(self) -> Row:
        """A line of the third table: what becomes of the mean's error in longer exposures."""
        made = self.table.provenance["error_longest"]
        longest = None if made is None else QuantisationError(**made)
        return {
            **self._name(),
            "mean max": max(self.errors[0].mean_max, self.errors[0].delayed_mean_max),
            "at 1e8 cycles": "not served" if longest is None else max(longest.mean_max, longest.delayed_mean_max),
            "variance max": "" if longest is None else max(longest.variance_max, longest.delayed_variance_max),
            "within 0.05 up to": "" if longest is None else longest.cycles_within(0.05),
        }

    def laws(self) -> Row:
        """A line of the last table."""
        return {
            **self._name(),
            "TV mean": self.law.mean,
            "TV max": self.law.largest,
            "within 0.002": self.law.within,
            "trusted": self.law.trusted,
            "TV max of those": self.law.largest_trusted,
            "worst S": self.law.worst_signal,
            "worst B": self.law.worst_background,
        }

    def _name(self) -> Row:
        return {
            "t_d, ns": self.system.detector.dead_time_ns,
            "start": self.system.start,
            "method": self.table.method,
            "N_r": self.system.cycles,
        }


def run(request: Request) -> list[Path]:
    """Build the tables, measure, write ``table.md`` and ``table.csv``."""
    grids = dict(PAPER_GRID)
    samples, laws = _SAMPLES, _LAWS
    if request.quick:
        grids, samples, laws = {"signal": (0.01, 10.0, 24), "background": (0.01, 10.0, 16)}, 20, 4
    cases = []
    for case in _CASES[: 1 if request.quick else None]:
        cases.append(_measure(case, grids, samples, laws))
        request.tell(f"table: {case}")
    rows = [row for case in cases for row in case.quantisation()]
    settings = {
        "command": "`python -m studies table`" + (" --quick" if request.quick else ""),
        "system": "t_r = 133.33 ns, N_r = 1000 unless said, 1024 bins, Gaussian pulse of sigma = 0.5 ns",
        "axes (low, high, points), and 0": ", ".join(f"{name} {grid}" for name, grid in grids.items()),
        "pixels": f"{samples} for the cumulants and the shape, {laws} for the count law, seed {_SEED}",
    }
    text = [
        "# Lookup tables: what they hold, and their errors",
        configuration(settings),
        "Random pixels between the entries, log-uniform in S and B (with bilinear interpolation one in eight of each "
        "between 0 and the lowest value), each against its own exact law. Errors of cumulants are in powers of the "
        "standard deviation, at least half a count; shapes and laws in total variation. *Delayed*: at random delays, "
        "where the exposure begins and ends at another phase. Method `mars` is measured against itself in the second "
        "table and against the exact law in the third.",
        "## Content",
        table([case.content() for case in cases]),
        "## Between the entries",
        table(rows),
        "## In longer exposures",
        "Errors of the mean in standard deviations grow as the root of the number of cycles; those of the variance and "
        "of the shape do not. Bilinear, at N_r and measured again at 1e8 cycles.",
        table([case.exposures() for case in cases]),
        "## Count law: four cumulants from the table against the exact law at the pixel's delay",
        table([case.laws() for case in cases]),
    ]
    return [save_text(request.out / "table.md", text), save_csv(request.out / "table.csv", rows)]


def _measure(case: Mapping[str, Any], grids: Mapping[str, tuple[float, float, int]], samples: int, laws: int) -> Case:
    system = System(
        period_ns=_PERIOD_NS,
        cycles=case.get("cycles", 1000),
        bins=1024,
        pulse=GaussianPulse(sigma_ns=0.5),
        detector=Detector(dead_time_ns=case["dead_time_ns"]),
        start=case.get("start", "armed"),
    )
    built = Table.build(system, grids["signal"], grids["background"], method=case.get("method", "exposure"))
    return Case(
        system,
        built,
        (
            built.quantisation_error(samples=samples, seed=_SEED),
            built.quantisation_error(interpolation="nearest", samples=samples, seed=_SEED),
        ),
        built.law_error(samples=laws, seed=_SEED),
    )
