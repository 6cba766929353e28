"""The renewal baseline of the MaRS paper: the shape of the chain, and the count law of a constant rate."""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from mars_lidar._base.types import FloatArray, IndexArray, NDArray
from mars_lidar.engines.engine import Interpolation, Outside
from mars_lidar.engines.pixels import Alignment, Group, groups, single_return
from mars_lidar.engines.synthesis import Batch, CountLaws, RoundedGaussian, Run
from mars_lidar.engines.table_reader import CountTimesShape, PixelEntries, TableReader, as_shapes
from mars_lidar.instrument.system import System
from mars_lidar.statistics.constant_light import renewal_moments
from mars_lidar.statistics.histogram import chain_of
from mars_lidar.table.table import Table


class RenewalEngine(CountTimesShape):
    """N from the Gaussian law of a constant-rate renewal process of equal energy, Multinomial(N, pi) from the chain.

    The baseline "Renewal" of the MaRS paper (arXiv 2512.04924): mean t lambda / (1 + lambda t_d) and variance
    t lambda / (1 + lambda t_d)^3 with lambda = (S + B) / t_r, rounded to integers and at least 0; pi the stationary
    distribution of the Markov chain of phases (arXiv 2509.20500). Mean and variance are wrong for
    pulsed light; the shape is right for an exposure that is long or has a stationary start.

    Parameters
    ----------
    table
        `mars_lidar.Table` of this system, whose shapes (of either method) replace those of the chain, see
        `MarsEngine`. None: the chain is solved for every distinct (S, B), which takes some milliseconds each.
    interpolation, outside
        As for `MarsEngine`; for pixels beyond the grid the chain is solved.
    level
        Forces one of ``_core.levels()`` (vector widths); it changes speed only.

    Raises
    ------
    TypeError
        `table` is not a `Table`.
    ValueError
        An unknown `interpolation`, `outside` or `level`; options of a table without a table.

    See Also
    --------
    MarsEngine, mars_lidar.simulate

    Examples
    --------
    >>> import mars_lidar as ml
    >>> system = ml.System(
    ...     period_ns=100.0, cycles=1000, bins=128,
    ...     pulse=ml.GaussianPulse(sigma_ns=1.0), detector=ml.Detector(dead_time_ns=75.0),
    ... )
    >>> engine = ml.engines.RenewalEngine()
    >>> ml.simulate(ml.Flux(1.0, 1.0, 40.0), system, engine=engine, seed=0).shape
    (1, 1, 1, 128)
    """

    name = "renewal"
    description = "constant-rate renewal count law x the chain's shape: a baseline"
    options: ClassVar[tuple[str, ...]] = ("table", "interpolation", "outside")

    def __init__(
        self,
        table: Table | None = None,
        *,
        interpolation: Interpolation | None = None,
        outside: Outside | None = None,
        level: str = "",
    ) -> None:
        super().__init__(table, interpolation, outside, level)

    def _laws_of(self, run: Run, reader: TableReader, entries: PixelEntries) -> CountLaws:
        return _laws(run.task.system, entries.signal, entries.background)

    def _evaluate(self, run: Run, pixels: IndexArray) -> None:
        """The chain of each distinct pixel; one return is solved at the canonical delay and moved."""
        run.count("pixels_evaluated", pixels.size)
        task = run.task
        single = single_return(task.flux)
        for group in groups(task.flux, task.system, pixels, delays=single is None):
            with run.stage("evaluation_s"):
                shapes, rates = _chains(run, group)
                alignment = None
                signal, background = group.cells.signal[group.cell], group.cells.background[group.cell]
                if single is not None:
                    delay, rate = single[1][group.pixels], rates[group.cell]
                    alignment = Alignment.of(task.system, signal, background, delay, rate)
                laws = _laws(task.system, signal, background)
                batch = Batch.unmixed(group.pixels, shapes, group.cell, laws, alignment)
            run.draw(batch)


def _laws(system: System, signal: FloatArray, background: FloatArray) -> CountLaws:
    return RoundedGaussian(*renewal_moments(signal + background, system))


def _chains(run: Run, group: Group) -> tuple[NDArray[np.float32], FloatArray]:
    """Shapes (cells, bins) and registrations per period (cells,)."""
    cells, system = group.cells, run.task.system
    shapes, rates = np.zeros((cells.size, system.bins)), np.zeros(cells.size)
    for k in range(cells.size):
        if run.waiting is not None:
            run.waiting(k, cells.size)
        chain = chain_of(cells, k)
        if chain is not None:
            stationary = chain.stationary()
            shapes[k], rates[k] = stationary.pdf.reshape(system.bins, -1).sum(-1), stationary.rate
    return as_shapes(shapes), rates
