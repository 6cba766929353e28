"""What is timed: every engine that draws any system, and the paper's pipeline in NumPy, behind one call."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

from numpy.typing import NDArray

from benchmarks.numpy_pipeline import NumpyTable, synthesize
from mars_lidar import Flux, System, Table, simulate
from mars_lidar.engines import ANY_SYSTEM, Engine, MarsEngine

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


class Tables:
    """Tables of so many points in S and B; one serves other numbers of cycles where it holds for them."""

    def __init__(self, points: tuple[int, int]) -> None:
        self._points = points
        self._table: Table | None = None
        self._numpy: NumpyTable | None = None

    def get(self, system: System) -> Table:
        """For `system`."""
        held = self._table
        if held is None or held.system.replace(cycles=system.cycles) != system or not held.serves(system.cycles):
            low, high = TABLE_RANGE
            held = Table.build(system, (low, high, self._points[0]), (low, high, self._points[1]))
            self._table = held
        return held

    def numpy(self, system: System) -> NumpyTable:
        """The same for the pipeline in NumPy; one is held at a time, a full one takes 210 MB."""
        if self._numpy is None or self._numpy.system != system:
            self._numpy = NumpyTable.of(self.get(system), system)
        return self._numpy


def contenders(tables: Tables) -> list[Contender]:
    """All of them; those that need a table share it."""

    def tabled(flux: Flux, system: System, realizations: int) -> Run:
        return _engine(MarsEngine(tables.get(system), outside="exact"), flux, system, realizations)

    def numpy(flux: Flux, system: System, realizations: int) -> Run:
        return partial(_pipeline, tables.numpy(system), flux)

    results = [
        Contender(name, "mars, no table" if name == "mars" else name, partial(_engine, name)) for name in ANY_SYSTEM
    ]
    results.append(Contender(TABLED, "mars, table", tabled, tabled=True))
    return [*results, Contender(NUMPY, "MaRS pipeline in NumPy, table", numpy, tabled=True)]


def _engine(engine: str | Engine, flux: Flux, system: System, realizations: int) -> Run:
    def run(seed: int, out: NDArray[Any]) -> dict[str, float]:
        report: dict[str, float] = {}
        simulate(flux, system, engine=engine, realizations=realizations, seed=seed, out=out, report=report)
        return stages_of(report)

    return run


def _pipeline(table: NumpyTable, flux: Flux, seed: int, out: NDArray[Any]) -> dict[str, float]:
    stages: dict[str, float] = {}
    synthesize(table, flux, out, seed=seed, stages=stages)
    return stages


def stages_of(report: dict[str, float]) -> dict[str, float]:
    """Seconds by stage out of what an engine reports: its entries that end in "_s"."""
    return {key[:-2]: value for key, value in report.items() if key.endswith("_s")}
