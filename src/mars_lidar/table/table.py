"""The lookup table over (S, B) at a canonical delay: built once for a system, it answers for any pixel.

The paper's table (arXiv 2512.04924): 256 x 100 entries on [0.01, 10]^2; delay invariance replaces a third axis. Here
with the exact law of the finite exposure, its dependence on the delay, any number of cycles, and interpolation. What
is stored, and the errors, are described in docs/table.md.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mars_lidar._base import checks
from mars_lidar._base.brief import brief
from mars_lidar.instrument.system import System
from mars_lidar.statistics.cells import FloatArray
from mars_lidar.statistics.chain import Rearm
from mars_lidar.statistics.exposure import thread_count
from mars_lidar.table.axes import PAPER_GRID, Grid
from mars_lidar.table.entries import Entries, Progress
from mars_lidar.table.error import QuantisationError, quantisation_error
from mars_lidar.table.law import LawError, law_error
from mars_lidar.table.lookup import Lookup, evaluate, read_pixels
from mars_lidar.table.node_laws import NodeLaws
from mars_lidar.table.start_phase import StartPhases

Method = Literal["exposure", "mars"]
Interpolation = Literal["bilinear", "nearest"]
_INTERPOLATIONS, _OUTSIDE = ("bilinear", "nearest"), ("error", "exact")


@dataclass(frozen=True, eq=False)
class Table:
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

    system: System
    method: Method
    signal: FloatArray
    background: FloatArray
    rearm: Rearm
    tolerance: float
    provenance: dict[str, Any]
    entries: Entries = field(repr=False)
    start_phases: StartPhases = field(repr=False)
    laws: NodeLaws = field(repr=False)

    __repr__ = brief

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
        progress: Progress | None = None,
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
        from mars_lidar.table.build import build

        return build(
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

    def lookup(
        self,
        signal: ArrayLike,
        background: ArrayLike,
        *,
        delay_ns: ArrayLike | None = None,
        cycles: int | None = None,
        interpolation: Interpolation = "bilinear",
        outside: Literal["error", "exact"] = "error",
        threads: int | None = 1,
    ) -> Lookup:
        """Entries for pixels.

        Parameters
        ----------
        signal, background, delay_ns
            S and B, photons per period, and delay of the return, ns: scalars or arrays that broadcast; P is the
            number of their elements in C order. The delay is of no account where S is 0, and may be NaN there;
            None: the canonical t_r / 2 everywhere.
        cycles
            Laser periods of the exposure; None: the system's.
        interpolation
            ``"bilinear"``: the mean histogram is a mixture of four, linear in S and in B; cumulants are bicubic in
            their logarithms. ``"nearest"``: the nearest entry, as in the paper.
        outside
            ``"error"``, or ``"exact"``: pixels beyond the axes are left to the caller, marked in `Lookup.outside`.
        threads
            Threads to run on; the result does not depend on it.

        Raises
        ------
        ValueError
            Naming the range that lies outside of the table; or the entry that does not hold for `cycles`.
        """
        checks.choice("interpolation", interpolation, _INTERPOLATIONS)
        checks.choice("outside", outside, _OUTSIDE)
        periods = self._cycles(cycles)
        team = thread_count(threads)
        s, b, phase, beyond = read_pixels(
            self.system.period_ns, (self.signal, self.background), signal, background, delay_ns, outside
        )
        inside = np.flatnonzero(~beyond)
        rows, weights = np.zeros((s.size, 4), np.int64), np.zeros((s.size, 4))
        weights[:, 0] = 1.0
        cumulants = np.full((s.size, 4), np.nan)
        everything = inside.size == s.size
        pick: NDArray[np.int64] | slice = slice(None) if everything else inside
        rows[pick], weights[pick], cumulants[pick] = evaluate(
            (self.signal, self.background),
            self.entries.cumulants_at(periods),
            self.start_phases,
            periods == self.entries.cycles,
            s[pick],
            b[pick],
            phase[pick],
            interpolation == "nearest",
            team,
        )
        if np.isnan(cumulants[inside]).any():
            self._refuse(periods)
        return Lookup(rows, weights, cumulants, beyond)

    def shapes(self, cycles: int | None = None) -> NDArray[np.float32]:
        """Normalised mean histograms at the canonical delay t_r / 2 (nS * nB, bins), float32, read-only.

        Row iS * nB + iB belongs to ``signal[iS], background[iB]``. Mapped from the file where it holds what is
        asked for; computed at each call for other cycles than those that the table was made for. Rows that do not
        hold for `cycles` are NaN; `lookup` refuses to name them.
        """
        shapes = self.entries.shapes_at(self._cycles(cycles)).view()
        shapes.flags.writeable = False
        return shapes

    def quantisation_error(
        self,
        *,
        interpolation: Interpolation = "bilinear",
        samples: int = 200,
        seed: int = 0,
        cycles: int | None = None,
        threads: int | None = None,
    ) -> QuantisationError:
        """Errors on random pixels between the nodes, against the law of each evaluated directly.

        Parameters
        ----------
        interpolation, cycles
            As `lookup`.
        samples, seed
            Pixels, log-uniform over the axes, with random delays; with ``"bilinear"`` one in eight lies between 0
            and the lowest value, where the axis has a 0.
        """
        checks.choice("interpolation", interpolation, _INTERPOLATIONS)
        return quantisation_error(self, interpolation, samples, seed, cycles, threads)

    def law_error(
        self, *, samples: int = 50, seed: int = 0, cycles: int | None = None, threads: int | None = None
    ) -> LawError:
        """Total variation, on random pixels, between the count law that the table leads to and the exact one.

        Some 10 to 20 ms a pixel. Parameters as `quantisation_error`.
        """
        return law_error(self, samples, seed, cycles, threads)

    def serves(self, cycles: int) -> bool:
        """Whether every entry holds for exposures of `cycles` periods."""
        periods = self._cycles(cycles)
        own = periods == self.entries.cycles
        return own or bool(self.entries.serves(periods).all() and self.start_phases.settled.all())

    def save(self, path: str | Path, *, overwrite: bool = False) -> None:
        """Write to an HDF5 file (.h5, .hdf5), which appears under its name when it is complete."""
        from mars_lidar.table.storage import save

        save(self, Path(path), overwrite=overwrite)

    @classmethod
    def load(cls, path: str | Path, system: System | None = None) -> Table:
        """The table of a file, for `system` (None: for the one it was made for); shapes stay in the file, mapped.

        Raises
        ------
        ValueError
            Where the table is of another system, naming the field that differs. Another number of cycles is no
            difference where every entry holds for it.
        """
        from mars_lidar.table.storage import load

        return load(Path(path), system)

    @classmethod
    def cached(
        cls,
        system: System,
        signal: Grid = PAPER_GRID["signal"],
        background: Grid = PAPER_GRID["background"],
        **options: Any,
    ) -> Table:
        """`build`, or the same table from the user's cache (docs/table.md, 7), which keeps what is built."""
        from mars_lidar.table.cache import cached

        return cached(system, signal, background, **options)

    @property
    def nbytes(self) -> int:
        """Size of its arrays."""
        phases, entries = self.start_phases, self.entries
        startup = 0 if entries.startup is None else entries.startup.nbytes
        return int(
            entries.shape.nbytes
            + startup
            + entries.cumulants.nbytes
            + entries.rates.nbytes
            + entries.enough.nbytes
            + entries.bins.nbytes
            + phases.correction.nbytes
            + phases.settled.nbytes
            + self.laws.nbytes
        )

    def _cycles(self, cycles: int | None) -> int:
        return self.system.cycles if cycles is None else checks.integer("cycles", cycles, low=1, high=10**8)

    def _refuse(self, cycles: int) -> None:
        """Raise, naming the entry that holds for the fewest numbers of cycles."""
        enough = self.entries.enough
        worst = int(np.argmin(enough)) if (enough < 0).any() else int(np.argmax(enough))
        s, b = self.signal[worst // self.background.size], self.background[worst % self.background.size]
        if enough[worst] < 0:
            why = f"the state of a pixel at S = {s:g}, B = {b:g} does not repeat from period to period by then"
        elif enough[worst] > cycles:
            why = f"the state of a pixel at S = {s:g}, B = {b:g} repeats only after {enough[worst]} periods"
        else:
            why = "the effect of the delay has not settled by then"
        raise ValueError(
            f"cycles must be {self.entries.cycles} at some of these pixels, got {cycles}: the table was made for "
            f"{self.entries.cycles} cycles, and {why}"
        )
