"""Study "table": errors of lookup tables against the exact law of each pixel."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mars_lidar import QuantisationError, System, Table
from mars_lidar.table import LawError
from mars_lidar.table.axes import PAPER_GRID
from studies import Request
from studies.common.report import Row, picked, write
from studies.common.sample import system_of

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
        at_delay = "mean_rms mean_max variance_max third_max fourth_max shape_mean shape_max"
        delayed = "delayed_mean_max delayed_variance_max delayed_shape_max"
        found = [picked(errors, f"interpolation {at_delay} {delayed}") for errors in self.errors]
        return [
            self._name() | {key.replace("delayed_", "delayed: ").replace("_", " "): v for key, v in row.items()}
            for row in found
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

    def _name(self) -> dict[str, Any]:
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
    facts = {
        "grids": grids,
        "samples": samples,
        "laws": laws,
        "content": [case.content() for case in cases],
        "rows": rows,
        "exposures": [case.exposures() for case in cases],
        "count_laws": [case.laws() for case in cases],
    }
    return write(request, "table", __name__, "report", facts, rows=rows)


def _measure(case: Mapping[str, Any], grids: Mapping[str, tuple[float, float, int]], samples: int, laws: int) -> Case:
    system = system_of(case["dead_time_ns"], case.get("cycles", 1000), start=case.get("start", "armed"))
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
