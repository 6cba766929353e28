"""What is timed: every engine of the registry, and the paper's pipeline in NumPy, behind one call."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from numpy.typing import NDArray

from mars_lidar.engines import ENGINES
from mars_lidar.flux import Flux
from mars_lidar.simulate import simulate
from mars_lidar.studies.numpy_pipeline import NumpyTable, Stages, synthesize
from mars_lidar.system import System

Run = Callable[[int, NDArray[Any]], dict[str, float]]  # seed, memory for the cube -> seconds of stages
TABLE_RANGE = (0.01, 10.0)  # photons per period, of both axes of the tables
NUMPY, TABLED = "numpy", "mars, table"


@dataclass(frozen=True)
class Contender:
    """A simulator by name; `prepare` makes what a run needs beforehand, which is not timed with it."""

    name: str
    words: str
    prepare: Callable[[Flux, System, int], Run]
    tabled: bool = False

    def takes(self, flux: Flux) -> bool:
        """Whether the flux lies within its table."""
        if not self.tabled:
            return True
        low, high = TABLE_RANGE
        fluxes = (flux.signal, flux.background)
        return bool(min(f.min() for f in fluxes) >= low and max(f.max() for f in fluxes) <= high)


def contenders(points: tuple[int, int]) -> list[Contender]:
    """All of them, slowest last; tables of so many points in S and B."""
    engines = [Contender(name, _words(name), _engine(name)) for name in ENGINES]
    return [*engines, Contender(NUMPY, "MaRS pipeline in NumPy, table", _numpy(points), tabled=True)]


def _words(engine: str) -> str:
    return "mars, no table" if engine == "mars" else engine


def _engine(name: str) -> Callable[[Flux, System, int], Run]:
    def prepare(flux: Flux, system: System, realizations: int) -> Run:
        def run(seed: int, out: NDArray[Any]) -> dict[str, float]:
            report: dict[str, float] = {}
            simulate(flux, system, engine=name, realizations=realizations, seed=seed, out=out, report=report)
            return stages_of(report)

        return run

    return prepare


def stages_of(report: dict[str, float]) -> dict[str, float]:
    """Seconds by stage out of what an engine reports: its entries that end in "_s"."""
    return {key[:-2]: value for key, value in report.items() if key.endswith("_s")}


def _numpy(points: tuple[int, int]) -> Callable[[Flux, System, int], Run]:
    tables: dict[System, NumpyTable] = {}

    def prepare(flux: Flux, system: System, realizations: int) -> Run:
        if system not in tables:
            tables.clear()  # one at a time: a full table takes 210 MB
            low, high = TABLE_RANGE
            tables[system] = NumpyTable.build(system, (low, high, points[0]), (low, high, points[1]))
        table = tables[system]

        def run(seed: int, out: NDArray[Any]) -> dict[str, float]:
            stages = Stages()
            synthesize(table, flux, realizations=realizations, seed=seed, stages=stages, out=out)
            return stages.seconds

        return run

    return prepare
