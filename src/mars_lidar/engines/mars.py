"""The engine of the MaRS paper: a count from its law, registrations from the shape of the mean histogram."""

from __future__ import annotations

from typing import Any, ClassVar

from mars_lidar._base import checks
from mars_lidar._base.types import FloatArray, IndexArray
from mars_lidar.engines import synthesis
from mars_lidar.engines.engine import Count, Interpolation, Outside
from mars_lidar.engines.pixels import Group, groups
from mars_lidar.engines.table_reader import CountTimesShape, PixelEntries, TableReader, as_shapes, exact_laws, untrusted
from mars_lidar.instrument.effects import LIGHT_EFFECTS, TIMING_EFFECTS
from mars_lidar.instrument.system import System
from mars_lidar.statistics.moments import recorded_moments
from mars_lidar.statistics.pmf import exact_pmfs
from mars_lidar.statistics.tolerances import TOL
from mars_lidar.table.table import Table

_COUNTS = ("exact", "matched", "gaussian")


class MarsEngine(CountTimesShape):
    """Whole histograms from two statistics of a pixel: N from the count law, Multinomial(N, pi) from the shape pi.

    The method of arXiv 2512.04924, with the exact statistics of the finite exposure in place of those of the stationary
    chain. The law of the count and the mean histogram are exact; *the joint law of the bins is not*, because
    registrations are at least a dead time apart: the variance of the count around the return is off by factors of 0.87
    to 2.4 (docs/results/joint_table.md).

    Parameters
    ----------
    table
        `mars_lidar.Table` of this system (any number of cycles): cumulants and shapes are interpolated in (S, B),
        the shape is moved to the pixel's delay to a fraction of a bin. None: every distinct (S, B, delay), or waveform,
        is evaluated exactly, which takes from one to some ten milliseconds each.
    count
        ``"exact"``: the exact law. With a table it is the discrete law of the table's four cumulants where these fix
        it to a total variation of 0.002 (`Lookup.trusted`), and evaluated for every other distinct pixel, which takes
        some tenths of a millisecond each (ten for dead times beyond a period).
        ``"matched"``: the law of four cumulants everywhere, off by at most some 0.02 in pixels locked to the laser.
        ``"gaussian"``: the paper's, a rounded normal number of the right mean and variance, at least 0. Rounding
        adds 1/12 to the variance of a wide law; it is wrong for pixels that are locked to the laser, whose variances
        go down to 0.04.
    interpolation
        For a table: ``"bilinear"`` in (log S, log B), the default, or ``"nearest"`` grid point, the paper's.
    outside
        For pixels beyond the grid of a table: ``"error"``, the default, or ``"exact"``, to evaluate them as without
        a table, and count them in the report. Pixels without a return (S = 0) never raise an error: where the grid has
        no S = 0 they are evaluated.
    level
        Forces one of ``_core.levels()`` (vector widths); it changes speed only.

    Raises
    ------
    TypeError
        `table` is not a `Table`.
    ValueError
        An unknown `count`, `interpolation`, `outside` or `level`; options of a table without a table.

    See Also
    --------
    RenewalEngine, mars_lidar.Table, mars_lidar.simulate

    Notes
    -----
    The report has the seconds of the stages, ``lookup_s``, ``evaluation_s``, ``counts_s`` and ``sampling_s`` (alignment
    included), and ``pixels_evaluated``, the number of pixels evaluated without a table. With a table,
    ``pixels_exact_count`` is the number of pixels whose count law was evaluated, by ``laws_evaluated`` distinct
    evaluations.

    Examples
    --------
    >>> import mars_lidar as ml
    >>> system = ml.System(
    ...     period_ns=100.0, cycles=1000, bins=128,
    ...     pulse=ml.GaussianPulse(sigma_ns=1.0), detector=ml.Detector(dead_time_ns=75.0),
    ... )
    >>> engine = ml.engines.MarsEngine(count="gaussian")
    >>> ml.simulate(ml.Flux(1.0, 1.0, 40.0), system, engine=engine, seed=0).shape
    (1, 1, 1, 128)
    """

    name = "mars"
    description = "count law x mean histogram: cost flat in the exposure, bins not correlated as they should be"
    effects = LIGHT_EFFECTS + TIMING_EFFECTS
    options: ClassVar[tuple[str, ...]] = ("table", "count", "interpolation", "outside")

    def __init__(
        self,
        table: Table | None = None,
        *,
        count: Count = "exact",
        interpolation: Interpolation | None = None,
        outside: Outside | None = None,
        level: str = "",
    ) -> None:
        self.count = checks.choice("count", count, _COUNTS)
        super().__init__(table, interpolation, outside, level)

    @property
    def settings(self) -> dict[str, Any]:
        """Count law, and the table if there is one."""
        return {"count": self.count} | super().settings

    def _evaluate(self, run: synthesis.Run, pixels: IndexArray) -> None:
        """The exact statistics of each distinct pixel, at its own delay."""
        run.count("pixels_evaluated", pixels.size)
        for group in groups(run.task.flux, run.task.system, pixels):
            with run.stage("evaluation_s"):
                batch = self._evaluated(run, group)
            run.draw(batch)

    def _evaluated(self, run: synthesis.Run, group: Group) -> synthesis.Batch:
        task = run.task
        exposure = recorded_moments(
            group.cells, tolerance=TOL.law_tolerance, threads=task.threads, progress=run.waiting
        )
        cumulants = exposure.cumulants.reshape(-1, 4)
        if self.count == "exact" and task.system.dead_time_periods > 0.0:
            pmfs = exact_pmfs(group.cells, cumulants, exposure.bins.reshape(-1), task.threads)
            laws: synthesis.CountLaws = synthesis.Tabulated.of(pmfs, group.cell)
        else:
            laws = self._laws(task.system, cumulants[group.cell])
        return synthesis.Batch.unmixed(group.pixels, as_shapes(exposure.histogram), group.cell, laws)

    def _laws_of(self, run: synthesis.Run, reader: TableReader, entries: PixelEntries) -> synthesis.CountLaws:
        laws = self._laws(run.task.system, entries.cumulants)
        if self.count != "exact":
            return laws
        with run.stage("lookup_s"):
            at = untrusted(run, reader, entries)
        run.count("pixels_exact_count", at.size)
        if not at.size:
            return laws
        with run.stage("evaluation_s"):
            return synthesis.PartlyReplaced(laws, at, exact_laws(run, reader, entries, at))

    def _laws(self, system: System, cumulants: FloatArray) -> synthesis.CountLaws:
        """Laws from cumulants (pixels, 4)."""
        if self.count == "gaussian":
            return synthesis.RoundedGaussian(cumulants[:, 0], cumulants[:, 1])
        return synthesis.Poisson(cumulants[:, 0]) if system.dead_time_periods == 0.0 else synthesis.Matched(cumulants)
