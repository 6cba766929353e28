"""The engine of the MaRS paper: a count from its law, its registrations from the shape of the mean histogram."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray

from mars_lidar import _validate
from mars_lidar.engines._alignment import Alignment
from mars_lidar.engines._counts import CountLaws, Matched, Poisson, RoundedGaussian, Tabulated
from mars_lidar.engines._pixels import Group, groups, single_return
from mars_lidar.engines._synthesis import Batch, Run
from mars_lidar.engines._table import check_table, table_record
from mars_lidar.engines.base import Engine, Task
from mars_lidar.flux import Flux
from mars_lidar.system import System

if TYPE_CHECKING:
    from mars_lidar.table import Table

FloatArray = NDArray[np.float64]
IndexArray = NDArray[np.int64]

_COUNTS = ("exact", "gaussian")
_INTERPOLATIONS = ("bilinear", "nearest")
_PIXELS = 2**17  # looked up at a time: 14 MiB


class MarsEngine(Engine):
    """Whole histograms from two statistics of a pixel: N from the count law, Multinomial(N, pi) from the shape pi.

    arXiv 2512.04924, with the finite exposure's exact statistics in place of the stationary chain's. The law of the
    count and the mean histogram are right; *the joint law of the bins is not*, because successive registrations
    repel each other: the variance of a window of bins is off by up to a factor of two.

    Parameters
    ----------
    table
        `mars_lidar.Table` of this system (any number of cycles): cumulants and shapes are interpolated in (S, B),
        the shape is moved to the pixel's delay to a fraction of a bin. Pixels outside of its grid are evaluated
        as without a table, and counted in the report. None: every distinct (S, B, delay), or waveform, is
        evaluated by itself, exactly, which takes from a millisecond to some ten of them each.
    count
        ``"exact"``: the exact law without a table; with one the discrete law of the table's four cumulants.
        ``"gaussian"``: the paper's, a rounded normal number of the right mean and variance, at least 0. Rounding
        adds up to 1/12 to the variance, which spoils pixels locked to the laser (variances down to 0.04).
    interpolation
        ``"bilinear"`` in (log S, log B), or ``"nearest"`` grid point, which is the paper's.
    level
        Forces one of ``_core.levels()`` (vector widths); it changes speed only.
    """

    name = "mars"
    description = "count law x mean histogram, cost flat in the exposure; bins are not correlated as they should be"
    options: ClassVar[tuple[str, ...]] = ("table", "count", "interpolation")

    def __init__(
        self,
        table: Table | None = None,
        *,
        count: Literal["exact", "gaussian"] = "exact",
        interpolation: Literal["bilinear", "nearest"] | None = None,
        level: str = "",
    ) -> None:
        self.table = check_table(table)
        self.count = _validate.choice("count", count, _COUNTS)
        if interpolation is not None and table is None:
            raise ValueError(f"interpolation must be None without a table, got {interpolation!r}")
        self.interpolation = _validate.choice(
            "interpolation", "bilinear" if interpolation is None else interpolation, _INTERPOLATIONS
        )
        self.level = level

    @property
    def settings(self) -> dict[str, Any]:
        """What the cube depends on, for its file."""
        if self.table is None:
            return {"count": self.count}
        return {"count": self.count, "interpolation": self.interpolation, "table": table_record(self.table)}

    def check(self, flux: Flux, system: System) -> None:
        """A table must belong to the system, and knows one return a pixel."""
        if self.table is not None:
            check_table(self.table, system)
            if single_return(flux) is None:
                what = "a waveform" if flux.waveform is not None else "several returns in a pixel"
                raise ValueError(f"flux must have one return a pixel for a table, got {what}; leave the table out")

    def histogram(self, task: Task, out: NDArray[Any]) -> None:
        """Batch by batch: look up, draw the counts, draw their places."""
        run = Run(task, out, self.level)
        pixels = np.arange(task.pixel_index.size)
        if self.table is None:
            self._evaluate(run, pixels)
            return
        left = [self._from_table(run, pixels[k : k + _PIXELS]) for k in range(0, pixels.size, _PIXELS)]
        self._evaluate(run, np.concatenate(left))

    def _from_table(self, run: Run, pixels: IndexArray) -> IndexArray:
        """Draws those that lie on the grid; returns the others."""
        task, table = run.task, self.table
        found = single_return(task.flux)
        assert table is not None and found is not None
        with run.stage("lookup_s"):
            system = task.system
            signal, delay = found[0][pixels], found[1][pixels]
            background = np.ascontiguousarray(task.flux.background.reshape(-1)[pixels])
            look = table.lookup(
                signal,
                background,
                delay_ns=delay,
                cycles=system.cycles,
                interpolation=self.interpolation,
                outside="exact",
            )
            inside = ~look.outside
            # neighbours on the grid follow each other, so that their rows are still in the processor's cache
            order = np.flatnonzero(inside)
            order = order[np.argsort(look.rows[order, 0], kind="stable")]
            cumulants = look.cumulants[order]
            rate = cumulants[:, 0] / system.cycles
            batch = Batch(
                pixels[order],
                table.shapes(system.cycles),
                look.rows[order],
                look.weights[order],
                self._laws(system, cumulants),
                Alignment.of(system, signal[order], background[order], delay[order], rate),
            )
        run.draw(batch)
        return np.asarray(pixels[~inside])

    def _laws(self, system: System, cumulants: FloatArray) -> CountLaws:
        if self.count == "gaussian":
            return RoundedGaussian(cumulants[:, 0].copy(), cumulants[:, 1].copy())
        if system.dead_time_periods == 0.0:
            return Poisson(cumulants[:, 0].copy())
        return Matched(cumulants)

    def _evaluate(self, run: Run, pixels: IndexArray) -> None:
        """The exact statistics of each distinct pixel, at its own delay."""
        run.count("pixels_evaluated", pixels.size)
        if pixels.size == 0:
            return
        for group in groups(run.task.flux, run.task.system, pixels):
            with run.stage("evaluation_s"):
                batch = self._evaluated(run, group)
            run.draw(batch)

    def _evaluated(self, run: Run, group: Group) -> Batch:
        from mars_lidar.statistics._pmf import exact_windows
        from mars_lidar.statistics.exposure import refined_moments

        system, cells = run.task.system, group.cells
        exposure = refined_moments(
            cells, system.bins, tolerance=1e-4, threads=run.task.threads, progress=run.waiting
        )
        cumulants = exposure.cumulants.reshape(-1, 4)
        laws: CountLaws
        if self.count == "gaussian":
            laws = RoundedGaussian(cumulants[group.cell, 0], cumulants[group.cell, 1])
        elif system.dead_time_periods == 0.0:
            laws = Poisson(cumulants[group.cell, 0])
        else:
            windows = exact_windows(cells, cumulants, exposure.bins.reshape(-1), run.task.threads)
            laws = Tabulated.of(windows, group.cell)
        return Batch.unmixed(group.pixels, normalised(exposure.histogram), group.cell, laws)


def normalised(histogram: FloatArray) -> NDArray[np.float32]:
    """Shapes (cells, bins) of sum 1; uniform where nothing registers."""
    flat = histogram.reshape(-1, histogram.shape[-1])
    total = flat.sum(-1, keepdims=True)
    dark = total == 0.0
    shape = np.where(dark, 1.0 / flat.shape[-1], flat / np.where(dark, 1.0, total))
    return np.ascontiguousarray(shape.astype(np.float32))
