"""Study "table": errors of lookup tables against the exact law of each pixel."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from mars_lidar import QuantisationError, System, Table
from mars_lidar.table import LawError
from mars_lidar.table.axes import PAPER_GRID
from studies import Facts, Request
from studies.common.report import Row, picked
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

    def quantisation(self) -> list[Row]:
        """Lines of the second table: bilinear, nearest."""
        at_delay = "mean_rms mean_max variance_max third_max fourth_max shape_mean shape_max"
        delayed = "delayed_mean_max delayed_variance_max delayed_shape_max"
        found = [picked(errors, f"interpolation {at_delay} {delayed}") for errors in self.errors]
        return [
            self._name() | {key.replace("delayed_", "delayed: ").replace("_", " "): v for key, v in row.items()}
            for row in found
        ]

    @property
    def longest(self) -> QuantisationError | None:
        """The errors at 1e8 cycles, where every entry serves them."""
        made = self.table.provenance["error_longest"]
        return None if made is None else QuantisationError(**made)

    def _name(self) -> dict[str, Any]:
        return {
            "t_d, ns": self.system.detector.dead_time_ns,
            "start": self.system.start,
            "method": self.table.method,
            "N_r": self.system.cycles,
        }


def run(request: Request) -> Facts:
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
    return {
        "grids": grids,
        "samples": samples,
        "laws": laws,
        "cases": cases,
        "rows": rows,
    }


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
