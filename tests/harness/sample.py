"""What an engine drew for a case."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from harness.cases import Case
from mars_lidar.engines.engine import Engine, PhaseRecords, Records, Task
from mars_lidar.instrument.system import System


@dataclass(frozen=True, eq=False)
class Sample:
    """Independent exposures of one pixel: histograms (items, bins), and the registrations if asked for."""

    cube: NDArray[np.int64]
    records: Records | PhaseRecords | None = None

    @cached_property
    def counts(self) -> NDArray[np.int64]:
        """Registrations of each exposure (items,)."""
        return self.cube.sum(1)

    def intervals(self) -> tuple[NDArray[np.intp], NDArray[np.float64]]:
        """The exposure of each pair of successive registrations, and the time between them in periods.

        Blurred by 1e-6 periods: phases may be float32, and quantiles of a narrow pulse would show it.
        """
        assert self.records is not None
        item = np.repeat(np.arange(len(self.cube)), np.diff(self.records.offsets))
        inside = item[1:] == item[:-1]
        length = np.diff(self.records.times)[inside]
        return item[1:][inside], length + np.random.default_rng(0).uniform(-1e-6, 1e-6, length.size)


def task_of(case: Case, seed: int, *, realizations: int | None = None, system: System | None = None) -> Task:
    """The case as a request; its pixels are alike, so that its items are independent exposures of one."""
    pixels = case.flux.shape[0] * case.flux.shape[1]
    number = case.items // pixels if realizations is None else realizations
    index = np.arange(pixels, dtype=np.uint32)
    return Task(case.flux, system or case.system, number, 0, index, seed, 2, None)


def draw(engine: Engine, case: Case, seed: int, *, times: bool = False) -> Sample:
    """`case.items` exposures.

    With `times` the registrations are drawn and binned; histograms of the same seed must agree with them.
    """
    task = task_of(case, seed)
    bins = case.system.bins
    if not times:
        out = np.empty((task.items, bins), case.system.histogram_dtype)
        engine.histogram(task, out)
        return Sample(out.astype(np.int64))
    records = engine.records(task, 0.0)
    item = np.repeat(np.arange(task.items), np.diff(records.offsets))
    cube = np.bincount(item * bins + records.bin, minlength=task.items * bins).reshape(task.items, bins)
    some = task_of(case, seed, realizations=min(16, task.realizations))
    out = np.empty((some.items, bins), case.system.histogram_dtype)
    engine.histogram(some, out)
    assert np.array_equal(out, cube[: some.items]), "histograms and timestamps of one seed disagree"
    return Sample(cube, records)
