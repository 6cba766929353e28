"""Study "table": errors of lookup tables against the exact law of each pixel."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from mars_lidar import QuantisationError, Table
from mars_lidar.table.axes import PAPER_GRID
from studies import Facts, Request
from studies.common.report import Row
from studies.common.sample import system_of
from studies.table.law import LawError, law_error

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
_AT_DELAY = "interpolation mean_rms mean_max variance_max third_max fourth_max shape_mean shape_max"
_DELAYED = "delayed_mean_max delayed_variance_max delayed_shape_max"
_COLUMNS = {key: key.replace("delayed_", "delayed: ").replace("_", " ") for key in f"{_AT_DELAY} {_DELAYED}".split()}


@dataclass(frozen=True, eq=False)
class Case:
    """One table, and its errors between entries: bilinear, nearest."""

    table: Table
    errors: tuple[QuantisationError, QuantisationError]
    law: LawError

    def quantisation(self) -> list[Row]:
        """Lines of the second table."""
        system = self.table.system
        name = {
            "t_d, ns": system.detector.dead_time_ns,
            "start": system.start,
            "method": self.table.method,
            "N_r": system.cycles,
        }
        return [name | {words: getattr(errors, key) for key, words in _COLUMNS.items()} for errors in self.errors]

    @property
    def longest(self) -> QuantisationError | None:
        """The errors at 1e8 cycles, where every entry serves them."""
        made = self.table.provenance["error_longest"]
        return None if made is None else QuantisationError(**made)


def run(request: Request) -> Facts:
    """All tables, built and measured."""
    grids = dict(PAPER_GRID)
    samples, laws = _SAMPLES, _LAWS
    if request.quick:
        grids, samples, laws = {"signal": (0.01, 10.0, 24), "background": (0.01, 10.0, 16)}, 20, 4
    cases = []
    for case in _CASES[: 1 if request.quick else None]:
        system = system_of(case["dead_time_ns"], case.get("cycles", 1000), start=case.get("start", "armed"))
        table = Table.build(system, grids["signal"], grids["background"], method=case.get("method", "exposure"))
        errors = (
            table.quantisation_error(samples=samples, seed=_SEED),
            table.quantisation_error(interpolation="nearest", samples=samples, seed=_SEED),
        )
        cases.append(Case(table, errors, law_error(table, laws, _SEED)))
        request.tell(f"table: {case}")
    return {
        "grids": grids,
        "samples": samples,
        "laws": laws,
        "cases": cases,
        "rows": [row for case in cases for row in case.quantisation()],
    }
