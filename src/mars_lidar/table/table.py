"""The lookup table over (S, B) at a canonical delay: built once for a system, it answers for any pixel.

The paper's table (arXiv 2512.04924): 256 x 100 entries on [0.01, 10]^2; delay invariance replaces a third axis. Here
with the exact law of the finite exposure, its dependence on the delay, any number of cycles, and interpolation. What
is stored, and the errors, are described in docs/table.md.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mars_lidar._base.arguments import checked
from mars_lidar._base.types import Progress
from mars_lidar.instrument.system import System
from mars_lidar.statistics.chain import Rearm
from mars_lidar.table.axes import PAPER_GRID, Grid
from mars_lidar.table.build import build
from mars_lidar.table.cache import cached
from mars_lidar.table.error import law_error, quantisation_error
from mars_lidar.table.nodes import Method, Nodes
from mars_lidar.table.storage import load, save


@dataclass(frozen=True, eq=False, repr=False)
class Table(Nodes):
    """Count law and histogram shape over a grid of (S, B); made by `build`, `load` or `cached`.

    Attributes
    ----------
    system
        Laser, detector and histogram; its `cycles` are those of ``cycles=None``.
    method
        ``"exposure"`` or ``"mars"``.
    signal, background
        (nS,), (nB,) axes, photons per period, ascending. The first may be 0: pixels without a return.
    rearm
        Of the chain, for ``"mars"``.
    tolerance
        Of the exposure statistics.
    provenance
        How the table came to be: version, request, axes in words, seconds, and the error measured at the end.
    laws
        Exact laws of the count at those entries whose four cumulants do not fix it (`statistics.matched.trusted`).
    """

    @classmethod
    def build(
        cls,
        system: System,
        signal: Grid = PAPER_GRID["signal"],
        background: Grid = PAPER_GRID["background"],
        *,
        method: Method = "exposure",
        rearm: Rearm = "centre",
        refine: float | None = None,
        tolerance: float = 1e-4,
        check_law: bool = False,
        threads: int | None = None,
        progress: Progress | bool | None = None,
    ) -> Table:
        """Evaluate every entry.

        Parameters
        ----------
        system
            Laser, detector and histogram. Its detection efficiency and dark counts are left out (`System.detected`).
        signal, background
            Axes, detected photons per period (`Flux.detected`): ``(low, high, points)`` for 0 and `points` log-spaced
            values, or an array of values taken as it is. Between 0 and the next value everything is interpolated
            linearly.
        method
            ``"exposure"``: exact statistics of the finite exposure. ``"mars"``: the paper's, Markov chain and
            Gaussian of the Markov-renewal law, asymptotic in the exposure.
        rearm
            ``"centre"`` or ``"edge"`` of the bin, for ``"mars"``.
        refine
            Error in total variation, in [1e-5, 0.1]: points are inserted until the table meets it between its
            nodes (`QuantisationError.largest`). None: the axes as they are.
        tolerance
            Of each entry, for ``"exposure"``: see `exposure_moments`.
        check_law
            Compare the counts drawn from the table with exact laws as well (`law_error`), and keep the result.
        threads
            Threads to run on; default: all processors that this process may use.
        progress
            Called as ``progress(done, total)``; an exception from it stops the build.

        Raises
        ------
        ValueError, TypeError
            Naming the argument, before any work; or where `refine` cannot be met.
        ConvergenceError
            Naming the cell that could not be evaluated.
        """
        return build(
            cls,
            system,
            signal,
            background,
            method=method,
            rearm=rearm,
            refine=refine,
            tolerance=tolerance,
            check_law=check_law,
            threads=threads,
            progress=progress,
        )

    quantisation_error = quantisation_error
    law_error = law_error
    save = save

    @classmethod
    @checked
    def load(cls, path: str | Path, system: System | None = None) -> Table:
        """The table of a file, for `system` (None: for the one it was made for); shapes stay in the file, mapped.

        Raises
        ------
        ValueError
            Where the table is of another system, naming the field that differs. Another number of cycles is no
            difference where every entry holds for it.
        """
        return load(cls, Path(path), system)

    @classmethod
    def cached(
        cls,
        system: System,
        signal: Grid = PAPER_GRID["signal"],
        background: Grid = PAPER_GRID["background"],
        **options: Any,
    ) -> Table:
        """`build`, or the same table from the user's cache (docs/table.md, 7), which keeps what is built."""
        return cached(cls, system, signal, background, **options)
