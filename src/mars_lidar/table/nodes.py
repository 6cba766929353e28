"""The nodes of a table over (S, B), and what they say of any pixel between them (docs/table.md)."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mars_lidar._base import checks
from mars_lidar._base.arguments import checked
from mars_lidar._base.brief import brief
from mars_lidar._base.threads import thread_count
from mars_lidar._base.types import FloatArray
from mars_lidar.instrument.system import System
from mars_lidar.statistics.chain import Rearm
from mars_lidar.table.entries import Entries
from mars_lidar.table.lookup import Lookup, evaluate, read_pixels
from mars_lidar.table.node_laws import NodeLaws
from mars_lidar.table.start_phase import StartPhases

Method = Literal["exposure", "mars"]
Interpolation = Literal["bilinear", "nearest"]
INTERPOLATIONS, OUTSIDE = ("bilinear", "nearest"), ("error", "exact")


@dataclass(frozen=True, eq=False)
class Nodes:
    """Count law and histogram shape over a grid of (S, B): what a `Table` holds, and how it answers.

    The attributes are those of `mars_lidar.Table`.
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

    @checked
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
        checks.choice("interpolation", interpolation, INTERPOLATIONS)
        checks.choice("outside", outside, OUTSIDE)
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

    def serves(self, cycles: int) -> bool:
        """Whether every entry holds for exposures of `cycles` periods."""
        periods = self._cycles(cycles)
        own = periods == self.entries.cycles
        return own or bool(self.entries.serves(periods).all() and self.start_phases.settled.all())

    @property
    def nbytes(self) -> int:
        """Size of its arrays."""
        parts = vars(self.entries) | vars(self.laws)
        parts |= {name: getattr(self.start_phases, name) for name in ("correction", "settled")}
        return sum(each.nbytes for each in parts.values() if isinstance(each, np.ndarray))

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


N = TypeVar("N", bound=Nodes)
