"""Cases for the feedback engine, and an engine that fails where it does not sample itself."""

from typing import Any

import numpy as np
from harness import PERIOD_NS, Case, flux_of, make_system, task_of, two_lobes
from numpy.typing import NDArray

from mars_lidar import SampledPulse
from mars_lidar.engines.engine import Task
from mars_lidar.engines.feedback import FeedbackEngine, Grids, KindArray

GIVEN = "pixels given to exact"
SAMPLED = SampledPulse(two_lobes(), 0.1, "centroid")


class Sampler(FeedbackEngine):
    """The feedback engine that fails where it would give a pixel to the exact engine."""

    def histogram(self, task: Task, out: NDArray[Any]) -> None:
        super().histogram(task, out)
        assert task.report[GIVEN] == 0


def case(
    signal: float,
    background: float,
    dead: float,
    cycles: int,
    *,
    delay: float = 0.37,
    sigma: float = 0.01,
    items: int = 4000,
    **changes: Any,
) -> Case:
    system = make_system(dead * PERIOD_NS, cycles, 128, sigma_ns=sigma * PERIOD_NS).replace(**changes)
    name = f"S {signal:g}, B {background:g}, t_d {dead:g}, {cycles} cycles, {system.start}"
    return Case(name, flux_of(signal, background, delay), system, items)


def kinds_of(request: Case) -> KindArray:
    """Halvings of the bins in the engine's grid of the case's one pixel."""
    grids = Grids.checked(task_of(request, 1, realizations=1), np.arange(1))
    return grids.kinds[grids.of[0]]


def drawn(engine: Any, request: Case, seed: int = 1) -> NDArray[np.int64]:
    task = task_of(request, seed)
    out = np.empty((task.items, request.system.bins), request.system.histogram_dtype)
    engine.histogram(task, out)
    return out.astype(np.int64)
